"""Where instances come from: generators of random problems, by name or as functions of one's own.

A generator is a function ``(rng, batch, n_nodes, n_agents) -> dict of arrays`` by their names in
``mtsp_env.instance.FIELDS``. A *distribution* says where the nodes lie: ``nodes`` (batch, n, 2). A *scenario* says in
which world they lie: any of the other fields, none in the plain problem. Both environments take a name in
``DISTRIBUTIONS`` and one in ``SCENARIOS``, or such functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.instance import FIELDS, WORLD_FIELDS, Instance, Problem, check_arrays

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


# Scenarios


def expected_makespan(n_nodes: int, n_agents: int) -> float:
    """Roughly the makespan of good tours for uniform nodes, for scenarios whose events must fall within a game.

    One tour of n uniform nodes is about 0.76 sqrt(n) long, and with many agents the farthest city decides; between
    them, the root of the sum of squares is within 5 % of the reference solver's makespan on average (12 % at worst)
    over n in 10..200 and m in 1..20.
    """
    return math.hypot(0.76 * math.sqrt(n_nodes) / n_agents, 1.85)


def plain(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """The paper's problem: no world fields."""
    return {}


def arrivals(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Half of the cities (rounded down) appear at uniform times within the expected makespan."""
    n_cities = n_nodes - 1
    times = rng.uniform(0.0, expected_makespan(n_nodes, n_agents), (batch, n_cities))
    late = rng.permuted(np.tile(np.arange(n_cities) < n_cities // 2, (batch, 1)), axis=1)
    return {"appears": np.pad(np.where(late, times, 0.0), ((0, 0), (1, 0)))}


def breakdowns(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Each agent but one, drawn at random, breaks down with probability 0.3, at a uniform time within the expected
    makespan."""
    times = rng.uniform(0.0, expected_makespan(n_nodes, n_agents), (batch, n_agents))
    fails = rng.random((batch, n_agents)) < 0.3
    spared = rng.integers(n_agents, size=(batch, 1)) == np.arange(n_agents)
    return {"breaks": np.where(fails & ~spared & (times > 0.0), times, np.inf)}


def traffic(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Each leg takes longer or shorter by a log-normal factor: median 1, sigma 0.3; n factors per agent."""
    return {"traffic": rng.lognormal(0.0, 0.3, (batch, n_agents, n_nodes))}


def team(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Speeds uniform in [0.5, 1.5]."""
    return {"speeds": rng.uniform(0.5, 1.5, (batch, n_agents))}


def service(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """Visits of uniform length in [0, 0.1]."""
    return {"service": np.pad(rng.uniform(0.0, 0.1, (batch, n_nodes - 1)), ((0, 0), (1, 0)))}


def everything(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """``arrivals``, ``breakdowns``, ``traffic``, ``team`` and ``service`` at once."""
    fields: dict[str, np.ndarray] = {}
    for scenario in (arrivals, breakdowns, traffic, team, service):
        fields |= scenario(rng, batch, n_nodes, n_agents)
    return fields


SCENARIOS: dict[str, Generator] = {
    function.__name__: function for function in (plain, arrivals, breakdowns, traffic, team, service, everything)
}


def check_distribution(distribution: str | Generator) -> None:
    """Raise ValueError unless ``distribution`` is a key of DISTRIBUTIONS or a function."""
    _check_generator("distribution", distribution, DISTRIBUTIONS)


def check_scenario(scenario: str | Generator) -> None:
    """Raise ValueError unless ``scenario`` is a key of SCENARIOS or a function."""
    _check_generator("scenario", scenario, SCENARIOS)


def _check_generator(kind: str, given: str | Generator, known: Mapping[str, Generator]) -> None:
    if not callable(given) and given not in known:
        raise ValueError(f"unknown {kind} {given!r}; choose from {sorted(known)} or give a function")


def distribution_name(distribution: str | Generator) -> str:
    """For the names of instances."""
    return distribution if isinstance(distribution, str) else getattr(distribution, "__name__", "custom")


def sample(
    distribution: str | Generator,
    rng: np.random.Generator,
    batch: int,
    n_nodes: int,
    n_agents: int,
    scenario: str | Generator = "plain",
) -> Problem:
    """``batch`` fresh instances of one size, as a problem of NumPy arrays.

    Raises:
        ValueError: an unknown distribution or scenario, a size outside its range, or a function whose arrays are not
            such problems.
    """
    check_distribution(distribution)
    check_scenario(scenario)
    check_count("batch", batch, minimum=0)
    check_count("n_nodes", n_nodes, minimum=2)
    check_count("n_agents", n_agents, minimum=1)
    size = (rng, batch, n_nodes, n_agents)
    nodes = _draw("distribution", DISTRIBUTIONS[distribution] if isinstance(distribution, str) else distribution, size)
    world = _draw("scenario", SCENARIOS[scenario] if isinstance(scenario, str) else scenario, size)
    for kind, misplaced in (("scenario", nodes.keys() & set(WORLD_FIELDS)), ("distribution", world.keys() & {"nodes"})):
        if misplaced:
            raise ValueError(f"{sorted(misplaced)} must come from the {kind}: see mtsp_env.distributions")
    check_arrays({**nodes, **world}, n_agents)
    if nodes["nodes"].shape != (batch, n_nodes, 2):
        raise ValueError(f"nodes must have shape {(batch, n_nodes, 2)}, got {nodes['nodes'].shape}")
    return Problem(n_agents, {**nodes, **world})


def _draw(kind: str, generate: Generator, size: tuple[np.random.Generator, int, int, int]) -> dict[str, np.ndarray]:
    drawn = generate(*size)
    if not isinstance(drawn, Mapping):
        raise ValueError(f"a {kind} must return a dict of arrays by the names {list(FIELDS)}, got {drawn!r}")
    return {name: np.asarray(array, dtype=np.float64) for name, array in drawn.items()}


def scenario_shapes(scenario: str | Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, tuple[int, ...]]:
    """The world fields that a scenario draws, with the shapes of one instance's; drawn once to find out."""
    drawn = sample("uniform", np.random.default_rng(0), batch, n_nodes, n_agents, scenario)
    return {name: drawn.arrays[name].shape[1:] for name in drawn.world}


def uniform(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance with every node uniform in the unit square (paper, Sec. 6)."""
    return sample("uniform", rng, 1, n_nodes, n_agents).instance(0, f"uniform-{n_nodes}")


def clustered(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance whose cities gather around 3 to 8 centres."""
    return sample("clustered", rng, 1, n_nodes, n_agents).instance(0, f"clustered-{n_nodes}")
