"""Baselines, b in the advantage R - b: the best policy so far, or the other samples of the same instance."""

from __future__ import annotations

import copy
from typing import Any, Protocol

import numpy as np
from scipy.stats import ttest_rel
from torch import Tensor, nn

from train.collect import Instances, costs, draw_set, play
from train.config import ReinforceConfig
from train.distributed import gather


class Baseline(Protocol):
    """What a trainer asks of one."""

    def value(self, instances: Instances, reward: Tensor) -> Tensor:
        """(B,) What each episode's reward (B,) is compared with. Must not depend on that episode's actions."""

    def challenge(self, network: nn.Module) -> bool:
        """Offer it a better policy; whether it took that."""

    def state_dict(self) -> dict[str, Any]:
        """Everything but the random generator, which belongs to the trainer."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""


class SharedBaseline:
    """The mean reward of the other samples of the same instance (Kool et al. 2019b; Kwon et al. 2020).

    Episodes i * K to i * K + K - 1 are the samples of one instance. Leaving out its own keeps the gradient unbiased.
    """

    def __init__(self, samples: int):
        self.samples = samples

    def value(self, instances: Instances, reward: Tensor) -> Tensor:
        """(B,) The mean of the K - 1 others."""
        rewards = reward.view(-1, self.samples)
        return ((rewards.sum(1, keepdim=True) - rewards) / (self.samples - 1)).flatten()

    def challenge(self, network: nn.Module) -> bool:
        """There is no policy to replace."""
        return False

    def state_dict(self) -> dict[str, Any]:
        """Nothing."""
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Nothing."""


class RolloutBaseline:
    """The best policy so far, played greedily on the same instances (Kool et al. 2019a; paper, Sec. 5.1)."""

    def __init__(self, network: nn.Module, config: ReinforceConfig, rng: np.random.Generator):
        self.config, self.rng = config, rng
        self._crown(network)

    def value(self, instances: Instances, reward: Tensor) -> Tensor:
        """(B,) The reward that the best policy so far gets on each instance."""
        return play(self.network, instances, self.config, "greedy").reward

    def challenge(self, network: nn.Module) -> bool:
        """Let ``network`` take over if it is better on the test set: lower mean, one-sided paired t-test.

        The test set is drawn afresh whenever the baseline changes, so that it is never overfitted.
        """
        cost = costs(network, self.test_set, self.config)
        won = better(gather(cost), gather(self.test_costs), self.config.challenge_p)
        if won:
            self._crown(network)
        return won

    def _crown(self, network: nn.Module) -> None:
        self.network = copy.deepcopy(network).eval().requires_grad_(False)
        self.test_set = draw_set(self.rng, self.config, self.config.challenge_instances)
        self.test_costs = costs(self.network, self.test_set, self.config)

    def state_dict(self) -> dict[str, Any]:
        """Everything but the random generator, which belongs to the trainer."""
        return {
            "network": self.network.state_dict(),
            "test_nodes": [part.nodes for part in self.test_set],
            "test_agents": [part.n_agents for part in self.test_set],
            "test_costs": self.test_costs,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.network.load_state_dict(state["network"])
        self.test_set = [Instances(*part) for part in zip(state["test_nodes"], state["test_agents"], strict=True)]
        self.test_costs = state["test_costs"]


def better(cost: Tensor, than: Tensor, p: float) -> bool:
    """Whether paired costs (N,) are lower than others, by a one-sided paired t-test at level ``p``."""
    difference = (cost - than).double().cpu().numpy()
    if not (difference.mean() < 0):
        return False
    if np.ptp(difference) == 0:
        return True  # lower by the same amount everywhere: no doubt left, and the test would divide by 0
    return bool(ttest_rel(cost.cpu().numpy(), than.cpu().numpy(), alternative="less").pvalue < p)
