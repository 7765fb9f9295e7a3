"""What ``solve`` chooses by itself if it is not given: how sharp samples are, how far agents see, which precision.

The numbers were measured with ``python -m benchmarks sweep-clip`` and ``sweep-view``.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import torch

SHARPEST_CLIP = 100.0
LOCAL_VIEW_FROM = 400  # nodes
LOCAL_VIEW = 100  # cities
BFLOAT16_FROM = 500  # nodes in one forward pass


def sampling_clip(clip: float, n_nodes: int, augment: bool = False) -> float:
    """C to sample with, for a network that was trained with C = ``clip``: larger logits for longer games.

    The more decisions a game has, the more certain each must be for a whole sample to be good. The paper keeps its
    C = 10 for small instances and takes 100 from n = 500 on (Sec. 6.1); here C grows as n / 5 between these two.
    Augmented games differ from each other without chance as well, so their C is three times as large.
    """
    return max(clip, min(SHARPEST_CLIP, clip * n_nodes / 50 * (3 if augment else 1)))


def default_view(n_nodes: int) -> int | None:
    """How many cities an agent sees, for a network that was trained on up to 100 nodes; None: all.

    From ``LOCAL_VIEW_FROM`` nodes on, seeing more cities than it was trained with does not help it.
    """
    return LOCAL_VIEW if n_nodes >= LOCAL_VIEW_FROM else None


def bfloat16_pays(device: torch.device, nodes: int) -> bool:
    """Whether a forward pass over ``nodes`` nodes, those of all games together, is faster in bfloat16."""
    return nodes >= BFLOAT16_FROM and multiplies_bfloat16(device)


@cache
def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 matrices faster than float32 ones.

    CPUs need AMX or, if they are AMD's, AVX-512 BF16. Intel's CPUs with AVX-512 BF16 alone are faster in float32.
    """
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    features: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)() if device.type == "cpu" else {}
    by_intel = str(features.get("cpu_name", "")).startswith("Intel")
    return bool(features.get("amx_bf16") or (features.get("avx512_bf16") and not by_intel))
