"""Self-improvement: the policy learns from the best of its own games, without a teacher.

Every instance is played several times with drawn actions, as ``solve(decode="sample", augment=True)`` plays it, and the
game with the smallest makespan labels it (SLIM: Corsini et al. 2024; MACSIM does the same for several agents).
"""

from __future__ import annotations

import time
from typing import Annotated

import numpy as np
import torch
import tyro
from torch import nn

from dan_policy.games import as_links, play
from mtsp_env import rules
from mtsp_env.instance import Problem
from train.collect import autocast, draw, environment, repeat, rotated
from train.demonstrations import Demonstrations, as_decisions
from train.loop import run, run_folder
from train.network import observation_keys
from train.plans import PLAN_KEYS, add_plans
from train.supervised import SupervisedLearner
from train.supervised_config import ImproveConfig


class ImproveLearner(SupervisedLearner):
    """What changes during a run of self-improvement, and one step of it."""

    config: ImproveConfig

    def train_step(self) -> dict[str, float]:
        """Play a batch, take one optimiser step on the best games' decisions. Returns the numbers to log."""
        config, start = self.config, time.perf_counter()
        problem = draw(self.rng, config, config.batch_size, config.batch_tokens)
        if config.rotate:
            problem = rotated(self.rng, problem)
        best, costs = best_games(self.averaged_network, problem, config, int(self.rng.integers(2**31)))

        keys = observation_keys(self.network)
        if self.learns_plans:
            keys = tuple(dict.fromkeys((*keys, *PLAN_KEYS)))
        decisions, valid = as_decisions(best, keys, config)
        if self.learns_plans:
            decisions = add_plans(decisions, best)
        decisions = decisions[valid]  # sorted by index in the game, so that a chunk has equally many unvisited cities
        batches = decisions.split(config.chunk, dim=0)
        logs = self.descend(batches, [len(batch) / len(decisions) for batch in batches])

        self.step += 1
        self.instances += len(problem.nodes)
        return logs | {
            "cost": float(costs.mean()),
            "best_cost": float(costs.min(1).mean()),
            "episodes_per_second": costs.size / (time.perf_counter() - start),
        }


def best_games(
    policy: nn.Module, problem: Problem, config: ImproveConfig, seed: int
) -> tuple[Demonstrations, np.ndarray]:
    """Each instance's game with the smallest makespan among ``config.samples`` with drawn actions.

    Agents act on foreseen decisions as in ``dan_policy.solve``, if the policy has a confidence. A game is returned in
    the symmetry in which it was played, because its agents and directions are in the order that the policy prefers
    there.

    Args:
        problem: B instances, torch tensors on the run's device.
        seed: seed of the drawn actions.

    Returns:
        The best games of all B instances, and the makespans (B, samples) of all games.
    """
    repeated = repeat(problem, config.samples)
    if config.device == "cpu":  # the rules are faster in NumPy there
        repeated = Problem(problem.n_agents, {name: array.numpy() for name, array in repeated.arrays.items()})
    game = environment(repeated, config).rules
    with autocast(config):
        generator = torch.Generator(config.device).manual_seed(seed)
        end = play(policy, rules.start(repeated, game), game, generator)
    costs = torch.as_tensor(rules.makespan(end)).view(-1, config.samples)  # (B, samples)
    rows = costs.argmin(1) + torch.arange(len(costs), device=costs.device) * config.samples
    nodes, visits, destination = (
        torch.as_tensor(array)[rows].cpu().numpy() for array in (repeated.nodes, end.visits, end.destination)
    )
    tours = [rules.tours(*state) for state in zip(visits, destination, strict=True)]
    return Demonstrations(nodes, *as_links(tours, problem.n_nodes)), costs.cpu().numpy()


def improve(config: Annotated[ImproveConfig, tyro.conf.arg(name="")]) -> ImproveLearner:
    """Train a network on the best of its own games: a refinement of trained weights (`--init`).

    A run ends after `steps`, after `seconds`, or on Ctrl-C, and saves in any case.

    Args:
        config: the options.

    Raises:
        FileExistsError: ``config.out`` holds another run and ``resume`` is not set.
        ValueError: the run to resume had another configuration, a value does not fit, or another process trains in
            ``config.out``.
        OSError: there is no run to resume, or no such weights.
    """
    with run_folder(config):
        learner = ImproveLearner(config)
        run(learner)
    return learner
