"""The rules of the MinMax mTSP as a game of asynchronous decisions (paper, Sec. 4 and Algorithm 1).

Pure functions over arrays with a leading batch dimension B, written against the Python array API: NumPy arrays (the
PettingZoo environment, B = 1; the batched environment on a CPU) and torch tensors (the batched environment on a GPU, or
compiled) run the same lines; ``arrays.py`` holds the primitives that differ. The clock is event-driven: instead of
looping over ticks, the next to decide is the agent with the smallest (ready tick, index).

One decision: ``agent_to_decide`` -> ``observe`` -> the agent picks one of its ``legal_actions`` -> ``depart``. What
differs in problems with world fields is in ``world.py``.
"""

from __future__ import annotations

import numpy as np

from mtsp_env import world
from mtsp_env.arrays import append, at_least, cast, indices, library, locate, minus, norm, pick, pick_many, put
from mtsp_env.instance import Array, Problem, Tours
from mtsp_env.state import (
    DEPOTS,
    NEVER,
    OBSERVED,
    REWARDS,
    STATE_FIELDS,
    TICK_TOLERANCE,
    Depot,
    Observation,
    Reward,
    Rules,
    State,
    check_world,
    make_rules,
    observed_fields,
    state_fields,
    state_from_arrays,
    travel_ticks,
)

__all__ = [
    "DEPOTS",
    "NEVER",
    "OBSERVED",
    "REWARDS",
    "STATE_FIELDS",
    "TICK_TOLERANCE",
    "Depot",
    "Observation",
    "Reward",
    "Rules",
    "State",
    "agent_to_decide",
    "are_legal",
    "check_world",
    "depart",
    "final_cost",
    "legal_actions",
    "make_rules",
    "makespan",
    "now",
    "observe",
    "observed_fields",
    "remaining_times",
    "reward",
    "start",
    "state_fields",
    "state_from_arrays",
    "terminated",
    "tours",
    "travel_ticks",
    "truncated",
]


def start(problem: Problem, rules: Rules) -> State:
    """All agents at the depot at tick 0, no city visited.

    Raises:
        ValueError: a world that cannot be played by ``rules``, or n m is 2^30 or more (``visits`` would overflow).
    """
    check_world(problem.arrays, rules)
    nodes, n_agents = problem.nodes, problem.n_agents
    xp, on = library(nodes)
    batch, n_nodes = nodes.shape[0], nodes.shape[1]
    if (n_nodes + ("breaks" in problem.arrays) * n_agents) * n_agents >= 2**30:
        raise ValueError(f"n_nodes * n_agents must be below 2^30, got {n_nodes} * {n_agents}")

    def zeros(*shape: int, dtype: object = xp.int64) -> Array:
        return xp.zeros(shape, dtype=dtype, device=on)

    state = State(
        problem=problem,
        seen_nodes=xp.astype(nodes, xp.float32),
        visited=zeros(batch, n_nodes, dtype=xp.bool),
        cities_left=zeros(batch) + (n_nodes - 1),
        visits=zeros(batch, n_nodes, dtype=xp.int32) - 1,
        destination=zeros(batch, n_agents),
        leg=zeros(batch, n_agents, dtype=xp.float64),
        departed=zeros(batch, n_agents),
        ready=zeros(batch, n_agents),
        own_time=zeros(batch, n_agents, dtype=xp.float64),
        decisions=zeros(batch),
    )
    if problem.is_plain:
        return state
    needed = state_fields(problem.arrays)
    return state._replace(
        legs=zeros(batch, n_agents) if "legs" in needed else None,
        arrival=zeros(batch, n_agents) if "arrival" in needed else None,
        alive=zeros(batch, n_agents, dtype=xp.bool) | True if "alive" in needed else None,
        **world.event_ticks(problem, rules),
    )


def agent_to_decide(state: State) -> Array:
    """(B,) int64: the agent with the smallest (ready tick, index); argmin returns the first of equals."""
    return state.ready.argmin(1)


def now(state: State) -> Array:
    """(B,) int64: the clock, the tick of the decision at hand."""
    return pick(state.ready, locate(agent_to_decide(state), state.ready.shape[1]))


def terminated(state: State) -> Array:
    """(B,) bool: the game is over, all agents terminate at once.

    Every city is visited, and in worlds with ``breaks`` also reached: until then a breakdown can reopen one.
    """
    over = state.cities_left == 0
    return over if state.alive is None else over & (world.last_arrival(state) <= now(state))


def legal_actions(state: State, rules: Rules, agent: Array) -> Array:
    """(B, n) bool: the nodes that ``agent`` (B,) may pick: unvisited cities that it knows, and the depot by its rule.

    "open" and "wait": always, unless all agents that are not broken stand at the depot while known cities are
    unvisited, so that something moves. "final": not before the agent's first city, nor by the last agent still out
    while cities remain. If no city can be picked the depot is legal, so a mask is never empty.
    """
    tick, here = now(state), pick(state.destination, locate(agent, state.ready.shape[1]))
    return _legal(state, rules, tick, here, world.known_cities(state, rules, tick, here))


def _legal(state: State, rules: Rules, tick: Array, here: Array, known: Array | None) -> Array:
    mask = ~state.visited  # (B, n)
    nothing_open = state.cities_left == 0
    if known is not None:
        mask = mask & known
        nothing_open = ~library(mask)[0].any(mask[:, 1:], axis=1)
    if rules.depot == "final":
        depot = (here != 0) & ((state.ready < NEVER).sum(1) > 1)
    else:
        away = (state.destination != 0) | ((state.leg > 0) & (state.ready > tick[:, None]))
        depot = (away if state.alive is None else away & state.alive).any(1)
    mask[:, 0] = depot | nothing_open
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

    An agent underway sees the world from its destination, where it will decide next; a decider's own row is (0, 0, 0).
    Cities that it does not know look visited and lie on the depot.
    """
    decider = agent_to_decide(state)
    agent = decider if agent is None else agent
    n_nodes, n_agents = state.visited.shape[1], state.ready.shape[1]
    tick = pick(state.ready, locate(decider, n_agents))
    here = pick(state.destination, locate(agent, n_agents))
    cities = minus(state.seen_nodes, pick(state.seen_nodes, locate(here, n_nodes)))  # (B, n, 2)
    heading = pick_many(cities, state.destination)  # (B, m, 2)
    remaining = remaining_times(state, rules, agent, decider, tick)  # (B, m)
    known = world.known_cities(state, rules, tick, here)
    seen = Observation(
        cities=cities,
        agents=append(heading, remaining),
        visited=state.visited,
        action_mask=_legal(state, rules, tick, here, known),
        agent=agent,
    )
    if state.problem.is_plain and known is None and rules.hearing is None:
        return seen
    return world.add_to_view(seen, state, rules, agent, here, known)


def remaining_times(state: State, rules: Rules, agent: Array, decider: Array, tick: Array) -> Array:
    """(B, m) Announced remaining times g of all agents, as ``agent`` (B,) sees them while ``decider`` decides.

    Algorithm 1 lowers g inside the loop over agents, so agent i sees the agents before it (j < i) one tick further on.
    """
    before = indices(state.ready, axis=1) < agent[:, None]  # (B, m): j < i
    elapsed = cast(tick[:, None] + before - state.departed, "float64") + TICK_TOLERANCE
    remaining = at_least(state.leg - rules.speed * elapsed, 0.0)
    if state.legs is None:
        return remaining
    return library(remaining)[0].where(  # with traffic, it may arrive earlier than announced
        indices(state.ready, axis=1) == decider[:, None], 0.0, remaining
    )


def depart(state: State, rules: Rules, action: Array, agent: Array | None = None) -> State:
    """``agent`` (B,), by default the one to decide, sets off for ``action`` (B,) when it is ready.

    The caller has checked that the actions are legal. In a finished game only the depot is left to pick, which changes
    neither the makespan nor the tours.
    """
    problem, n_nodes, n_agents = state.problem, state.visited.shape[1], state.ready.shape[1]
    agent = agent_to_decide(state) if agent is None else agent
    own, goal = locate(agent, n_agents), locate(action, n_nodes)
    here, tick = pick(state.destination, own), pick(state.ready, own)
    length = norm(pick(problem.nodes, goal) - pick(problem.nodes, locate(here, n_nodes)))
    is_city, from_depot = action != 0, here == 0
    if problem.is_plain:
        leg, ready, own_time = length, tick + travel_ticks(length, rules.speed), pick(state.own_time, own) + length
        world_fields = {}
    else:
        times = world.leg_times(state, own, goal, length)
        leg, ready = times.announced, tick + world.ticks_of(times.total, rules)
        own_time = world.leaves_at(state, rules, own, is_city & from_depot, tick) + times.total
        world_fields = world.note_leg(state, rules, own, is_city | ~from_depot, tick, times)

    if rules.depot == "final":
        ready = library(ready)[0].where(is_city, ready, NEVER)
    elif rules.depot == "wait":
        ready = library(ready)[0].where(is_city | ~from_depot, ready, NEVER)  # until something happens
    after = State(
        problem=problem,
        seen_nodes=state.seen_nodes,
        visited=put(state.visited, goal, is_city),
        cities_left=state.cities_left - cast(is_city, "int64"),
        visits=put(state.visits, goal, _visit_code(_order(state), agent, from_depot, n_agents)),
        destination=put(state.destination, own, action),
        leg=put(state.leg, own, leg),
        departed=put(state.departed, own, tick),
        ready=put(state.ready, own, ready),
        own_time=put(state.own_time, own, own_time),
        decisions=state.decisions + 1,
        **world_fields,
    )
    if problem.is_plain and rules.depot != "wait":
        return after
    return world.advance(after, rules, tick)


def makespan(state: State) -> Array:
    """(B,) float64: the makespan if all agents go home now; if plain, the longest tour so far, return legs counted."""
    nodes = state.problem.nodes
    way_home = norm(pick_many(nodes, state.destination) - nodes[:, :1])  # (B, m)
    times = state.own_time + way_home if state.problem.is_plain else world.own_times(state, way_home)
    return library(times)[0].max(times, axis=1)


def truncated(state: State, rules: Rules) -> Array:
    """(B,) bool: the game was cut off at ``max_decisions`` with cities left."""
    return (state.decisions >= rules.max_decisions) & ~terminated(state)


def final_cost(state: State, rules: Rules) -> Array:
    """(B,) float64: minus an episode's rewards: the makespan.

    If the game was cut off, out-and-back trips to all unvisited cities come on top, so that stalling never pays; see
    ``world.cut_off_cost``.
    """
    cost, cut_off = makespan(state), truncated(state, rules)
    if type(cut_off) is np.ndarray and not cut_off.any():
        return cost
    return library(cost)[0].where(cut_off, world.cut_off_cost(state, rules, cost, now(state)), cost)


def reward(before: State, after: State, rules: Rules, over: Array | None = None) -> Array:
    """(B,) float64: what the decision between two states pays to every agent alike (paper, Sec. 4, Reward).

    ``over`` (B,) bool says whether the game is over after it, if that is known already.
    """
    if rules.reward == "shaped":
        return makespan(before) - final_cost(after, rules)
    over = terminated(after) | truncated(after, rules) if over is None else over
    if type(over) is np.ndarray and not over.any():
        return np.zeros(len(over))  # most decisions: nothing to work out
    cost = final_cost(after, rules)
    return library(cost)[0].where(over, -cost, 0.0)


# Tours are kept in `visits` as one number per city, so that a state has a fixed shape however long its tours are:
# order * 2m + agent * 2 + (1 if the agent came straight from the depot), where the first city visited has order 1.
# Sorted, the numbers spell out the tours. The depot's entry means nothing.


def _order(state: State) -> Array:
    """(B,) The next visit's place in the order of all visits. A breakdown reopens one city at most: it still grows."""
    order = state.visited.shape[1] - state.cities_left
    return order if state.alive is None else order + library(order)[0].sum(cast(~state.alive, "int64"), axis=1)


def _visit_code(order: Array, agent: Array, from_depot: Array, n_agents: int) -> Array:
    """(B,) int32."""
    return cast((order * n_agents + agent) * 2 + from_depot, "int32")


def tours(visits: np.ndarray, destination: np.ndarray, close: bool = True, alive: np.ndarray | None = None) -> Tours:
    """The tours of one game so far, from its rows of ``visits`` (n,) and ``destination`` (m,), as NumPy arrays.

    ``close`` appends the return leg to a tour whose agent is still out; an agent that never left has [0, 0], or [0]
    if tours stay open. Waiting at the depot does not repeat it. An agent that is not ``alive`` (m,) has broken down:
    its tour ends with the last city that it reached, or with the depot if it had set off for it.
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
    closes = [close] * n_agents if alive is None else (alive & close).tolist()
    for tour, node, returns in zip(tours, destination.tolist(), closes, strict=True):
        if (tour[-1] != 0 and (returns or node == 0)) or (returns and len(tour) == 1):
            tour.append(0)
    return tours
