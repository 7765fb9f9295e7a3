"""The problem, described once: the fields of an instance, and batches of instances of one size.

``FIELDS`` describes every array of a problem: dtype, shape, unit, range. Validation, equality, hashing, pickling, JSON,
batches and the TorchRL specs are derived from it, so that a new field is one entry here, its lines in ``world.py`` and
its check in ``tours.py``.

Coordinates lie in the unit square, as in the paper (Sec. 6: "uniformly at random in the unit square"); ``scale`` turns
a length there into the units of the file that the instance was read from. Time is measured in units of distance at
speed 1.
"""

# ruff: noqa: RUF009 (fields of the dataclass are described by calls)

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from mtsp_env.checks import check_count

Array = Any  # a NumPy array or a torch tensor
Tours = list[list[int]]
"""One tour per agent: depot (0), cities, depot (0)."""


@dataclass(frozen=True)
class ArrayField:
    """What one array of a problem or of a game holds.

    Attributes:
        dtype: its name, the same in NumPy and torch.
        shape: of one instance: "n" (nodes), "m" (agents), "K" (any length of at least 1), or a number.
        meaning: one line for the documentation, with the unit.
        low: least value, if there is one.
        low_allowed: whether ``low`` itself is allowed.
        high: greatest value; infinity is allowed only if this is ``math.inf``.
        zero_at_depot: whether entry 0 must be 0.
        check: a further check of the array ``(..., *shape)``; returns what is wrong, or None.
        usual: the value of a world field with which agents move as in a plain game; None: not a world field.
        needs: the world field without which a game does not have this array; None: every game has it.
    """

    dtype: str
    shape: tuple[str | int, ...]
    meaning: str
    low: float | None = None
    low_allowed: bool = True
    high: float | None = None
    zero_at_depot: bool = False
    check: Callable[[np.ndarray], str | None] | None = None
    usual: float | None = None
    needs: str | None = None

    def sizes(self, n_nodes: int, n_agents: int) -> tuple[int | None, ...]:
        """The shape in numbers; None stands for any length of at least 1."""
        numbers = {"n": n_nodes, "m": n_agents, "K": None}
        return tuple(numbers[size] if isinstance(size, str) else size for size in self.shape)


def _array_field(default: object, *description: Any, **limits: Any) -> Any:
    array = ArrayField("float64", *description, **limits)
    options: dict[str, Any] = {} if default is ... else {"default": default}
    return field(**options, metadata={"array": array})


def _someone_keeps_going(breaks: np.ndarray) -> str | None:
    return None if np.isinf(breaks).any(-1).all() else "at least one agent must never break down (inf)"


@dataclass(frozen=True, eq=False)
class Instance:
    """One problem: where the nodes are, how many agents share them, and optionally the world that they move in.

    An instance without world fields is *plain*: the paper's problem.

    Attributes:
        nodes: float64 (n, 2), coordinates in [0, 1]; row 0 is the depot, the others are the cities.
        n_agents: m, at least 1; more agents than cities is fine.
        name: for tables and pictures.
        scale: length in the source's units of a length 1 in the unit square, above 0.
        speeds: float64 (m,) above 0: each agent's speed relative to 1; a leg of length d takes d / speed.
        service: float64 (n,) at least 0: how long an agent stays at a node before it decides again; 0 at the depot.
        appears: float64 (n,) at least 0: when a node becomes known to everybody; 0 at the depot.
        breaks: float64 (m,) above 0: when each agent stops for good; inf for at least one agent.
        traffic: float64 (m, K) above 0: factor by which an agent's k-th leg takes longer than announced (k modulo K).

    All arrays are read-only copies.

    Raises:
        ValueError: a value outside its range; the message names the value and the range.
    """

    nodes: np.ndarray = _array_field(..., ("n", 2), "coordinates in the unit square; row 0 is the depot", 0.0, high=1.0)
    n_agents: int  # type: ignore[misc]  # mypy takes the call above for a default value
    name: str = ""
    scale: float = 1.0
    speeds: np.ndarray | None = _array_field(None, ("m",), "speed relative to 1", 0.0, False, usual=1.0)
    service: np.ndarray | None = _array_field(
        None, ("n",), "time that a visit takes", 0.0, zero_at_depot=True, usual=0.0
    )
    appears: np.ndarray | None = _array_field(
        None, ("n",), "time at which a node becomes known to everybody", 0.0, zero_at_depot=True, usual=0.0
    )
    breaks: np.ndarray | None = _array_field(
        None,
        ("m",),
        "time at which an agent stops for good",
        0.0,
        False,
        math.inf,
        check=_someone_keeps_going,
        usual=math.inf,
    )
    traffic: np.ndarray | None = _array_field(
        None, ("m", "K"), "factor on the travel time of an agent's k-th leg, k modulo K", 0.0, False, usual=1.0
    )

    def __post_init__(self) -> None:
        check_count("n_agents", self.n_agents, minimum=1)
        if not isinstance(self.name, str):
            raise ValueError(f"name must be a string, got {self.name!r}")
        arrays = {name: _read_only_copy(name, value) for name, value in self.arrays().items()}
        if arrays["nodes"].ndim != 2:
            raise ValueError(f"nodes must have shape (n, 2), got {arrays['nodes'].shape}")
        check_arrays(arrays, self.n_agents)
        scale = _check_scale(self.scale, len(arrays["nodes"]))
        for name, value in {"n_agents": int(self.n_agents), "scale": scale, **arrays}.items():
            object.__setattr__(self, name, value)

    def arrays(self) -> dict[str, np.ndarray]:
        """The array fields that this instance has, by name: ``nodes`` and the fields of its world."""
        arrays = {name: getattr(self, name) for name in FIELDS}
        return {name: value for name, value in arrays.items() if value is not None or name == "nodes"}

    @property
    def n_nodes(self) -> int:
        """n, the depot included."""
        return len(self.nodes)

    @property
    def world(self) -> tuple[str, ...]:
        """The names of its world fields; none if it is plain."""
        return tuple(name for name in WORLD_FIELDS if getattr(self, name) is not None)

    @property
    def waiting_counts(self) -> bool:
        """Whether waiting at the depot adds to an agent's own time: in worlds with ``appears`` or ``breaks``."""
        return self.appears is not None or self.breaks is not None

    def _values(self) -> tuple:
        return tuple(getattr(self, each.name) for each in fields(self))

    def _key(self) -> tuple:
        return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in self._values())

    def __eq__(self, other: object) -> bool:
        return self._key() == other._key() if isinstance(other, Instance) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key())

    def __reduce__(self) -> tuple:
        return Instance, self._values()  # NumPy unpickles arrays as writable


def describe_fields(described: Mapping[str, ArrayField]) -> str:
    """A Markdown table of array fields: names, shapes for one instance, dtypes and meanings."""
    rows = [
        f"| `{name}` | ({', '.join(map(str, field.shape))}) | {field.dtype} | {field.meaning} |"
        for name, field in described.items()
    ]
    return "\n".join(["| field | shape | dtype | meaning |", "|---|---|---|---|", *rows])


FIELDS: dict[str, ArrayField] = {each.name: each.metadata["array"] for each in fields(Instance) if each.metadata}
WORLD_FIELDS: tuple[str, ...] = tuple(name for name in FIELDS if name != "nodes")


@dataclass(frozen=True)
class Problem:
    """B instances of one size, in arrays with a leading batch dimension.

    Attributes:
        n_agents: m.
        arrays: NumPy arrays or torch tensors ``(B, *shape)`` by their names in ``FIELDS``; ``nodes`` (B, n, 2)
            always, a world's fields only if the instances have it.
    """

    n_agents: int
    arrays: Mapping[str, Array]

    @property
    def nodes(self) -> Array:
        """(B, n, 2) float64."""
        return self.arrays["nodes"]

    @property
    def n_nodes(self) -> int:
        """n, the depot included."""
        return self.nodes.shape[1]

    @property
    def is_plain(self) -> bool:
        """Whether the problem has no world fields."""
        return len(self.arrays) == 1

    @property
    def world(self) -> tuple[str, ...]:
        """The names of its world fields."""
        return tuple(name for name in WORLD_FIELDS if name in self.arrays)

    @property
    def waiting_counts(self) -> bool:
        """Whether waiting at the depot adds to an agent's own time: in worlds with ``appears`` or ``breaks``."""
        return "appears" in self.arrays or "breaks" in self.arrays

    def instance(self, row: int, name: str = "") -> Instance:
        """Row ``row`` of a problem of NumPy arrays as an instance."""
        return Instance(n_agents=self.n_agents, name=name, **{key: array[row] for key, array in self.arrays.items()})


def batch(instances: Sequence[Instance]) -> Problem:
    """Instances of one size and with the same world fields as one problem of NumPy arrays.

    Raises:
        ValueError: no instance, or instances that differ in n, m or the fields of their worlds.
    """
    if not instances:
        raise ValueError("expected at least 1 instance, got none")
    first = instances[0]
    for number, other in enumerate(instances):
        if _shapes(other) != _shapes(first):
            raise ValueError(f"instance {number} has {_shapes(other)}, instance 0 has {_shapes(first)}")
    arrays = {name: np.stack([instance.arrays()[name] for instance in instances]) for name in first.arrays()}
    return Problem(first.n_agents, arrays)


def _shapes(instance: Instance) -> dict[str, Any]:
    return {"n_agents": instance.n_agents, **{name: array.shape for name, array in instance.arrays().items()}}


def check_arrays(arrays: Mapping[str, np.ndarray], n_agents: int) -> None:
    """Raise ValueError unless ``arrays`` ``(..., *shape)``, by name, describe problems for ``n_agents`` agents."""
    for name in arrays:
        if name not in FIELDS:
            raise ValueError(f"unknown field {name!r}; choose from {list(FIELDS)}")
    if "nodes" not in arrays:
        raise ValueError(f"a problem needs the field 'nodes', got {sorted(arrays)}")
    nodes = arrays["nodes"]
    if nodes.ndim < 2 or nodes.shape[-1] != 2:
        raise ValueError(f"nodes must have shape (n, 2), got {nodes.shape}")
    check_count("n_nodes", nodes.shape[-2], minimum=2)
    for name, array in arrays.items():
        _check_array(name, array, nodes.shape[:-2], nodes.shape[-2], n_agents)


def _check_array(name: str, array: np.ndarray, lead: tuple[int, ...], n_nodes: int, n_agents: int) -> None:
    spec = FIELDS[name]
    sizes = spec.sizes(n_nodes, n_agents)
    matches = array.ndim == len(lead) + len(sizes) and array.shape[: len(lead)] == lead
    for size, wanted in zip(array.shape[len(lead) :], sizes, strict=False):
        matches = matches and (size == wanted if wanted is not None else size >= 1)
    if not matches:
        expected = ", ".join(str(size) for size in (*lead, *spec.shape))
        raise ValueError(f"{name} must have shape ({expected}) with n={n_nodes}, m={n_agents}, got {array.shape}")
    may_be_infinite = spec.high == math.inf
    bad = np.isnan(array) if may_be_infinite else ~np.isfinite(array)
    if bad.any():
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(f"{name} must be {'numbers' if may_be_infinite else 'finite'}, got {array[at]} at {at}")
    if array.size and not _in_range(spec, array):
        hint = "; from_coordinates(xy, n_agents) brings any coordinates there and keeps the scale" * (name == "nodes")
        values = f"a range of [{array.min():g}, {array.max():g}]"
        raise ValueError(f"{name} must be {_describe_range(spec)}, got {values}{hint}")
    if spec.zero_at_depot and array[..., 0].any():
        raise ValueError(f"{name} must be 0 at the depot, got {array[..., 0].max():g}")
    wrong = spec.check(array) if spec.check else None
    if wrong is not None:
        raise ValueError(f"{name}: {wrong}, got {array.tolist()}")


def _in_range(spec: ArrayField, array: np.ndarray) -> bool:
    least, greatest = array.min(), array.max()
    above = spec.low is None or least > spec.low or (spec.low_allowed and least == spec.low)
    return bool(above and (spec.high is None or greatest <= spec.high))


def _describe_range(spec: ArrayField) -> str:
    if spec.high is not None and math.isfinite(spec.high):
        return f"in [{spec.low:g}, {spec.high:g}]"
    return f"{'at least' if spec.low_allowed else 'above'} {spec.low:g}"


def check_plain(problem: Instance | Problem) -> None:
    """Raise ValueError if the problem has world fields."""
    arrays = problem.arrays() if isinstance(problem, Instance) else problem.arrays
    world = [name for name in WORLD_FIELDS if name in arrays]
    if world:
        raise ValueError(f"only plain problems can be solved and bounded, this one has the world fields {world}")


def check_plannable(world: Sequence[str]) -> None:
    """Raise ValueError if no tours can be planned in advance in a world with these fields, because it changes."""
    changing = [name for name in world if name not in ("speeds", "service")]
    if changing:
        raise ValueError(
            f"tours cannot be planned in advance in a world with {changing}: mtsp_env.replan.Replanner plans again "
            "whenever something happens"
        )


def from_coordinates(xy: np.ndarray | Sequence, n_agents: int, name: str = "") -> Instance:
    """Bring any planar coordinates (n, 2) to the unit square; ``scale`` keeps their units.

    Raises:
        ValueError: fewer than two points, not of shape (n, 2), not finite, or so far apart that lengths overflow.
    """
    xy = _as_numbers("coordinates", xy)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError(f"coordinates must have shape (n, 2), got {xy.shape}")
    check_count("n_nodes", len(xy), minimum=2)
    if not np.isfinite(xy).all():
        raise ValueError("coordinates must be finite")
    corner = xy.min(axis=0)
    with np.errstate(over="ignore"):
        extent = float((xy.max(axis=0) - corner).max()) or 1.0  # all nodes in one place: nothing to scale
    if not extent <= _largest_scale(len(xy)):
        raise ValueError(f"coordinates must span at most {_largest_scale(len(xy)):g}, got {extent:g}")
    return Instance(np.clip((xy - corner) / extent, 0.0, 1.0), n_agents, name, extent)


def _read_only_copy(name: str, values: object) -> np.ndarray:
    array = _as_numbers(name, values) + 0.0  # a copy that nobody else can change; -0.0 becomes 0.0
    array.flags.writeable = False
    return array


def _as_numbers(name: str, values: object) -> np.ndarray:
    try:
        if isinstance(values, (list, tuple)):  # NumPy would read "1" and True as 1.0
            kinds = set(map(type, np.asarray(values, dtype=object).ravel()))
            if unwanted := kinds & {bool, np.bool_, str, np.str_, bytes}:
                raise ValueError(f"a {unwanted.pop().__name__} in it")
        elif np.asarray(values).dtype.kind not in "iuf":
            raise ValueError(f"its dtype is {np.asarray(values).dtype}")
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be an array of numbers, got {type(values).__name__}: {error}") from error


def _largest_scale(n_nodes: int) -> float:
    """The scale up to which lengths are finite: no tour of n nodes is longer than 2 n sides of the unit square."""
    return sys.float_info.max / (2 * n_nodes)


def _check_scale(scale: Any, n_nodes: int) -> float:
    try:
        value = math.nan if isinstance(scale, (str, bool)) else float(scale)
    except (TypeError, ValueError, OverflowError):
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"scale must be a finite number above 0, got {scale!r}")
    if value > _largest_scale(n_nodes):
        raise ValueError(f"scale must be at most {_largest_scale(n_nodes):g}, got {value:g}: lengths would overflow")
    return value
