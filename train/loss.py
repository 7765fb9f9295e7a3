"""The REINFORCE loss over whole episodes, recomputed in chunks so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from dan_policy.episode import Episode


class EpisodicReinforceLoss(LossModule):
    """-(R - b) * log-probability, summed over decisions and averaged over episodes (paper, Sec. 5.1).

    The keys are those of TorchRL's ``ReinforceLoss`` (reads ``action``, ``advantage`` and what the actor reads, writes
    ``loss_actor``); that one averages over decisions and wants a critic. Losses of parts of a batch add up to the
    whole's.

    Args:
        actor_network: as ``make_actor`` builds it.
        n_episodes: to average over, however many decisions are given at a time.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        advantage: NestedKey = "advantage"

    default_keys = _AcceptedKeys

    def __init__(self, actor_network: ProbabilisticTensorDictSequential, n_episodes: int):
        super().__init__()
        self.actor_network = actor_network
        self.n_episodes = n_episodes
        self.in_keys = [*actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.advantage]
        self.out_keys = ["loss_actor"]

    @property
    def functional(self) -> bool:
        """The actor is used as it is."""
        return False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Decisions of shape [N] with ``advantage`` (N,) -> ``loss_actor`` ()."""
        log_prob = log_probs(self.actor_network, tensordict, self.tensor_keys.action)
        advantage = tensordict.get(self.tensor_keys.advantage)
        return TensorDict({"loss_actor": -(advantage.detach() * log_prob).sum() / self.n_episodes})


def log_probs(
    actor: ProbabilisticTensorDictSequential, decisions: TensorDictBase, action: NestedKey = "action"
) -> Tensor:
    """(N,) Log-probability of each decision's action under ``actor``, with gradients."""
    return actor.get_dist(decisions).log_prob(decisions.get(action))


def decisions_with_advantage(episode: Episode, advantage: Tensor) -> TensorDictBase:
    """All real decisions of a batch of episodes in one row, in order of time, each with its episode's advantage (B,).

    Padding after an episode's end is left out. Relative coordinates change at every decision, so each is a sample of
    its own; those of one time are neighbours, which keeps ``prune_visited`` efficient.
    """
    decisions = episode.decisions.set("advantage", advantage.expand_as(episode.valid))
    return decisions[episode.valid]


def subsample(decisions: TensorDictBase, share: float) -> TensorDictBase:
    """A random ``share`` of the decisions, at least one, in their order; advantages grow so that sums keep their mean.

    An unbiased estimate of the whole batch's gradient for a share of the backward pass, most of a step's time: the
    decisions of an episode have one advantage, whose noise they share.
    """
    if share >= 1:
        return decisions
    count = max(1, round(share * len(decisions)))
    drawn = torch.randperm(len(decisions), device=decisions.device)[:count].sort().values
    part = decisions[drawn]
    return part.set("advantage", part["advantage"] * (len(decisions) / count))


def chunks(decisions: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """Consecutive parts of at most ``size`` decisions."""
    yield from decisions.split(size, dim=0)


def backward(loss: EpisodicReinforceLoss, decisions: TensorDictBase, chunk: int) -> float:
    """Add the loss's gradient to the parameters, ``chunk`` decisions in memory at a time; return the loss."""
    total = torch.zeros((), device=decisions.device)
    for part in chunks(decisions, chunk):
        value = loss(part)["loss_actor"]
        value.backward()
        total += value.detach()
    return float(total)
