"""Instances of the MinMax mTSP: what they hold, where they come from, how they are stored.

Coordinates lie in the unit square, as in the paper (Sec. 6: "uniformly at random in the unit square"); ``scale`` turns
a length there into the units of the file that the instance was read from.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

Tours = list[list[int]]
"""One tour per agent: depot (0), cities, depot (0)."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One problem: where the nodes are and how many agents share them.

    Attributes:
        nodes: float64 (n, 2), coordinates in [0, 1]; row 0 is the depot, the others are the cities. Read-only.
        n_agents: m, at least 1; more agents than cities is fine.
        name: for tables and pictures.
        scale: length in the source's units of a length 1 in the unit square, above 0.

    Raises:
        ValueError: where one of these does not hold; the message names the value and the range.
    """

    nodes: np.ndarray  # (n, 2)
    n_agents: int
    name: str = ""
    scale: float = 1.0

    def __post_init__(self) -> None:
        nodes = _numbers("nodes", self.nodes) + 0.0  # a copy nobody changes from outside; -0.0 becomes 0.0
        if nodes.ndim != 2:
            raise ValueError(f"nodes must have shape (n, 2), got {nodes.shape}")
        check_nodes(nodes)
        check_count("n_agents", self.n_agents, minimum=1)
        if not isinstance(self.name, str):
            raise ValueError(f"name must be a string, got {self.name!r}")
        nodes.flags.writeable = False
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "n_agents", int(self.n_agents))
        object.__setattr__(self, "scale", _check_scale(self.scale))

    @property
    def n_nodes(self) -> int:
        """n, the depot included."""
        return len(self.nodes)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Instance):
            return NotImplemented
        return np.array_equal(self.nodes, other.nodes) and (self.n_agents, self.name, self.scale) == (
            other.n_agents,
            other.name,
            other.scale,
        )

    def __reduce__(self) -> tuple:
        return Instance, (self.nodes, self.n_agents, self.name, self.scale)  # NumPy unpickles arrays as writable

    def __hash__(self) -> int:
        return hash((self.nodes.tobytes(), self.n_agents, self.name, self.scale))


def _numbers(name: str, values: object) -> np.ndarray:
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be numbers of shape (n, 2), got {type(values).__name__}: {error}") from error


def _check_scale(scale: float) -> float:
    try:
        value = float(scale)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if isinstance(scale, str) or not (math.isfinite(value) and value > 0):
        raise ValueError(f"scale must be a finite number above 0, got {scale!r}")
    return value


def check_nodes(nodes: np.ndarray) -> None:
    """Raise ValueError unless ``nodes`` (..., n, 2) are at least 2 finite points of the unit square."""
    if nodes.ndim < 2 or nodes.shape[-1] != 2:
        raise ValueError(f"nodes must have shape (n, 2), got {nodes.shape}")
    check_count("n_nodes", nodes.shape[-2], minimum=2)
    if not np.isfinite(nodes).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(nodes))[0])
        raise ValueError(f"nodes must be finite, got {nodes[bad]} at {bad}")
    if nodes.min() < 0 or nodes.max() > 1:
        raise ValueError(
            f"nodes must lie in the unit square [0, 1], got a range of [{nodes.min():g}, {nodes.max():g}]; "
            "from_coordinates(xy, n_agents) brings any coordinates there and keeps the scale"
        )


def check_count(name: str, value: int, minimum: int) -> None:
    """Raise ValueError unless ``value`` is a whole number of at least ``minimum``."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, got {value!r}")


def from_coordinates(xy: np.ndarray | Sequence, n_agents: int, name: str = "") -> Instance:
    """Bring any planar coordinates (n, 2) to the unit square, keeping their shape and, in ``scale``, their units.

    Raises:
        ValueError: fewer than two points, not of shape (n, 2), or not finite.
    """
    xy = _numbers("coordinates", xy)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"coordinates must have shape (n, 2), got {xy.shape}")
    check_count("n_nodes", len(xy), minimum=2)
    if not np.isfinite(xy).all():
        raise ValueError("coordinates must be finite")
    corner = xy.min(axis=0)
    extent = float((xy.max(axis=0) - corner).max()) or 1.0  # all nodes in one place: nothing to scale
    return Instance(np.clip((xy - corner) / extent, 0.0, 1.0), n_agents, name, extent)


# Distributions: (rng, batch, n_nodes) -> float64 (batch, n_nodes, 2) in the unit square


def _uniform_nodes(rng: np.random.Generator, batch: int, n_nodes: int) -> np.ndarray:
    """The paper's distribution (Sec. 6): every node uniform in the unit square."""
    return rng.random((batch, n_nodes, 2))


def _clustered_nodes(rng: np.random.Generator, batch: int, n_nodes: int) -> np.ndarray:
    """Cities scattered (standard deviation 0.07) around 3 to 8 uniform centres, the depot uniform; the clusters of
    Uchoa et al. 2017 (CVRP benchmark X) in their simplest form."""
    centres = rng.random((batch, 8, 2))
    n_centres = rng.integers(3, 9, size=(batch, 1))
    which = rng.integers(0, n_centres, size=(batch, n_nodes))
    nodes = np.take_along_axis(centres, which[..., None], axis=1) + rng.normal(0.0, 0.07, (batch, n_nodes, 2))
    nodes[:, 0] = rng.random((batch, 2))
    return 1.0 - np.abs(1.0 - np.abs(nodes) % 2.0)  # fold at the border, where clipping would pile cities up


DISTRIBUTIONS: dict[str, Callable[[np.random.Generator, int, int], np.ndarray]] = {
    "uniform": _uniform_nodes,
    "clustered": _clustered_nodes,
}


def sample_nodes(distribution: str, rng: np.random.Generator, batch: int, n_nodes: int) -> np.ndarray:
    """``batch`` fresh instances' nodes, float64 (batch, n_nodes, 2), from the named distribution.

    Raises:
        ValueError: an unknown distribution, or n_nodes below 2.
    """
    check_distribution(distribution)
    check_count("n_nodes", n_nodes, minimum=2)
    return DISTRIBUTIONS[distribution](rng, batch, n_nodes)


def check_distribution(distribution: str) -> None:
    """Raise ValueError unless ``distribution`` is a key of DISTRIBUTIONS."""
    if distribution not in DISTRIBUTIONS:
        raise ValueError(f"unknown distribution {distribution!r}; choose from {sorted(DISTRIBUTIONS)}")


def uniform(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance with every node uniform in the unit square (paper, Sec. 6)."""
    return Instance(sample_nodes("uniform", rng, 1, n_nodes)[0], n_agents, f"uniform-{n_nodes}")


def clustered(rng: np.random.Generator, n_nodes: int, n_agents: int) -> Instance:
    """An instance whose cities gather around 3 to 8 centres."""
    return Instance(sample_nodes("clustered", rng, 1, n_nodes)[0], n_agents, f"clustered-{n_nodes}")


# Files of our own: JSON, written to a temporary name and moved, so that a crash leaves the old file whole


def write_instance(path: str | os.PathLike, instance: Instance) -> None:
    """Write an instance as JSON: {"name", "n_agents", "scale", "nodes"}."""
    _write_json(
        path,
        {
            "name": instance.name,
            "n_agents": instance.n_agents,
            "scale": instance.scale,
            "nodes": instance.nodes.tolist(),
        },
    )


def read_instance(path: str | os.PathLike, n_agents: int | None = None) -> Instance:
    """Read what ``write_instance`` wrote; ``n_agents`` replaces the file's.

    Raises:
        OSError: no such file.
        ValueError: not such a file, or not a valid instance.
    """
    data = _read_json(path, keys=("nodes", "n_agents"))
    m = data["n_agents"] if n_agents is None else n_agents
    try:
        return Instance(data["nodes"], m, data.get("name", ""), data.get("scale", 1.0))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_tours(path: str | os.PathLike, tours: Tours, **extra: object) -> None:
    """Write tours as JSON: {"tours": [[0, ..., 0], ...]} and whatever else is worth keeping beside them."""
    _write_json(path, {"tours": [[int(node) for node in tour] for tour in tours], **extra})


def read_tours(path: str | os.PathLike) -> Tours:
    """Read the tours that ``write_tours`` wrote; ``tours.check_tours`` says whether they solve an instance.

    Raises:
        OSError: no such file.
        ValueError: not such a file.
    """
    tours = _read_json(path, keys=("tours",))["tours"]
    if not isinstance(tours, list) or not all(
        isinstance(tour, list) and all(type(node) is int for node in tour) for tour in tours
    ):
        raise ValueError(f"{path}: 'tours' must be a list of lists of node numbers")
    return tours


def _write_json(path: str | os.PathLike, data: dict) -> None:
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(json.dumps(data), encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _read_json(path: str | os.PathLike, keys: Sequence[str]) -> dict:
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not JSON, not text, or nested without end
        raise ValueError(f"{path}: not a JSON file ({error})") from error
    if not isinstance(data, dict) or not set(keys) <= data.keys():
        raise ValueError(f"{path}: expected a JSON object with the keys {list(keys)}")
    return data
