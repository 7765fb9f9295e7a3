"""What a game is made of: its rules, its state, and what an agent sees. ``rules.py`` says how it is played."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_type_hints

from mtsp_env.arrays import at_least, cast, library
from mtsp_env.checks import check_count
from mtsp_env.instance import FIELDS, Array, ArrayField, Problem

Depot = Literal["open", "wait", "final"]
Reward = Literal["sparse", "shaped"]

DEPOTS: tuple[str, ...] = ("open", "wait", "final")
REWARDS: tuple[str, ...] = ("sparse", "shaped")
TICK_TOLERANCE = 1e-9  # a time within this of a whole number of ticks counts as that number
NEVER = 2**62  # tick of an event that does not come; ready tick of an agent that is closed or not yet woken
BROKEN = NEVER + 1  # ready tick of a broken agent: it sorts after all others even if all of them wait


@dataclass(frozen=True)
class Rules:
    """The settings of a game.

    Attributes:
        speed: distance per tick (the paper's Delta g: 0.1 in training, 0.01 in tests), at least 1e-9.
        depot: "open" (the paper): the depot is always legal, and an agent that picks it there waits one tick. "wait":
            as "open", but such an agent is asked again only when something happens: at the first later tick at which
            an agent that is not waiting decides, a city appears or an agent breaks down. "final": picking the depot
            ends that agent's tour, so that an episode takes at most n - 1 + m decisions.
        reward: "sparse": -makespan at the end. "shaped": each decision pays the change of -(makespan if everybody went
            home now); the sum is the same.
        max_decisions: an episode is truncated after so many; a sensible policy never meets 20 (n + m).
        view: an agent knows the nearest ``view`` open cities only; at least 1. None: all of them.
        hearing: an agent knows those agents only whose destination is at most this far from it; at least 0. None: all.

    Raises:
        ValueError: a value outside its range.
    """

    speed: float
    depot: Depot
    reward: Reward
    max_decisions: int
    view: int | None = None
    hearing: float | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and self.speed >= 1e-9):
            raise ValueError(f"speed must be a finite distance per tick of at least 1e-9, got {self.speed!r}")
        if self.depot not in DEPOTS:
            raise ValueError(f"unknown depot rule {self.depot!r}; choose from {list(DEPOTS)}")
        if self.reward not in REWARDS:
            raise ValueError(f"unknown reward {self.reward!r}; choose from {list(REWARDS)}")
        check_count("max_decisions", self.max_decisions, minimum=1)
        if self.view is not None:
            check_count("view", self.view, minimum=1)
        if self.hearing is not None and not (math.isfinite(self.hearing) and self.hearing >= 0.0):
            raise ValueError(f"hearing must be a finite distance of at least 0, or None, got {self.hearing!r}")


def make_rules(
    n_nodes: int,
    n_agents: int,
    speed: float,
    depot: Depot,
    reward: Reward,
    max_decisions: int | None,
    view: int | None = None,
    hearing: float | None = None,
) -> Rules:
    """Validated ``Rules`` for games of this size; ``max_decisions=None`` means 20 (n + m)."""
    check_count("n_nodes", n_nodes, minimum=2)
    check_count("n_agents", n_agents, minimum=1)
    limit = 20 * (n_nodes + n_agents) if max_decisions is None else max_decisions
    return Rules(speed, depot, reward, limit, view, hearing)


def check_world(fields: Iterable[str], rules: Rules) -> None:
    """Raise ValueError if a world with these fields cannot be played by these rules."""
    changing = [name for name in ("appears", "breaks") if name in fields]
    if rules.depot == "final" and changing:
        raise ValueError(
            f'depot "final" cannot be played in a world with {changing}, where a closed tour may have to be opened '
            'again; choose "open" or "wait"'
        )


class State(NamedTuple):
    """A batch of B games; ``STATE_FIELDS`` has the dtypes and shapes of its arrays.

    Most of it could be derived from the problem and the decisions made, but keeping it costs less than deriving it.
    The last fields are None unless the problem has the world field that needs them.
    """

    problem: Problem
    seen_nodes: Annotated[Array, ArrayField("float32", ("n", 2), "the nodes, as observations are computed from them")]
    visited: Annotated[
        Array,
        ArrayField("bool", ("n",), "the global mask M: a city counts once an agent sets off for it, the depot never"),
    ]
    cities_left: Annotated[Array, ArrayField("int64", (), "number of unvisited cities")]
    visits: Annotated[Array, ArrayField("int32", ("n",), "who visited a city, and in which order; -1: unvisited")]
    destination: Annotated[Array, ArrayField("int64", ("m",), "node at which an agent is or to which it travels")]
    leg: Annotated[Array, ArrayField("float64", ("m",), "announced time of its current leg and of the visit after it")]
    departed: Annotated[Array, ArrayField("int64", ("m",), "tick at which it set off on that leg")]
    ready: Annotated[
        Array, ArrayField("int64", ("m",), "tick at which it decides next; NEVER: closed, or yet to be woken; BROKEN")
    ]
    own_time: Annotated[
        Array, ArrayField("float64", ("m",), "its own time after the current leg; if plain, its tour's length so far")
    ]
    decisions: Annotated[Array, ArrayField("int64", (), "decisions made so far")]
    legs: Annotated[Array, ArrayField("int64", ("m",), "number of legs that it has begun", needs="traffic")] = None
    appear_tick: Annotated[
        Array, ArrayField("int64", ("n",), "tick from which everybody knows a node", needs="appears")
    ] = None
    break_tick: Annotated[
        Array, ArrayField("int64", ("m",), "tick at which an agent stops for good, or NEVER", needs="breaks")
    ] = None
    arrival: Annotated[
        Array, ArrayField("int64", ("m",), "tick at which it arrives at its destination", needs="breaks")
    ] = None
    alive: Annotated[Array, ArrayField("bool", ("m",), "whether it has not broken down", needs="breaks")] = None

    def arrays(self) -> dict[str, Array]:
        """Every array of the problem and of the state, by name."""
        fields = zip(STATE_FIELDS, self[1:], strict=True)
        return {**self.problem.arrays, **{name: array for name, array in fields if array is not None}}


STATE_FIELDS: dict[str, ArrayField] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(State, include_extras=True).items()
    if hasattr(hint, "__metadata__")
}


def state_fields(world: Iterable[str]) -> dict[str, ArrayField]:
    """Those of ``STATE_FIELDS`` that the games of a problem with these world fields have."""
    world = set(world)
    return {name: field for name, field in STATE_FIELDS.items() if field.needs is None or field.needs in world}


def state_from_arrays(arrays: Mapping[str, Array], n_agents: int) -> State:
    """The state whose ``arrays()`` are given; further keys are ignored."""
    problem = Problem(n_agents, {name: arrays[name] for name in FIELDS if name in arrays})
    return State(problem, *(arrays.get(name) for name in STATE_FIELDS))


class Observation(NamedTuple):
    """What one agent per row sees (paper, Sec. 4, Observation). Times and lengths are float32, masks bool.

    The last fields are None unless the world, or an option of the rules, needs them.
    """

    cities: Array  # (B, n, 2)   node coordinates minus its own; those of an unknown city are the depot's
    agents: Array  # (B, m, 3)   every agent's destination minus its own position, and its remaining time g
    visited: Array  # (B, n)     the global mask M; the depot never counts as visited, an unknown city always
    action_mask: Array  # (B, n) its legal next nodes
    agent: Array  # (B,)         its index, int64
    agent_speeds: Array = None  # (B, m)  worlds with `speeds`: every agent's speed
    agent_alive: Array = None  # (B, m)   worlds with `breaks`: who has not broken down
    service: Array = None  # (B, n)       worlds with `service`: how long a visit takes; 0 for an unknown city
    agent_known: Array = None  # (B, m)   with `hearing`: of whom it hears
    city_known: Array = None  # (B, n)    worlds with `appears`, or with `view`: the nodes that it knows

    def arrays(self) -> dict[str, Array]:
        """The arrays that it has, by name."""
        return {name: array for name, array in zip(self._fields, self, strict=True) if array is not None}


OBSERVED: dict[str, ArrayField] = {
    "agent_speeds": ArrayField("float32", ("m",), "every agent's speed", needs="speeds"),
    "agent_alive": ArrayField("bool", ("m",), "0: it has broken down", needs="breaks"),
    "service": ArrayField("float32", ("n",), "time that a visit takes; 0 for an unknown city", needs="service"),
    "agent_known": ArrayField("bool", ("m",), "0: it is not heard, and looks as if it stood at the depot"),
    "city_known": ArrayField("bool", ("n",), "0: it is unknown, looks visited and lies on the depot", needs="appears"),
}
"""The extra keys of an observation, in the order of ``Observation``."""


def observed_fields(world: Iterable[str], rules: Rules) -> dict[str, ArrayField]:
    """Those of ``OBSERVED`` that observations have in a world with these fields."""
    options = {"agent_known": rules.hearing, "city_known": rules.view}
    world = set(world)
    return {name: field for name, field in OBSERVED.items() if field.needs in world or options.get(name) is not None}


def travel_ticks(time: Array, speed: float) -> Array:
    """Ticks that a leg takes: max(1, ceil(time / speed)), int64. A stay takes one tick."""
    return cast(at_least(library(time)[0].ceil(time / speed - TICK_TOLERANCE), 1.0), "int64")
