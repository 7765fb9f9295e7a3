"""Baselines b of the advantage R - b: the best policy so far, or the other samples of the same instance."""

from __future__ import annotations

import copy
from typing import Any, Protocol

import numpy as np
from torch import Tensor, nn

from mtsp_env.instance import Problem
from train.collect import costs, draw_set, play
from train.distributed import gather
from train.reinforce_config import ReinforceConfig


class Baseline(Protocol):
    """The methods that ``ReinforceLearner`` calls."""

    def value(self, problem: Problem, reward: Tensor) -> Tensor:
        """(B,) The value that each episode's reward (B,) is compared with, independent of that episode's actions."""

    def challenge(self, network: nn.Module) -> bool:
        """Replace the baseline's policy by ``network`` if that is better. Returns whether it did."""

    def state_dict(self) -> dict[str, Any]:
        """Everything but the random generator, which belongs to the learner."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""


class SharedBaseline:
    """The mean reward of the other samples of the same instance (Kool et al. 2019b; Kwon et al. 2020).

    Episodes i * K to i * K + K - 1 are the samples of one instance. Because an episode's own reward is left out, the
    gradient is unbiased.
    """

    def __init__(self, samples: int):
        self.samples = samples

    def value(self, problem: Problem, reward: Tensor) -> Tensor:
        """(B,) The mean reward of the K - 1 other samples."""
        rewards = reward.view(-1, self.samples)
        return ((rewards.sum(1, keepdim=True) - rewards) / (self.samples - 1)).flatten()

    def challenge(self, network: nn.Module) -> bool:
        """Do nothing: there is no policy to replace."""
        return False

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Do nothing."""


class RolloutBaseline:
    """The best policy so far, played greedily on the same instances (Kool et al. 2019a; paper, Sec. 5.1)."""

    def __init__(self, network: nn.Module, config: ReinforceConfig, rng: np.random.Generator):
        self.config, self.rng = config, rng
        self._adopt(network)

    def value(self, problem: Problem, reward: Tensor) -> Tensor:
        """(B,) The reward of the best policy so far on each instance."""
        return play(self.network, problem, self.config, "greedy").reward

    def challenge(self, network: nn.Module) -> bool:
        """Replace the baseline if ``network`` has a lower mean cost on the test set (one-sided paired t-test).

        A new test set is drawn whenever the baseline changes, so that no policy overfits it.
        """
        cost = costs(network, self.test_set, self.config)
        won = better(gather(cost), gather(self.test_costs), self.config.challenge_p)
        if won:
            self._adopt(network)
        return won

    def _adopt(self, network: nn.Module) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.test_set = draw_set(self.rng, self.config, self.config.challenge_instances)
        self.test_costs = costs(self.network, self.test_set, self.config)

    def state_dict(self) -> dict[str, Any]:
        """Everything but the random generator, which belongs to the learner."""
        return {
            "network": self.network.state_dict(),
            "test_set": [{"n_agents": part.n_agents, "arrays": dict(part.arrays)} for part in self.test_set],
            "test_costs": self.test_costs,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.network.load_state_dict(state["network"])
        self.test_set = [Problem(**part) for part in state["test_set"]]
        self.test_costs = state["test_costs"]


def better(cost: Tensor, than: Tensor, p: float) -> bool:
    """Whether costs (N,) are lower than others on the same instances, by a one-sided paired t-test at level ``p``."""
    difference = (cost - than).double().cpu().numpy()
    if not (difference.mean() < 0):
        return False
    if np.ptp(difference) == 0:
        return True  # lower by the same amount everywhere: certain, and the test would divide by 0
    from scipy.stats import ttest_rel  # slow to import, and runs without challenges do not need it

    return bool(ttest_rel(cost.cpu().numpy(), than.cpu().numpy(), alternative="less").pvalue < p)
