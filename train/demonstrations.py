"""The teacher: tours of the reference solver in a canonical form, and the policy that follows them.

The teacher's own games only show what to do in states that the teacher reaches. With ``roll_in`` a student plays the
beginning of every game, including its mistakes, and the teacher continues from there (DAgger: Ross, Gordon & Bagnell
2011). In worlds the teacher has to plan again and again: see ``train.lessons``. It can also tell the student what each
decision costs: see ``train.regrets``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from dan_policy.episode import rollout
from dan_policy.games import as_links, next_on_tour
from dan_policy.network import Key
from mtsp_env import rules
from mtsp_env.distributions import sample
from mtsp_env.instance import Problem, Tours
from train.canonical import canonical
from train.collect import autocast, draw_scenario, draw_size, environment, present, rotated
from train.distillation import distil
from train.lessons import Lessons, teach
from train.network import student
from train.regrets import Corrections, correct
from train.supervised_config import ImitateConfig, SupervisedConfig

LEAST_GAMES, MOST_GAMES = 16, 256  # of a set


class Demonstrations(NamedTuple):
    """A set of instances of one size, with the teacher's plan for each: every agent's whole tour."""

    nodes: np.ndarray  # (B, n, 2) float64
    first: np.ndarray  # (B, m) int64, each agent's first city
    following: np.ndarray  # (B, n) int64, the node that comes after a city on its tour; 0 at the depot
    begin: int = 0  # number of decisions of each game that the student took before the teacher's first


def demonstrate(config: ImitateConfig, index: int) -> Demonstrations | Lessons | Corrections:
    """The ``index``-th set of a run. It depends on ``config`` and ``index`` alone, not on the process that makes it."""
    rng = np.random.default_rng([config.seed, index])
    scenario = config.world(draw_scenario(rng, config))
    n_nodes, n_agents = draw_size(rng, config)
    batch = int(np.clip(config.set_tokens // n_nodes, LEAST_GAMES, MOST_GAMES))
    batch = 1 << batch.bit_length() - 1  # few different shapes, so that oneDNN builds few kernels
    problem = sample(config.generator(), rng, batch, n_nodes, n_agents, scenario)
    if config.rotate:
        turned = rotated(rng, problem)
        problem = Problem(n_agents, {name: np.asarray(array) for name, array in turned.arrays.items()})
    if not problem.is_plain:
        return teach(config, rng, problem)
    if config.labels == "regrets":
        return correct(config, rng, problem)
    if config.labels == "policy":
        return distil(config, problem)
    from mtsp_env.reference import improve_batch  # imports Numba, which only the teacher needs

    nodes = problem.nodes
    seed = int(rng.integers(2**31))
    begin = 0 if config.roll_in is None else int(rng.integers(n_nodes - 1))  # every game takes n - 1 decisions or more
    prefixes = roll_in(config, problem, begin) if begin else [[[0]] * n_agents] * batch
    iterations = config.teacher_iterations * (n_nodes - begin)
    tours = improve_batch(nodes, n_agents, iterations, seed, threads=1, tidy=True, prefixes=prefixes)
    tours = [canonical(*one) for one in zip(nodes, tours, prefixes, strict=True)]
    return Demonstrations(nodes, *as_links(tours, n_nodes), begin)


def roll_in(config: ImitateConfig, problem: Problem, begin: int) -> list[Tours]:
    """The open tours after the student's first ``begin`` decisions, played greedily."""
    config = replace(config, device="cpu")  # the teacher runs there
    env = environment(problem, config)
    with autocast(config):
        last = rollout(student(config), env, "greedy", problem, max_decisions=begin).last
    states = zip(last["game", "visits"].numpy(), last["game", "destination"].numpy(), strict=True)
    return [rules.tours(*state, close=False) for state in states]


def follow(demonstrations: Demonstrations, device: torch.device | str = "cpu") -> TensorDictModule:
    """The teacher as a TorchRL policy: every agent takes the next node of its tour."""
    first = torch.as_tensor(demonstrations.first, device=device)
    following = torch.as_tensor(demonstrations.following, device=device)
    return TensorDictModule(partial(next_on_tour, first, following), ["agent", ("game", "destination")], ["action"])


def as_decisions(
    demonstrations: Demonstrations, keys: Sequence[Key], config: SupervisedConfig
) -> tuple[TensorDictBase, Tensor]:
    """Turn the teacher's tours into decisions, in the order of the environment's clock.

    Args:
        keys: the parts of the observation to keep; those that only worlds have are left out.

    Returns:
        decisions: TensorDict [T, B] with ``keys`` and the teacher's ``action``.
        valid: (T, B) bool, False after a game's end.
    """
    nodes = torch.as_tensor(demonstrations.nodes, device=config.device)
    problem = Problem(demonstrations.first.shape[1], {"nodes": nodes})
    env = environment(problem, config)
    episode = rollout(follow(demonstrations, config.device), env, "greedy", problem, present(env, keys))
    return episode.decisions, episode.valid
