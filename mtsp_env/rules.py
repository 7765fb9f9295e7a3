"""The rules of the MinMax mTSP as a game of asynchronous decisions (paper, Sec. 4 and Algorithm 1).

Pure functions over arrays with a leading batch dimension B, written against the Python array API: NumPy arrays (the
PettingZoo environment, B = 1; the batched environment on a CPU) and torch tensors (the batched environment on a GPU, or
compiled) run the same lines; ``arrays.py`` holds the primitives that differ. The clock is event-driven: instead of
looping over ticks, the next to decide is the agent with the smallest (ready tick, index).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_type_hints

import numpy as np

from mtsp_env.arrays import append, at_least, cast, indices, library, locate, minus, norm, pick, pick_many, put
from mtsp_env.checks import check_count
from mtsp_env.instance import FIELDS, Array, ArrayField, Problem, Tours, check_plain

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
    """A batch of B games; ``STATE_FIELDS`` has the dtypes and shapes of its arrays.

    Most of it could be derived from the problem and the decisions made, but keeping it costs less than deriving it.
    """

    problem: Problem
    seen_nodes: Annotated[Array, ArrayField("float32", ("n", 2), "the nodes, as observations are computed from them")]
    visited: Annotated[
        Array,
        ArrayField("bool", ("n",), "the global mask M: a city counts once an agent sets off for it, the depot never"),
    ]
    cities_left: Annotated[Array, ArrayField("int64", (), "number of unvisited cities")]
    visits: Annotated[
        Array, ArrayField("int32", ("n",), "who visited a city, and in which order; -1: unvisited; see _visit_code")
    ]
    destination: Annotated[Array, ArrayField("int64", ("m",), "node at which an agent is or to which it travels")]
    leg: Annotated[Array, ArrayField("float64", ("m",), "length of its current leg")]
    departed: Annotated[Array, ArrayField("int64", ("m",), "tick at which it set off on that leg")]
    ready: Annotated[Array, ArrayField("int64", ("m",), "tick at which it decides next; NEVER: its tour is closed")]
    length: Annotated[Array, ArrayField("float64", ("m",), "length of its tour so far, the current leg included")]
    closed: Annotated[Array, ArrayField("int64", (), 'number of agents whose tour is closed (depot "final")')]
    decisions: Annotated[Array, ArrayField("int64", (), "decisions made so far")]

    def arrays(self) -> dict[str, Array]:
        """Every array of the problem and of the state, by name."""
        return {**self.problem.arrays, **dict(zip(STATE_FIELDS, self[1:], strict=True))}


STATE_FIELDS: dict[str, ArrayField] = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(State, include_extras=True).items()
    if hasattr(hint, "__metadata__")
}


def state_from_arrays(arrays: Mapping[str, Array], n_agents: int) -> State:
    """The state whose ``arrays()`` are given; further keys are ignored."""
    problem = Problem(n_agents, {name: arrays[name] for name in FIELDS if name in arrays})
    return State(problem, *(arrays[name] for name in STATE_FIELDS))


class Observation(NamedTuple):
    """What one agent per row sees (paper, Sec. 4, Observation). Lengths are float32, masks bool."""

    cities: Array  # (B, n, 2)   node coordinates minus its own
    agents: Array  # (B, m, 3)   every agent's destination minus its own position, and its remaining travel distance g
    visited: Array  # (B, n)     the global mask M; the depot never counts as visited
    action_mask: Array  # (B, n) its legal next nodes
    agent: Array  # (B,)         its index, int64


def start(problem: Problem) -> State:
    """All agents at the depot at tick 0, no city visited.

    Raises:
        ValueError: the problem has world fields, or n m is 2^30 or more (``visits`` would overflow).
    """
    check_plain(problem)
    nodes, n_agents = problem.nodes, problem.n_agents
    xp, on = library(nodes)
    batch, n_nodes = nodes.shape[0], nodes.shape[1]
    if n_nodes * n_agents >= 2**30:
        raise ValueError(f"n_nodes * n_agents must be below 2^30, got {n_nodes} * {n_agents}")

    def zeros(*shape: int, dtype: object = xp.int64) -> Array:
        return xp.zeros(shape, dtype=dtype, device=on)

    return State(
        problem=problem,
        seen_nodes=xp.astype(nodes, xp.float32),
        visited=zeros(batch, n_nodes, dtype=xp.bool),
        cities_left=zeros(batch) + (n_nodes - 1),
        visits=zeros(batch, n_nodes, dtype=xp.int32) - 1,
        destination=zeros(batch, n_agents),
        leg=zeros(batch, n_agents, dtype=xp.float64),
        departed=zeros(batch, n_agents),
        ready=zeros(batch, n_agents),
        length=zeros(batch, n_agents, dtype=xp.float64),
        closed=zeros(batch),
        decisions=zeros(batch),
    )


def agent_to_decide(state: State) -> Array:
    """(B,) int64: the agent with the smallest (ready tick, index); argmin returns the first of equals."""
    return state.ready.argmin(1)


def now(state: State) -> Array:
    """(B,) int64: the clock, the tick of the decision at hand."""
    return pick(state.ready, locate(agent_to_decide(state), state.ready.shape[1]))


def all_visited(state: State) -> Array:
    """(B,) bool: the game is over, all agents terminate at once."""
    return state.cities_left == 0


def legal_actions(state: State, rules: Rules, agent: Array, here: Array | None = None) -> Array:
    """(B, n) bool: the nodes that ``agent`` (B,) may pick: unvisited cities, and the depot by ``rules.depot``.

    "open": always, unless all agents stand at the depot and cities remain, so that something moves.
    "final": not before the agent's first city, nor by the last agent still out while cities remain.
    When every city is visited only the depot is legal, so a mask is never empty. ``here`` (B,) is the node of
    ``agent``, if that is known already.
    """
    mask = ~state.visited  # (B, n)
    if rules.depot == "open":
        underway = (state.leg > 0) & (state.ready > now(state)[:, None])
        depot = ((state.destination != 0) | underway).any(1)
    else:
        here = pick(state.destination, locate(agent, state.ready.shape[1])) if here is None else here
        depot = (here != 0) & (state.closed < state.ready.shape[1] - 1)
    mask[:, 0] = depot | all_visited(state)
    return mask


def are_legal(action: Array, action_mask: Array) -> Array:
    """(B,) bool: whether each ``action`` (B,) is a node that its row of ``action_mask`` (B, n) allows."""
    n_nodes = action_mask.shape[1]
    if type(action) is np.ndarray and action.min() >= 0 and action.max() < n_nodes:
        return pick(action_mask, locate(action, n_nodes))
    inside = (action >= 0) & (action < n_nodes)
    return inside & pick(action_mask, locate(action * inside, n_nodes))


def observe(state: State, rules: Rules, agent: Array | None = None) -> Observation:
    """What ``agent`` (B,) sees, by default the one to decide.

    Algorithm 1 lowers g inside the loop over agents, so agent i sees the agents before it (j < i) one tick further on.
    An agent underway sees the world from its destination, where it will decide next; a decider's own row is (0, 0, 0).
    """
    decider = agent_to_decide(state)
    agent = decider if agent is None else agent
    n_nodes, n_agents = state.visited.shape[1], state.ready.shape[1]
    tick = pick(state.ready, locate(decider, n_agents))
    here = pick(state.destination, locate(agent, n_agents))
    cities = minus(state.seen_nodes, pick(state.seen_nodes, locate(here, n_nodes)))  # (B, n, 2)
    heading = pick_many(cities, state.destination)  # (B, m, 2)

    before = indices(state.ready, axis=1) < agent[:, None]  # (B, m): j < i
    elapsed = cast(tick[:, None] + before - state.departed, "float64") + TICK_TOLERANCE
    remaining = at_least(state.leg - rules.speed * elapsed, 0.0)  # (B, m)

    return Observation(
        cities=cities,
        agents=append(heading, remaining),
        visited=state.visited,
        action_mask=legal_actions(state, rules, agent, here),
        agent=agent,
    )


def depart(state: State, rules: Rules, action: Array, agent: Array | None = None) -> State:
    """``agent`` (B,), by default the one to decide, sets off for ``action`` (B,) when it is ready.

    The caller has checked that the actions are legal. In a finished game only the depot is left to pick, which changes
    neither the makespan nor the tours.
    """
    nodes, n_nodes, n_agents = state.problem.nodes, state.visited.shape[1], state.ready.shape[1]
    agent = agent_to_decide(state) if agent is None else agent
    own, goal = locate(agent, n_agents), locate(action, n_nodes)
    here, tick = pick(state.destination, own), pick(state.ready, own)
    leg, is_city = norm(pick(nodes, goal) - pick(nodes, locate(here, n_nodes))), action != 0
    arrival, closed = tick + travel_ticks(leg, rules.speed), state.closed
    if rules.depot == "final":
        arrival, closed = library(arrival)[0].where(is_city, arrival, NEVER), closed + ~is_city
    return State(
        problem=state.problem,
        seen_nodes=state.seen_nodes,
        visited=put(state.visited, goal, is_city),
        cities_left=state.cities_left - cast(is_city, "int64"),
        visits=put(state.visits, goal, _visit_code(n_nodes - state.cities_left, agent, here == 0, n_agents)),
        destination=put(state.destination, own, action),
        leg=put(state.leg, own, leg),
        departed=put(state.departed, own, tick),
        ready=put(state.ready, own, arrival),
        length=put(state.length, own, pick(state.length, own) + leg),
        closed=closed,
        decisions=state.decisions + 1,
    )


def travel_ticks(leg: Array, speed: float) -> Array:
    """Ticks that a leg takes: max(1, ceil(leg / speed)), int64. A stay takes one tick."""
    return cast(at_least(library(leg)[0].ceil(leg / speed - TICK_TOLERANCE), 1.0), "int64")


def makespan(state: State) -> Array:
    """(B,) float64: the longest tour so far, every agent's return leg counted."""
    nodes = state.problem.nodes
    way_home = norm(pick_many(nodes, state.destination) - nodes[:, :1])  # (B, m)
    return library(state.length)[0].max(state.length + way_home, axis=1)


def truncated(state: State, rules: Rules) -> Array:
    """(B,) bool: the game was cut off at ``max_decisions`` with cities left."""
    return (state.decisions >= rules.max_decisions) & (state.cities_left > 0)


def final_cost(state: State, rules: Rules) -> Array:
    """(B,) float64: minus an episode's rewards: the makespan.

    If the game was cut off, out-and-back trips to all unvisited cities come on top, so that stalling never pays.
    """
    cost, cut_off = makespan(state), truncated(state, rules)
    if type(cut_off) is np.ndarray and not cut_off.any():
        return cost
    xp, nodes = library(cost)[0], state.problem.nodes
    trips = xp.sum(xp.where(state.visited, 0.0, 2.0 * norm(nodes - nodes[:, :1])), axis=1)
    return cost + xp.where(cut_off, trips, 0.0)


def reward(before: State, after: State, rules: Rules, over: Array | None = None) -> Array:
    """(B,) float64: what the decision between two states pays to every agent alike (paper, Sec. 4, Reward).

    ``over`` (B,) bool says whether the game is over after it, if that is known already.
    """
    if rules.reward == "shaped":
        return makespan(before) - final_cost(after, rules)
    over = all_visited(after) | truncated(after, rules) if over is None else over
    if type(over) is np.ndarray and not over.any():
        return np.zeros(len(over))  # most decisions: nothing to work out
    cost = final_cost(after, rules)
    return library(cost)[0].where(over, -cost, 0.0)


# Tours are kept in `visits` as one number per city, so that a state has a fixed shape however long its tours are:
# order * 2m + agent * 2 + (1 if the agent came straight from the depot), where the first city visited has order 1.
# Sorted, the numbers spell out the tours. The depot's entry means nothing.


def _visit_code(order: Array, agent: Array, from_depot: Array, n_agents: int) -> Array:
    """(B,) int32."""
    return cast((order * n_agents + agent) * 2 + from_depot, "int32")


def tours(visits: np.ndarray, destination: np.ndarray, close: bool = True) -> Tours:
    """The tours of one game so far, from its rows of ``visits`` (n,) and ``destination`` (m,), as NumPy arrays.

    ``close`` appends the return leg to a tour whose agent is still out; an agent that never left has [0, 0], or [0]
    if tours stay open. Waiting at the depot does not repeat it.
    """
    n_agents = len(destination)
    tours: Tours = [[0] for _ in range(n_agents)]
    visits = visits[1:]
    order = np.argsort(visits)
    for city in order[np.searchsorted(visits, 0, sorter=order) :].tolist():
        code = int(visits[city])
        tour = tours[code // 2 % n_agents]
        if code % 2 and tour[-1] != 0:
            tour.append(0)
        tour.append(city + 1)
    for tour, node in zip(tours, destination.tolist(), strict=True):
        if (tour[-1] != 0 and (close or node == 0)) or (close and len(tour) == 1):
            tour.append(0)
    return tours
