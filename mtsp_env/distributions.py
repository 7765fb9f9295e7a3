"""Where instances come from: generators of random problems, by name or as functions of one's own.

A generator is a function ``(rng, batch, n_nodes, n_agents) -> dict of arrays`` by their names in
``mtsp_env.instance.FIELDS``: ``nodes`` (batch, n, 2) at least. Both environments and ``python -m train`` take a name in
``DISTRIBUTIONS`` or such a function.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.instance import FIELDS, Instance, Problem, check_arrays

Generator = Callable[[np.random.Generator, int, int, int], Mapping[str, np.ndarray]]


def uniform_nodes(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """The paper's distribution (Sec. 6): every node uniform in the unit square."""
    return {"nodes": rng.random((batch, n_nodes, 2))}


def clustered_nodes(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Cities scattered (standard deviation 0.07) around 3 to 8 uniform centres, the depot uniform; the clusters of
    Uchoa et al. 2017 (CVRP benchmark X) in their simplest form."""
    centres = rng.random((batch, 8, 2))
    n_centres = rng.integers(3, 9, size=(batch, 1))
    which = rng.integers(0, n_centres, size=(batch, n_nodes))
    nodes = np.take_along_axis(centres, which[..., None], axis=1) + rng.normal(0.0, 0.07, (batch, n_nodes, 2))
    nodes[:, 0] = rng.random((batch, 2))
    return {"nodes": 1.0 - np.abs(1.0 - np.abs(nodes) % 2.0)}  # fold at the border: clipping would pile cities up there


DISTRIBUTIONS: dict[str, Generator] = {"uniform": uniform_nodes, "clustered": clustered_nodes}


def check_distribution(distribution: str | Generator) -> None:
    """Raise ValueError unless ``distribution`` is a key of DISTRIBUTIONS or a function."""
    if not callable(distribution) and distribution not in DISTRIBUTIONS:
        raise ValueError(
            f"unknown distribution {distribution!r}; choose from {sorted(DISTRIBUTIONS)} or give a function"
        )


def distribution_name(distribution: str | Generator) -> str:
    """For the names of instances."""
    return distribution if isinstance(distribution, str) else getattr(distribution, "__name__", "custom")


def sample(distribution: str | Generator, rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> Problem:
    """``batch`` fresh instances of one size, as a problem of NumPy arrays.

    Raises:
        ValueError: an unknown distribution, a size outside its range, or a function whose arrays are not such problems.
    """
    check_distribution(distribution)
    check_count("batch", batch, minimum=0)
    check_count("n_nodes", n_nodes, minimum=2)
    check_count("n_agents", n_agents, minimum=1)
    generate = DISTRIBUTIONS[distribution] if isinstance(distribution, str) else distribution
    drawn = generate(rng, batch, n_nodes, n_agents)
    if not isinstance(drawn, Mapping):
        raise ValueError(f"a distribution must return a dict of arrays by the names {list(FIELDS)}, got {drawn!r}")
    arrays = {name: np.asarray(array, dtype=np.float64) for name, array in drawn.items()}
    check_arrays(arrays, n_agents)
    if arrays["nodes"].shape != (batch, n_nodes, 2):
        raise ValueError(f"nodes must have shape {(batch, n_nodes, 2)}, got {arrays['nodes'].shape}")
    return Problem(n_agents, arrays)


def uniform(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance with every node uniform in the unit square (paper, Sec. 6)."""
    return sample("uniform", rng, 1, n_nodes, n_agents).instance(0, f"uniform-{n_nodes}")


def clustered(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance whose cities gather around 3 to 8 centres."""
    return sample("clustered", rng, 1, n_nodes, n_agents).instance(0, f"clustered-{n_nodes}")
