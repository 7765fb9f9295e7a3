"""The policy of another network as labels, in that network's own games.

A smaller network can learn from a larger one (Rusu et al. 2016, policy distillation), and a network from itself: it
goes on as before by the rule of its games, and learns that what this rule forbids is not worth doing by any other
(``train.plans.learnable_nodes``).
"""

from __future__ import annotations

from mtsp_env.instance import Problem
from train.regrets import Corrections, student_games
from train.supervised_config import ImitateConfig


def distil(config: ImitateConfig, problem: Problem) -> Corrections:
    """All decisions of the games that the network ``config.roll_in`` plays greedily, and its probabilities.

    Args:
        config: the run's options.
        problem: a batch of plain instances.
    """
    observation, policy, _, valid = student_games(config, problem)
    return Corrections(observation | {"target": policy}, valid)
