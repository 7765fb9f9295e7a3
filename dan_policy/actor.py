"""Any network, from an observation to logits, as a TorchRL policy. This module knows no environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from dan_policy.network import Key, Network, check_greatest, network_keys


class FiniteCategorical(MaskedCategorical):
    """The softmax of logits over a mask.

    Raises:
        ValueError: the greatest logit of the mask is NaN or infinity.
    """

    def __init__(self, logits: Tensor, *, mask: Tensor, **options: Any):
        if not torch.compiler.is_compiling():
            check_greatest(logits.detach().masked_fill(~mask, -torch.inf).amax(-1))
        super().__init__(logits, mask=mask, **options)


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


def logits_of_actor(
    actor: TensorDictModuleBase, observation: Mapping[str, Tensor], game: Mapping[str, Tensor]
) -> Tensor:
    """Logits (B, n) of an actor's choice, without TorchRL's exploration type, which belongs to the whole process.

    Args:
        actor: if it has no distribution, its logits leave no choice but the ``action`` that it writes.
        observation: tensors of the observation, B rows each.
        game: those of the state, which the actor finds under "game".

    Raises:
        ValueError: an illegal action.
    """
    size = [observation["visited"].shape[0]]
    td = TensorDict({**observation, "game": TensorDict(dict(game), size)}, size)
    if isinstance(actor, ProbabilisticTensorDictSequential):  # without `get_dist`, which sets the exploration type
        return actor.build_dist_from_params(actor.det_part(td)).logits
    return _logits_of_choice(actor(td))


def _logits_of_choice(decided: TensorDictBase) -> Tensor:
    """Logits that leave no choice but the ``action`` (B,) that an actor without a distribution has written."""
    action, mask = decided["action"], decided["action_mask"]
    if not mask.gather(1, action[:, None]).all():
        raise ValueError(f"the policy chose an illegal action, got {action.tolist()}")
    return torch.full(mask.shape, -torch.inf, device=mask.device).scatter(1, action[:, None], 0.0)
