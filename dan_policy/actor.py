"""Any network, from an observation to logits, as a TorchRL policy. This module knows no environment.

A *network* is a module or a plain function that takes the tensors of its ``in_keys`` in order and returns logits
(..., n). Attributes that it may have:

- ``in_keys``: the keys of the observation that it reads, by default ``OBSERVATION``; a nested key is a tuple. It gets
  None for a key that the observation does not have, such as ``agent_speeds`` in a plain game;
- ``config``: a dataclass. ``dan_policy.solve`` can change its fields ``tanh_clip``, ``view`` and ``prune_visited``, if
  it has them, for one call, so the network should read them in each forward pass;
- ``supports_bfloat16``: True if its matrix products may run in bfloat16 under ``torch.autocast``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MaskedCategorical, ProbabilisticActor

Network = Callable[..., Tensor]
"""A module or a plain function: the tensors of its ``in_keys`` -> logits (..., n)."""

Key = str | tuple[str, ...]
"""A key of a TensorDict; a tuple leads into nested ones."""

OBSERVATION: tuple[Key, ...] = ("cities", "agents", "visited")


class FiniteCategorical(MaskedCategorical):
    """The softmax of logits over a mask.

    Raises:
        ValueError: the greatest logit of the mask is NaN or infinity.
    """

    def __init__(self, logits: Tensor, *, mask: Tensor, **options: Any):
        if not torch.compiler.is_compiling():
            check_greatest(logits.detach().masked_fill(~mask, -torch.inf).amax(-1))
        super().__init__(logits, mask=mask, **options)


def check_greatest(logits: Tensor) -> None:
    """Raise ValueError if a greatest legal logit (B,) is NaN, as it is if any of them is, or infinity."""
    if not (logits < torch.inf).all():
        raise ValueError(
            f"the policy's logits must be finite, got {float(logits.max())}: parameters of the network may be NaN, "
            "infinite or far too large, or its input is"
        )


def make_actor(
    network: Network, in_keys: Sequence[Key] | None = None, return_log_prob: bool = False
) -> ProbabilisticActor:
    """A TorchRL actor that samples ``action`` from the softmax of the network's logits over ``action_mask``.

    Args:
        network: a module or a plain function. It is called with the tensors of ``in_keys``, for example cities
            (..., n, 2), agents (..., m, 3) and visited (..., n), and returns logits (..., n). Masked nodes get
            probability 0, whatever their logits. ValueError if a legal node's logit is NaN or infinity.
        in_keys: the keys of the observation that it takes, in order; ``action_mask`` and nested keys such as
            ``("game", "nodes")`` may be among them. None: the network's attribute ``in_keys``, or ``OBSERVATION`` if
            it has none.
        return_log_prob: also write ``action_log_prob`` (...), which TorchRL's PPO losses read.

    Returns:
        A ``ProbabilisticActor`` that samples by default, and is greedy under
        ``torchrl.envs.set_exploration_type(ExplorationType.DETERMINISTIC)``.
    """
    keys = list(network_keys(network) if in_keys is None else in_keys)
    return ProbabilisticActor(
        TensorDictModule(network, keys, ["logits"]),
        in_keys={"logits": "logits", "mask": "action_mask"},
        out_keys=["action"],
        distribution_class=FiniteCategorical,
        default_interaction_type=ExplorationType.RANDOM,
        return_log_prob=return_log_prob,
    )


def as_actor(policy: Network | TensorDictModuleBase) -> TensorDictModuleBase:
    """``policy`` itself if it is an actor, that is, reads and writes TensorDicts; else the actor of this network."""
    return policy if isinstance(policy, TensorDictModuleBase) else make_actor(policy)


def network_keys(network: Network) -> tuple[Key, ...]:
    """The keys of the observation that ``network`` takes: its attribute ``in_keys``, or ``OBSERVATION``."""
    return tuple(getattr(network, "in_keys", OBSERVATION))
