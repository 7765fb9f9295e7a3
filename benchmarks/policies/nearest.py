"""Two simple policies as networks: go to the nearest city, and choose at random."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
    """Logits (..., n) that prefer nearer cities; the depot is chosen only if no other node is legal.

    ``cities`` (..., n, 2) are relative to the deciding agent, so their norms are its distances.
    """
    logits = -cities.norm(dim=-1)
    logits[..., 0] = -1e9
    return logits


def uniformly_random(cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
    """Equal logits (..., n), so that legal nodes are equally likely."""
    return torch.zeros(cities.shape[:-1], device=cities.device)
