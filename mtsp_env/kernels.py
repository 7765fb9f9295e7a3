"""``rules.depart`` and ``rules.observe`` as compiled loops (Numba), for plain games in NumPy arrays.

They return the same arrays, bit for bit, in a fraction of the time: the rules in ``rules.py`` take some eighty array
operations for a decision, each of which reads and writes its arrays again. A loop over the rows passes once over them.
``tests/test_kernels.py`` compares the two. What a kernel does not know, ``rules.py`` plays: worlds, the depot rule
"wait", ``view`` and ``hearing``.

Importing this module needs Numba (the extra "reference"). The kernels are compiled at first use, which takes some
seconds, and cached on disk. The cache notices changes in this file alone, so constants are handed over as arguments.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numba import njit

from mtsp_env.instance import Array
from mtsp_env.state import NEVER, TICK_TOLERANCE, Observation, Rules, State


def can_play(world: Iterable[str], rules: Rules) -> bool:
    """Whether the kernels know the games of a problem with these world fields by these rules."""
    return not set(world) and rules.depot != "wait" and rules.view is None and rules.hearing is None


def depart(state: State, rules: Rules, action: Array) -> State:
    """``rules.depart`` by the agents to decide."""
    after = _depart(
        state.problem.nodes,
        state.visited,
        state.cities_left,
        state.visits,
        state.destination,
        state.leg,
        state.departed,
        state.ready,
        state.own_time,
        state.decisions,
        action,
        rules.speed,
        TICK_TOLERANCE,
        NEVER if rules.depot == "final" else -1,
    )
    return State(state.problem, state.seen_nodes, *after)


def observe(state: State, rules: Rules) -> Observation:
    """``rules.observe`` by the agents to decide."""
    cities, agents, action_mask, agent = _observe(
        state.seen_nodes,
        state.visited,
        state.cities_left,
        state.destination,
        state.leg,
        state.departed,
        state.ready,
        rules.speed,
        TICK_TOLERANCE,
        rules.depot == "final",
        NEVER,
    )
    return Observation(cities, agents, state.visited, action_mask, agent)


@njit(cache=True, nogil=True)
def _first_ready(ready: np.ndarray) -> int:
    """The agent with the smallest (ready tick, index), from ``ready`` (m,)."""
    agent = 0
    for other in range(1, len(ready)):
        if ready[other] < ready[agent]:
            agent = other
    return agent


@njit(cache=True, nogil=True)
def _depart(
    nodes: np.ndarray,
    visited: np.ndarray,
    cities_left: np.ndarray,
    visits: np.ndarray,
    destination: np.ndarray,
    leg: np.ndarray,
    departed: np.ndarray,
    ready: np.ndarray,
    own_time: np.ndarray,
    decisions: np.ndarray,
    action: np.ndarray,
    speed: float,
    tolerance: float,
    closed: int,
) -> tuple[np.ndarray, ...]:
    """The arrays of the state after ``action`` (B,); ``closed``: ready tick of an agent that picks the depot, or -1."""
    visited, cities_left, visits, destination = visited.copy(), cities_left.copy(), visits.copy(), destination.copy()
    leg, departed, ready, own_time = leg.copy(), departed.copy(), ready.copy(), own_time.copy()
    n_nodes, n_agents = visited.shape[1], ready.shape[1]
    for row in range(len(action)):
        agent = _first_ready(ready[row])
        goal, here, tick = action[row], destination[row, agent], ready[row, agent]
        if not (0 <= goal < n_nodes and 0 <= here < n_nodes):
            raise IndexError("an action or a destination is no node: nodes are 0 to n - 1")
        east = nodes[row, goal, 0] - nodes[row, here, 0]
        north = nodes[row, goal, 1] - nodes[row, here, 1]
        length = math.sqrt(east * east + north * north)
        visits[row, goal] = ((n_nodes - cities_left[row]) * n_agents + agent) * 2 + (here == 0)
        visited[row, goal] = goal != 0
        cities_left[row] -= goal != 0
        destination[row, agent] = goal
        leg[row, agent] = length
        departed[row, agent] = tick
        own_time[row, agent] += length
        if goal == 0 and closed >= 0:
            ready[row, agent] = closed
        else:
            ready[row, agent] = tick + np.int64(max(math.ceil(length / speed - tolerance), 1.0))
    return visited, cities_left, visits, destination, leg, departed, ready, own_time, decisions + 1


@njit(cache=True, nogil=True)
def _observe(
    seen_nodes: np.ndarray,
    visited: np.ndarray,
    cities_left: np.ndarray,
    destination: np.ndarray,
    leg: np.ndarray,
    departed: np.ndarray,
    ready: np.ndarray,
    speed: float,
    tolerance: float,
    depot_is_final: bool,
    never: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """``cities``, ``agents``, ``action_mask`` and ``agent`` of an observation."""
    batch, n_nodes = visited.shape
    n_agents = ready.shape[1]
    cities = np.empty_like(seen_nodes)
    agents = np.empty((batch, n_agents, 3), np.float32)
    action_mask = ~visited
    decider = np.empty(batch, np.int64)
    for row in range(batch):
        for goal in destination[row]:
            if not 0 <= goal < n_nodes:
                raise IndexError("a destination is no node: nodes are 0 to n - 1")
        agent = _first_ready(ready[row])
        here, tick = destination[row, agent], ready[row, agent]
        east, north = seen_nodes[row, here, 0], seen_nodes[row, here, 1]
        for node in range(n_nodes):
            cities[row, node, 0] = seen_nodes[row, node, 0] - east
            cities[row, node, 1] = seen_nodes[row, node, 1] - north
        still_out, away = 0, False
        for other in range(n_agents):
            goal = destination[row, other]
            agents[row, other, 0] = cities[row, goal, 0]
            agents[row, other, 1] = cities[row, goal, 1]
            # Algorithm 1 lowers g inside its loop over agents, so those before the decider seem one tick further on
            elapsed = float(tick + (other < agent) - departed[row, other]) + tolerance
            agents[row, other, 2] = max(leg[row, other] - speed * elapsed, 0.0)
            still_out += ready[row, other] < never
            away |= goal != 0 or (leg[row, other] > 0 and ready[row, other] > tick)
        may_go_home = (here != 0 and still_out > 1) if depot_is_final else away
        action_mask[row, 0] = may_go_home or cities_left[row] == 0
        decider[row] = agent
    return cities, agents, action_mask, decider
