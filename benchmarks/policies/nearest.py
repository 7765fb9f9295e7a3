"""The nearest-city rule as a policy: what every learned one must beat."""

from __future__ import annotations

import torch
from torch import Tensor


def nearest(cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
    """Logits (..., n): the nearer the likelier, the depot only where nothing else is legal.

    ``cities`` (..., n, 2) are relative to the deciding agent, so their norm is the distance to go.
    """
    logits = -cities.norm(dim=-1)
    logits[..., 0] = -1e9
    return logits


def uniformly_random(cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
    """Logits (..., n): every legal node alike."""
    return torch.zeros(cities.shape[:-1], device=cities.device)
