"""The REINFORCE loss of whole episodes, computed in chunks of decisions so that memory does not grow with a batch."""

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

    The keys are those of TorchRL's ``ReinforceLoss`` (it reads ``action``, ``advantage`` and what the actor reads, and
    writes ``loss_actor``). TorchRL's averages over decisions and needs a critic. The losses of parts of a batch add up
    to the loss of the whole.

    Args:
        actor_network: an actor from ``make_actor``.
        n_episodes: number of episodes to average over, however many decisions ``forward`` receives at a time.
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
        """False: the loss holds the actor itself, not a functional copy."""
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
    """All N decisions of a batch of episodes as a TensorDict [N], each with its episode's ``advantage`` (B,).

    Padding after an episode's end is left out. Decisions are sorted by their index in the episode: neighbours have
    about equally many unvisited cities, which keeps ``prune_visited`` efficient.
    """
    if episode.decisions is None:
        raise ValueError("the episodes must keep their decisions: play(..., keep=True)")
    decisions = episode.decisions.set("advantage", advantage.expand_as(episode.valid))
    return decisions[episode.valid]


def subsample(decisions: TensorDictBase, share: float) -> TensorDictBase:
    """A random ``share`` of the decisions, at least one, in their order; advantages are scaled up by 1 / share.

    It gives an unbiased estimate of the whole batch's gradient for a share of the backward pass, which takes most of a
    step's time. Little is lost: all decisions of an episode share the noise of one advantage.
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
    """Add the loss's gradient to the parameters, ``chunk`` decisions at a time. Returns the loss."""
    total = torch.zeros((), device=decisions.device)
    for part in chunks(decisions, chunk):
        value = loss(part)["loss_actor"]
        value.backward()
        total += value.detach()
    return float(total)
