"""The rules of the MinMax mTSP as a game of asynchronous decisions (paper, Sec. 4 and Algorithm 1).

Pure functions over arrays with a leading batch dimension B, written against the Python array API: NumPy arrays (the
PettingZoo environment, B = 1) and torch tensors (the batched TorchRL environment) run the same lines; the primitives
that differ stand together below. The clock is event-driven: instead of looping over ticks, the next to decide is the
agent with the smallest (ready tick, index).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from array_api_compat import array_namespace, device

from mtsp_env.instance import Tours, check_count

Array = Any  # a NumPy array or a torch tensor
Depot = Literal["open", "final"]
Reward = Literal["sparse", "shaped"]

DEPOTS: tuple[str, ...] = ("open", "final")
REWARDS: tuple[str, ...] = ("sparse", "shaped")
TICK_TOLERANCE = 1e-9  # a leg within this of a whole number of ticks counts as that number
NEVER = 2**62  # ready tick of an agent whose tour is closed for good (depot "final")


@dataclass(frozen=True)
class Rules:
    """The settings of a game.

    Attributes:
        speed: distance per tick (the paper's Delta g: 0.1 in training, 0.01 in tests), at least 1e-9.
        depot: "open" (the paper): the depot is always legal, picking it there waits one tick. "final": picking the
            depot ends that agent's tour, so that an episode takes at most n - 1 + m decisions.
        reward: "sparse": -makespan at the end. "shaped": each decision pays the change of -(longest closed tour so
            far); the sum is the same.
        max_decisions: an episode is truncated after so many; a sensible policy never meets 20 (n + m).

    Raises:
        ValueError: a value outside its range.
    """

    speed: float
    depot: Depot
    reward: Reward
    max_decisions: int

    def __post_init__(self) -> None:
        if not (math.isfinite(self.speed) and self.speed >= 1e-9):
            raise ValueError(f"speed must be a finite distance per tick of at least 1e-9, got {self.speed!r}")
        if self.depot not in DEPOTS:
            raise ValueError(f"unknown depot rule {self.depot!r}; choose from {list(DEPOTS)}")
        if self.reward not in REWARDS:
            raise ValueError(f"unknown reward {self.reward!r}; choose from {list(REWARDS)}")
        check_count("max_decisions", self.max_decisions, minimum=1)


def make_rules(
    n_nodes: int, n_agents: int, speed: float, depot: Depot, reward: Reward, max_decisions: int | None
) -> Rules:
    """Validated ``Rules`` for games of this size; ``max_decisions=None`` means 20 (n + m)."""
    check_count("n_nodes", n_nodes, minimum=2)
    check_count("n_agents", n_agents, minimum=1)
    return Rules(speed, depot, reward, 20 * (n_nodes + n_agents) if max_decisions is None else max_decisions)


class State(NamedTuple):
    """A batch of games. Lengths are float64, ticks, counts and indices int64.

    ``home``, ``visited``, ``cities_left`` and ``trips`` could be derived; to keep them costs less.
    """

    nodes: Array  # (B, n, 2)  coordinates; row 0 is the depot
    home: Array  # (B, n)      distance from each to the depot
    visited: (
        Array  # (B, n)   bool, the global mask M: a city counts from when an agent sets off for it, the depot never
    )
    cities_left: Array  # (B,) number of unvisited cities
    trips: Array  # (B,)       length of out-and-back trips from the depot to all of them
    visits: Array  # (B, n)    who visited a city and when, see `_visit_code`; -1: not visited (the depot: always)
    destination: Array  # (B, m)  node that an agent stands at or heads for
    leg: Array  # (B, m)       length of its current leg
    departed: Array  # (B, m)  tick at which it set off on that leg
    ready: Array  # (B, m)     tick at which it arrives and decides; NEVER: its tour is closed
    length: Array  # (B, m)    length of its tour so far, the current leg included
    decisions: Array  # (B,)   decisions made so far
    agent: Array  # (B,)       who decides next


class Observation(NamedTuple):
    """What one agent per row sees (paper, Sec. 4, Observation). Lengths are float32, masks bool."""

    cities: Array  # (B, n, 2)   node coordinates minus its own
    agents: Array  # (B, m, 3)   every agent's destination minus its own position, and its remaining travel distance g
    visited: Array  # (B, n)     the global mask M; the depot never counts as visited
    action_mask: Array  # (B, n) its legal next nodes


def start(nodes: Array, n_agents: int) -> State:
    """All agents at the depot at tick 0, no city visited; ``nodes`` is float64 (B, n, 2)."""
    xp, on = _library(nodes)
    batch, n_nodes = nodes.shape[0], nodes.shape[1]

    def zeros(*shape, dtype=xp.int64):
        return xp.zeros(shape, dtype=dtype, device=on)

    home = _norm(_minus(nodes, nodes[:, 0]))
    return State(
        nodes=nodes,
        home=home,
        visited=zeros(batch, n_nodes, dtype=xp.bool),
        cities_left=zeros(batch) + (n_nodes - 1),
        trips=xp.sum(2.0 * home, axis=1),
        visits=zeros(batch, n_nodes) - 1,
        destination=zeros(batch, n_agents),
        leg=zeros(batch, n_agents, dtype=xp.float64),
        departed=zeros(batch, n_agents),
        ready=zeros(batch, n_agents),
        length=zeros(batch, n_agents, dtype=xp.float64),
        decisions=zeros(batch),
        agent=zeros(batch),
    )


def agent_to_decide(ready: Array) -> Array:
    """(B,) The agent with the smallest (ready tick, index); argmin returns the first of equals."""
    return ready.argmin(1)


def now(state: State) -> Array:
    """(B,) int64: the clock, the tick of the decision at hand."""
    return _pick(state.ready, state.agent)


def all_visited(state: State) -> Array:
    """(B,) bool: the game is over, all agents terminate at once."""
    return state.cities_left == 0


def legal_actions(state: State, rules: Rules, agent: Array) -> Array:
    """(B, n) bool: the nodes that ``agent`` (B,) may pick: unvisited cities, and the depot by ``rules.depot``.

    "open": always, unless all agents stand at the depot and cities remain, so that something moves.
    "final": not before the agent's first city, nor by the last agent still out while cities remain.
    When every city is visited only the depot is legal, so a mask is never empty.
    """
    mask = ~state.visited  # (B, n)
    if rules.depot == "open":
        underway = (state.leg > 0) & (state.ready > now(state)[:, None])
        depot = ((state.destination != 0) | underway).any(1)
    else:
        has_left = _pick(state.destination, agent) != 0
        depot = has_left & ((state.ready < NEVER).sum(1) > 1)
    mask[:, 0] = depot | all_visited(state)
    return mask


def observe(state: State, rules: Rules, agent: Array | None = None) -> Observation:
    """What ``agent`` (B,) sees, by default the one to decide.

    Algorithm 1 lowers g inside the loop over agents, so agent i sees the agents before it (j < i) one tick further on.
    An agent underway sees the world from its destination, where it will decide next; a decider's own row is (0, 0, 0).
    """
    xp, _ = _library(state.nodes)
    agent = state.agent if agent is None else agent
    nodes = xp.astype(state.nodes, xp.float32)  # before the difference: half the bytes, and an error of 1e-7 at most
    cities = _minus(nodes, _pick(nodes, _pick(state.destination, agent)))  # (B, n, 2)
    heading = _pick_many(cities, state.destination)  # (B, m, 2)

    before = _indices(state.ready, axis=1) < agent[:, None]  # (B, m): j < i
    tick = now(state)[:, None] + before  # (B, m)
    elapsed = xp.astype(tick - state.departed, xp.float64) + TICK_TOLERANCE
    remaining = (state.leg - rules.speed * elapsed).clip(0.0)

    return Observation(
        cities=cities,
        agents=xp.concat([heading, xp.astype(remaining, xp.float32)[:, :, None]], axis=2),
        visited=state.visited,
        action_mask=legal_actions(state, rules, agent),
    )


def depart(state: State, rules: Rules, action: Array) -> State:
    """The deciding agents set off for ``action`` (B,); the clock moves on to the next decision.

    The caller has checked that the actions are legal. In a finished game only the depot is left to pick, which changes
    neither the makespan nor the tours.
    """
    agent, here, tick = state.agent, _pick(state.destination, state.agent), now(state)
    leg, is_city = _norm(_pick(state.nodes, action) - _pick(state.nodes, here)), action != 0
    arrival = tick + travel_ticks(leg, rules.speed)
    if rules.depot == "final":
        arrival = _library(arrival)[0].where(is_city, arrival, NEVER)
    visits = _put(state.visits, action, _visit_code(state.decisions, agent, here == 0, state.ready.shape[1]))
    visits[:, 0] = -1  # the depot is never marked
    ready = _put(state.ready, agent, arrival)
    return State(
        nodes=state.nodes,
        home=state.home,
        visited=_put(state.visited, action, is_city),
        cities_left=state.cities_left + ~is_city - 1,
        trips=state.trips - 2.0 * _pick(state.home, action),
        visits=visits,
        destination=_put(state.destination, agent, action),
        leg=_put(state.leg, agent, leg),
        departed=_put(state.departed, agent, tick),
        ready=ready,
        length=_put(state.length, agent, _pick(state.length, agent) + leg),
        decisions=state.decisions + 1,
        agent=agent_to_decide(ready),
    )


def travel_ticks(leg: Array, speed: float) -> Array:
    """Ticks that a leg takes: max(1, ceil(leg / speed)), int64. A stay takes one tick."""
    xp, _ = _library(leg)
    return xp.astype(xp.ceil(leg / speed - TICK_TOLERANCE).clip(1.0), xp.int64)


def makespan(state: State) -> Array:
    """(B,) float64: the longest tour so far, every agent's return leg counted."""
    return _library(state.length)[0].max(state.length + _pick_many(state.home, state.destination), axis=1)


def truncated(state: State, rules: Rules) -> Array:
    """(B,) bool: the game was cut off at ``max_decisions`` with cities left."""
    return (state.decisions >= rules.max_decisions) & (state.cities_left > 0)


def final_cost(state: State, rules: Rules) -> Array:
    """(B,) float64: minus an episode's rewards. The makespan; where the game was cut off, out-and-back trips to all
    unvisited cities on top, so that stalling never pays."""
    return makespan(state) + _library(state.trips)[0].where(truncated(state, rules), state.trips, 0.0)


def reward(before: State, after: State, rules: Rules) -> Array:
    """(B,) float64: what the decision between two states pays to every agent alike (paper, Sec. 4, Reward)."""
    cost = final_cost(after, rules)
    if rules.reward == "shaped":
        return makespan(before) - cost
    over = all_visited(after) | truncated(after, rules)
    return _library(cost)[0].where(over, -cost, 0.0)


# The two libraries. What is quick in the one is slow in the other, or missing from the array API: NumPy with one row
# (the PettingZoo environment) is several times faster by slices than by arrays of indices; torch by `gather`, and by
# complex numbers than by broadcasting over an axis of two.

_NUMPY = array_namespace(np.empty(0)), "cpu"


def _library(array: Array) -> tuple[Any, Any]:
    """The array's (namespace, device)."""
    return _NUMPY if type(array) is np.ndarray else (array_namespace(array), device(array))


@lru_cache(maxsize=64)
def _range(xp: Any, size: int, on: Any) -> Array:
    return xp.arange(size, device=on)  # shared by all callers: only to be read


def _indices(array: Array, axis: int) -> Array:
    """(array.shape[axis],) int64: 0, 1, 2, ... on the array's device."""
    xp, on = _library(array)
    return _range(xp, array.shape[axis], on)


def _pick(array: Array, column: Array) -> Array:
    """(B, ...) Row b's entry ``column[b]`` of an array (B, k, ...)."""
    if type(array) is np.ndarray and len(array) == 1:
        return array[:, column[0]]
    return array[_indices(column, axis=0), column]


def _pick_many(array: Array, columns: Array) -> Array:
    """(B, m, ...) Row b's entries ``columns[b]``, with ``columns`` (B, m), of an array (B, k, ...)."""
    if type(array) is not np.ndarray:
        return array.gather(1, columns if array.ndim == 2 else columns[:, :, None].expand(-1, -1, array.shape[2]))
    if len(array) == 1:
        return array.take(columns[0], axis=1)
    return array[_indices(columns, axis=0)[:, None], columns]


def _minus(points: Array, origin: Array) -> Array:
    """(B, k, 2) Points (B, k, 2) as seen from row b's origin (B, 2)."""
    if type(points) is np.ndarray:
        return points - origin[:, None]
    xp, _ = _library(points)
    return xp.view_as_real(xp.view_as_complex(points) - xp.view_as_complex(origin)[:, None])


def _put(array: Array, column: Array, value: Array) -> Array:
    """A copy of an array (B, k) in which row b's entry ``column[b]`` is ``value[b]``."""
    if type(array) is np.ndarray and len(array) == 1:
        array = array.copy()
        array[:, column[0]] = value
    else:
        array = array.copy() if type(array) is np.ndarray else array.clone()
        array[_indices(column, axis=0), column] = value
    return array


def _norm(vector: Array) -> Array:
    """(...) Lengths of the vectors (..., 2)."""
    square = vector * vector
    return _library(vector)[0].sqrt(square[..., 0] + square[..., 1])


# Tours are kept in `visits` as one number per city, so that a state has a fixed shape however long its tours are:
# decision * 2m + agent * 2 + (1 where the agent came straight from the depot). Sorted, they spell out the tours.


def _visit_code(decision: Array, agent: Array, from_depot: Array, n_agents: int) -> Array:
    return (decision * n_agents + agent) * 2 + from_depot


def tours(visits: np.ndarray, destination: np.ndarray, close: bool = True) -> Tours:
    """The tours of one game so far, from its rows of ``visits`` (n,) and ``destination`` (m,), as NumPy arrays.

    ``close`` appends the return leg to a tour whose agent is still out; an agent that never left has [0, 0], or [0]
    where tours stay open. Waiting at the depot does not repeat it.
    """
    n_agents = len(destination)
    found: Tours = [[0] for _ in range(n_agents)]
    order = np.argsort(visits)
    for city in order[np.searchsorted(visits, 0, sorter=order) :].tolist():
        code = int(visits[city])
        tour = found[code // 2 % n_agents]
        if code % 2 and tour[-1] != 0:
            tour.append(0)
        tour.append(city)
    for tour, node in zip(found, destination.tolist(), strict=True):
        if (tour[-1] != 0 and (close or node == 0)) or (close and len(tour) == 1):
            tour.append(0)
    return found
