"""The rules of the MinMax mTSP as a game of asynchronous decisions (paper, Sec. 4 and Algorithm 1).

Pure functions over arrays with a leading batch dimension B, written against the Python array API: NumPy arrays (the
PettingZoo environment, B = 1) and torch tensors (the batched TorchRL environment) run the same lines. The clock is
event-driven: instead of looping over ticks, the next to decide is the agent with the smallest (ready tick, index).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
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
    """A batch of games. Lengths are float64, ticks and indices int64."""

    nodes: Array  # (B, n, 2)  coordinates; row 0 is the depot
    visits: Array  # (B, n)    who visited a city and when, as `_visit_code` packs it; -1: not visited (the depot: always)
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
    xp, on = array_namespace(nodes), device(nodes)
    batch, n_nodes = nodes.shape[0], nodes.shape[1]

    def zeros(*shape, dtype=xp.int64):
        return xp.zeros(shape, dtype=dtype, device=on)

    return State(
        nodes=nodes,
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
    return array_namespace(ready).argmin(ready, axis=1)


def visited(state: State) -> Array:
    """(B, n) bool: the paper's global mask M. A city counts as visited from when an agent sets off for it."""
    return state.visits >= 0


def all_visited(state: State) -> Array:
    """(B,) bool: the game is over, all agents terminate at once."""
    return array_namespace(state.visits).all(state.visits[:, 1:] >= 0, axis=1)


def legal_actions(state: State, rules: Rules, agent: Array) -> Array:
    """(B, n) bool: the nodes that ``agent`` (B,) may pick: unvisited cities, and the depot by ``rules.depot``.

    "open": always, unless all agents stand at the depot and cities remain, so that something moves.
    "final": not before the agent's first city, nor by the last agent still out while cities remain.
    When every city is visited only the depot is legal, so a mask is never empty.
    """
    xp = array_namespace(state.nodes)
    unvisited = state.visits < 0
    if rules.depot == "open":
        now = xp.min(state.ready, axis=1)[:, None]
        stands_at_depot = (state.destination == 0) & ((state.leg == 0) | (state.ready <= now))
        depot = ~xp.all(stands_at_depot, axis=1)
    else:
        has_left = state.destination[_rows(xp, agent), agent] != 0
        depot = has_left & (xp.sum(xp.astype(state.ready < NEVER, xp.int64), axis=1) > 1)
    depot = depot | ~xp.any(unvisited[:, 1:], axis=1)
    return xp.concat([depot[:, None], unvisited[:, 1:]], axis=1)


def observe(state: State, rules: Rules, agent: Array | None = None) -> Observation:
    """What ``agent`` (B,) sees, by default the one to decide.

    Algorithm 1 lowers g inside the loop over agents, so agent i sees the agents before it (j < i) one tick further on.
    An agent underway sees the world from its destination, where it will decide next; a decider's own row is (0, 0, 0).
    """
    xp, on = array_namespace(state.nodes), device(state.nodes)
    agent = state.agent if agent is None else agent
    rows = _rows(xp, agent)
    position = state.nodes[rows, state.destination[rows, agent]][:, None, :]  # (B, 1, 2)
    heading = state.nodes[rows[:, None], state.destination] - position  # (B, m, 2)

    now = xp.min(state.ready, axis=1)[:, None]
    before = xp.arange(state.ready.shape[1], device=on) < agent[:, None]  # (B, m): j < i
    elapsed = now - state.departed + xp.astype(before, xp.int64)
    remaining = state.leg - rules.speed * xp.astype(elapsed, xp.float64)
    remaining = xp.where((remaining > 0) & (elapsed < state.ready - state.departed), remaining, 0.0)

    agents = xp.concat([heading, remaining[:, :, None]], axis=2)
    return Observation(
        cities=xp.astype(state.nodes - position, xp.float32),
        agents=xp.astype(agents, xp.float32),
        visited=visited(state),
        action_mask=legal_actions(state, rules, agent),
    )


def depart(state: State, rules: Rules, action: Array) -> State:
    """The deciding agents set off for ``action`` (B,); the clock moves on to the next decision.

    The caller has checked that the actions are legal. In a finished game only the depot is left to pick, which changes
    neither the makespan nor the tours.
    """
    xp, on = array_namespace(state.nodes), device(state.nodes)
    rows, agent = _rows(xp, action), state.agent
    n_nodes, n_agents = state.visits.shape[1], state.ready.shape[1]

    here, now = state.destination[rows, agent], state.ready[rows, agent]
    step = state.nodes[rows, action] - state.nodes[rows, here]  # (B, 2)
    leg = xp.sqrt(step[:, 0] * step[:, 0] + step[:, 1] * step[:, 1])
    arrival = now + travel_ticks(leg, rules.speed)
    if rules.depot == "final":
        arrival = xp.where(action == 0, NEVER, arrival)

    mine = xp.arange(n_agents, device=on) == agent[:, None]  # (B, m)
    city = xp.where(action == 0, -1, action)  # the depot is never marked
    marked = xp.arange(n_nodes, device=on) == city[:, None]  # (B, n)
    code = _visit_code(state.decisions, agent, here == 0, n_agents)

    ready = xp.where(mine, arrival[:, None], state.ready)
    return State(
        nodes=state.nodes,
        visits=xp.where(marked, code[:, None], state.visits),
        destination=xp.where(mine, action[:, None], state.destination),
        leg=xp.where(mine, leg[:, None], state.leg),
        departed=xp.where(mine, now[:, None], state.departed),
        ready=ready,
        length=state.length + xp.where(mine, leg[:, None], 0.0),
        decisions=state.decisions + 1,
        agent=agent_to_decide(ready),
    )


def travel_ticks(leg: Array, speed: float) -> Array:
    """Ticks that a leg takes: max(1, ceil(leg / speed)), int64. A stay takes one tick."""
    xp = array_namespace(leg)
    ticks = xp.astype(xp.ceil(leg / speed - TICK_TOLERANCE), xp.int64)
    return xp.where(ticks > 1, ticks, 1)


def makespan(state: State) -> Array:
    """(B,) float64: the longest tour so far, every agent's return leg counted."""
    xp = array_namespace(state.nodes)
    rows = _rows(xp, state.decisions)[:, None]
    home = state.nodes[rows, state.destination] - state.nodes[:, :1, :]  # (B, m, 2)
    back = xp.sqrt(home[:, :, 0] * home[:, :, 0] + home[:, :, 1] * home[:, :, 1])
    return xp.max(state.length + back, axis=1)


def unvisited_trips(state: State) -> Array:
    """(B,) float64: out-and-back trips to all unvisited cities; what truncation adds, so that stalling never pays."""
    xp = array_namespace(state.nodes)
    home = state.nodes - state.nodes[:, :1, :]
    trips = 2.0 * xp.sqrt(home[:, :, 0] * home[:, :, 0] + home[:, :, 1] * home[:, :, 1])  # (B, n)
    return xp.sum(xp.where(state.visits < 0, trips, 0.0), axis=1)


def truncated(state: State, rules: Rules) -> Array:
    """(B,) bool: the game was cut off at ``max_decisions`` with cities left."""
    return (state.decisions >= rules.max_decisions) & ~all_visited(state)


def final_cost(state: State, rules: Rules) -> Array:
    """(B,) float64: the makespan, plus ``unvisited_trips`` where the game was cut off; minus an episode's rewards."""
    xp = array_namespace(state.nodes)
    return makespan(state) + xp.where(truncated(state, rules), unvisited_trips(state), 0.0)


def reward(before: State, after: State, rules: Rules) -> Array:
    """(B,) float64: what the decision between two states pays to every agent alike (paper, Sec. 4, Reward)."""
    xp = array_namespace(after.nodes)
    if rules.reward == "shaped":
        return makespan(before) - final_cost(after, rules)
    over = all_visited(after) | truncated(after, rules)
    return xp.where(over, -final_cost(after, rules), 0.0)


def _rows(xp: Any, like: Array) -> Array:
    return xp.arange(like.shape[0], device=device(like))


# Tours are kept in `visits` as one number per city, so that a state has a fixed shape however long its tours are:
# decision * 2m + agent * 2 + (1 where the agent came straight from the depot). Sorted, they spell out the tours.


def _visit_code(decision: Array, agent: Array, from_depot: Array, n_agents: int) -> Array:
    xp = array_namespace(decision)
    return (decision * n_agents + agent) * 2 + xp.astype(from_depot, xp.int64)


def tours(visits: np.ndarray, destination: np.ndarray, close: bool = True) -> Tours:
    """The tours of one game so far, from its rows of ``visits`` (n,) and ``destination`` (m,), as NumPy arrays.

    ``close`` appends the return leg to a tour whose agent is still out; an agent that never left has [0, 0], or [0] where
    tours stay open. Waiting at the depot does not repeat it.
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
        if tour[-1] != 0 and (close or node == 0) or close and len(tour) == 1:
            tour.append(0)
    return found
