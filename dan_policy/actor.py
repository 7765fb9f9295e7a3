"""Any network, observation -> logits, as a TorchRL policy. Knows no environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MaskedCategorical, ProbabilisticActor

OBSERVATION = ("cities", "agents", "visited")


def make_actor(network: Callable[..., Tensor], in_keys: Sequence[str] = OBSERVATION) -> ProbabilisticActor:
    """A TorchRL actor that samples ``action`` from the softmax of the network's logits over ``action_mask``.

    Args:
        network: a module or a plain function; called with the tensors of ``in_keys`` (cities (..., n, 2), agents
            (..., m, 3), visited (..., n)), returns logits (..., n). Masked nodes get probability 0 in any case.
        in_keys: observation keys that it takes, in order; ``action_mask`` may be one of them.

    Returns:
        A ``ProbabilisticActor``: sampling by default; greedy under
        ``torchrl.envs.set_exploration_type(ExplorationType.DETERMINISTIC)``.
    """
    return ProbabilisticActor(
        TensorDictModule(network, list(in_keys), ["logits"]),
        in_keys={"logits": "logits", "mask": "action_mask"},
        out_keys=["action"],
        distribution_class=MaskedCategorical,
        default_interaction_type=ExplorationType.RANDOM,
    )
