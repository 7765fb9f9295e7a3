"""What a network is, and where it runs. This module knows no environment.

A *network* is a module or a plain function that takes the tensors of its ``in_keys`` in order and returns logits
(..., n). Attributes that it may have:

- ``in_keys``: the keys of the observation that it reads, by default ``OBSERVATION``; a nested key is a tuple. It gets
  None for a key that the observation does not have, such as ``agent_speeds`` in a plain game;
- ``config``: a dataclass. ``dan_policy.solve`` can change its fields ``tanh_clip``, ``view``, ``prune_visited`` and
  ``confidence``, if it has them, for one call, so the network should read them in each forward pass;
- ``supports_bfloat16``: True if its matrix products may run in bfloat16 under ``torch.autocast``;
- ``forward_next``: with the arguments of ``forward``, logits (..., m, n) of where each agent goes next. The deciding
  agent's row is what ``forward`` returns. With ``config.confidence``, ``solve`` then makes fewer forward passes as
  long as no cities are out of the decider's ``config.view``.

An *actor* is a TensorDict module that reads an observation and writes ``action`` (``dan_policy.actor``). It takes twice
as long to import TorchRL as to import torch, and ``solve`` needs it only for actors; so nothing here imports it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

Network = Callable[..., Tensor]
"""A module or a plain function: the tensors of its ``in_keys`` -> logits (..., n)."""

Key = str | tuple[str, ...]
"""A key of a TensorDict; a tuple leads into nested ones."""

OBSERVATION: tuple[Key, ...] = ("cities", "agents", "visited")

Decode = Literal["greedy", "sample"]
"""The likeliest actions, or actions that are drawn."""


def network_keys(network: Network) -> tuple[Key, ...]:
    """The keys of the observation that ``network`` takes: its attribute ``in_keys``, or ``OBSERVATION``."""
    return tuple(getattr(network, "in_keys", OBSERVATION))


def is_actor(policy: Any) -> bool:
    """Whether ``policy`` reads and writes TensorDicts. It does not if nobody has imported them so far."""
    tensordict = sys.modules.get("tensordict.nn")
    return tensordict is not None and isinstance(policy, tensordict.TensorDictModuleBase)


def check_greatest(logits: Tensor) -> None:
    """Raise ValueError if a greatest legal logit (B,) is NaN, as it is if any of them is, or infinity."""
    if not (logits < torch.inf).all():
        raise ValueError(
            f"the policy's logits must be finite, got {float(logits.max())}: parameters of the network may be NaN, "
            "infinite or far too large, or its input is"
        )


def find_device(device: torch.device | str | None = None) -> torch.device:
    """The device with this name; None takes a GPU if there is one.

    Raises:
        ValueError: an unknown name, or a device that this machine does not have.
    """
    try:
        chosen = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        if chosen.type == "meta" or (chosen.type == "cpu" and chosen.index):  # PyTorch takes any number for the CPU
            raise RuntimeError("meta tensors hold no numbers, and there is one device for all CPUs")
        return torch.empty(0, device=chosen).device  # with its index: "cuda" is "cuda:0" by default
    except (RuntimeError, AssertionError, NotImplementedError, ImportError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"no device {str(device)!r} here; choose for example 'cpu' or 'cuda' ({reason})") from error
