"""The teacher in worlds: the central planner, which plans again whenever something happens.

No tours can be planned in advance there, so the labels of a decision are what the planner intends at that moment: where
every agent goes next, and which agent visits each city that is known. With ``roll_in`` a student plays the beginning
of every game, and any state that it reaches is where a plan can begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from mtsp_env import rules
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Problem, Tours
from train.canonical import counter_clockwise, in_order
from train.collect import autocast, environment
from train.network import student
from train.supervised_config import ImitateConfig

if TYPE_CHECKING:
    from mtsp_env.replan import Plan, Replanner


class Lessons(NamedTuple):
    """Decisions of games of one size and scenario, with the teacher's intentions.

    ``arrays`` (T, B, ...) has the observation, by its keys, ``destination`` (T, B, m), the teacher's ``action``, and
    its plan: ``next``, ``closed`` and ``visitor``, as in ``train.plans.add_plans``. Broken agents count as closed; an
    agent that has nothing to do goes home next, or stays there.
    """

    arrays: dict[str, np.ndarray]
    valid: np.ndarray  # (T, B) bool, False after a game's end, and where an agent goes on waiting at the depot

    def decisions(self, device: torch.device | str) -> tuple[TensorDictBase, torch.Tensor]:
        """A TensorDict [T, B] with everything that is learnt from, and valid (T, B)."""
        tensors = {name: torch.as_tensor(array, device=device) for name, array in self.arrays.items()}
        same = {"batch_size": self.valid.shape, "device": device}
        plan = TensorDict({name: tensors.pop(name) for name in ("next", "closed", "visitor")}, **same)
        game = TensorDict({"destination": tensors.pop("destination")}, **same)
        return TensorDict({**tensors, "game": game, "plan": plan}, **same), torch.as_tensor(self.valid, device=device)


def teach(config: ImitateConfig, rng: np.random.Generator, problem: Problem) -> Lessons:
    """Games of the teacher. With ``roll_in``, a share ``passes`` of n decisions of each, after the student's part.

    In worlds the student plays until a random number of cities is left, the same in all games of the batch, but at most
    2 n decisions: agents that wait may decide many times.
    """
    from mtsp_env.replan import Replanner  # imports Numba, which only the teacher needs

    config = replace(config, device="cpu")  # the teacher runs there
    env, limit = environment(problem, config), None
    state = env.reset(_as_tensordict(problem), set_state=True)
    if config.roll_in is not None:
        left = int(rng.integers(1, problem.n_nodes))
        state = roll_in(config, env, state, left)
        limit = max(1, round(config.passes * problem.n_nodes))
    iterations = config.teacher_iterations * problem.n_nodes
    planner = Replanner(iterations=iterations, seed=int(rng.integers(2**31)))
    plans: list[Plan | None] = [None] * len(problem.nodes)
    decisions, valid, over = [], [], state["done"][:, 0]
    while len(valid) != limit and not over.all():
        labels, plans = _labels(planner, env, state, plans, ~over)
        seen = {key: state[key] for key in env.observation_spec.keys() if key != "game"}  # noqa: SIM118 (no dict)
        seen["destination"] = state["game", "destination"]
        decisions.append({key: tensor.numpy() for key, tensor in seen.items()} | labels)
        valid.append((~over & ~_goes_on_waiting(state, torch.as_tensor(labels["action"]))).numpy())
        state = env.step(state.set("action", torch.as_tensor(labels["action"])))["next"]
        over = over | state["done"][:, 0]
    kept = [step for step, rows in enumerate(valid) if rows.any()]
    arrays = {key: np.stack([one[key] for one in decisions])[kept] for key in decisions[0]}
    return Lessons(arrays, np.stack(valid)[kept])


def _goes_on_waiting(state: TensorDictBase, action: torch.Tensor) -> torch.Tensor:
    """(B,) bool: whether the deciding agent has been at the depot before and stays there.

    Those who wait are asked again and again. If all these decisions were learnt from, they would outnumber the others,
    and the network would rather stay at home whenever it doubts.
    """
    agent, game = state["agent"][:, None], state["game"]
    has_waited = (game["destination"].gather(1, agent) == 0) & (game["leg"].gather(1, agent) == 0.0)
    return has_waited[:, 0] & (action == 0)


@torch.no_grad()
def roll_in(config: ImitateConfig, env: BatchedMTSP, state: TensorDictBase, left: int) -> TensorDictBase:
    """The student plays greedily until ``left`` cities are unvisited in each game, at most 2 n decisions."""
    actor, game = student(config), state["game"]
    going, decisions = ~state["done"][:, 0], 0
    with autocast(config), set_exploration_type(ExplorationType.DETERMINISTIC):
        while (going := going & (state["game", "cities_left"] > left) & ~state["done"][:, 0]).any():
            if decisions == 2 * env.n_nodes:
                break
            decisions += 1
            state = env.step(actor(state))["next"]
            game = state["game"].where(going, game)  # games that have come so far stay as they are
    return env.reset(TensorDict({"game": game}, env.batch_size), set_state=True)


def _as_tensordict(problem: Problem) -> TensorDict:
    size = [len(problem.nodes)]
    game = {name: torch.as_tensor(array) for name, array in problem.arrays.items()}
    return TensorDict({"game": TensorDict(game, size)}, size)


def _labels(
    planner: Replanner, env: BatchedMTSP, state: TensorDictBase, plans: Sequence[Plan | None], playing: torch.Tensor
) -> tuple[dict[str, np.ndarray], list[Plan | None]]:
    """What the teacher intends in each game that is ``playing`` (B,): labels (B, ...), and the plans from then on."""
    arrays = {name: tensor.numpy() for name, tensor in state["game"].items()}
    batch, n_nodes, n_agents = *arrays["visited"].shape, env.n_agents
    labels = {
        "action": np.zeros(batch, np.int64),
        "next": np.zeros((batch, n_agents), np.int64),
        "closed": np.zeros((batch, n_agents), bool),
        "visitor": np.zeros((batch, n_nodes), np.int64),
    }
    after = list(plans)
    for row in np.flatnonzero(playing.numpy()):
        game = rules.state_from_arrays({name: array[row : row + 1] for name, array in arrays.items()}, n_agents)
        plan = planner.update(game, env.rules, plans[row])
        if plan is not plans[row]:
            plan = replace(plan, routes=canonical_routes(game, plan.routes))
        node, after[row] = planner.follow(game, env.rules, plan)
        agent, routes = int(state["agent"][row]), after[row].routes
        for other, route in enumerate(routes):
            labels["next"][row, other] = route[0] if route else 0
            labels["visitor"][row, route] = other
        labels["action"][row] = labels["next"][row, agent] = node
        labels["visitor"][row, node] = agent if node else 0
        labels["closed"][row] = ~after[row].alive
    return labels, after


def canonical_routes(game: rules.State, routes: Tours) -> Tours:
    """An equally good plan for one game (B = 1), in the order and directions that a network can learn.

    As ``canonical`` has it, tours that begin at the depot run counter-clockwise, and agents that have never left it are
    in the order of the angles of their tours if all agents are equally fast.
    """
    nodes, at_depot = game.problem.nodes[0], game.destination[0] == 0
    alive = at_depot | True if game.alive is None else game.alive[0]
    routes = [
        counter_clockwise(nodes, route) if there else list(route) for route, there in zip(routes, at_depot, strict=True)
    ]
    if "speeds" not in game.problem.arrays:
        alike = np.flatnonzero(at_depot & alive & (game.own_time[0] == 0.0))
        for agent, route in zip(alike, in_order(nodes, [routes[agent] for agent in alike]), strict=True):
            routes[agent] = route
    return routes
