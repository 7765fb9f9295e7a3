"""The log of a game, worked out from its decisions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mtsp_env import rules, world
from mtsp_env.arrays import norm
from mtsp_env.instance import Problem
from mtsp_env.tours import Leg, Log


def write_log(problem: Problem, game_rules: rules.Rules, decisions: Sequence[int], close: bool = False) -> Log:
    """Replay the game of one instance (B = 1) by its ``decisions``, the nodes picked in turn, and note every leg.

    ``close`` adds the return legs of the agents that are out and do not break down before they can set off.
    """
    state = rules.start(problem, game_rules)
    log: Log = [[] for _ in range(problem.n_agents)]
    for node in decisions:
        agent = int(rules.agent_to_decide(state)[0])
        if node != 0 or state.destination[0, agent] != 0:  # staying at the depot is no leg
            log[agent].append(_leg(state, game_rules, agent, node))
        state = rules.depart(state, game_rules, np.array([node]))
    for agent, legs in enumerate(log):
        if state.alive is not None and not state.alive[0, agent]:
            if legs and state.arrival[0, agent] > state.break_tick[0, agent]:
                legs[-1] = legs[-1]._replace(arrived=math.inf, ready=math.inf)
        elif close and state.destination[0, agent] != 0 and _sets_off(state, agent):
            legs.append(_leg(state, game_rules, agent, 0))
    return log


def _sets_off(state: rules.State, agent: int) -> bool:
    return state.break_tick is None or bool(state.ready[0, agent] < state.break_tick[0, agent])


def _leg(state: rules.State, game_rules: rules.Rules, agent: int, node: int) -> Leg:
    """The leg of ``agent`` to ``node`` that begins when it is ready."""
    arrays, here = state.problem.arrays, state.destination[0, agent]
    length = norm(state.problem.nodes[:, node] - state.problem.nodes[:, here])  # (1,)
    travel = float(world.leg_times(state, agent, node, length).travel[0])
    departed = float(state.ready[0, agent]) * game_rules.speed
    arrived = departed + travel
    if node == 0 and "breaks" in arrays:
        arrived = min(arrived, float(arrays["breaks"][0, agent]))
    return Leg(node, departed, arrived, arrived + float(arrays["service"][0, node] if "service" in arrays else 0.0))
