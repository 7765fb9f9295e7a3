"""The symmetries of the unit square: tours of a rotated or reflected instance are as good for the instance itself."""

from __future__ import annotations

import torch
from torch import Tensor

SYMMETRIES = 8


def symmetry(nodes: Tensor, k: int) -> Tensor:
    """The image of ``nodes`` (..., 2) under the ``k``-th of the eight rotations and reflections; 0 is the identity."""
    x, y = nodes.unbind(-1)
    x, y = (1 - x if k & 1 else x), (1 - y if k & 2 else y)
    return torch.stack([y, x] if k & 4 else [x, y], dim=-1)


def views(nodes: Tensor, count: int) -> Tensor:
    """nodes (..., n, 2) -> (..., count, n, 2): the same instance ``count`` times, the i-th in symmetry i modulo 8."""
    return torch.stack([symmetry(nodes, k % SYMMETRIES) for k in range(count)], dim=-3)
