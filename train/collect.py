"""Instances to train on, and whole episodes of a policy on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from dan_policy.actor import OBSERVATION, make_actor
from dan_policy.episode import Decode, Episode, rollout
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import sample_nodes
from train.config import ReinforceConfig


class Instances(NamedTuple):
    """A batch of instances of one size."""

    nodes: Tensor  # (B, n, 2) float64
    n_agents: int


def draw(rng: np.random.Generator, config: ReinforceConfig, batch: int) -> Instances:
    """``batch`` fresh instances; n and m are drawn once for all of them."""
    n_nodes = int(rng.integers(*config.n_nodes, endpoint=True))
    n_agents = int(rng.integers(*config.n_agents, endpoint=True))
    nodes = sample_nodes(config.distribution, rng, batch, n_nodes)
    return Instances(torch.as_tensor(nodes, device=config.device), n_agents)


def draw_set(rng: np.random.Generator, config: ReinforceConfig, count: int, sizes: int = 8) -> list[Instances]:
    """``count`` instances in about ``sizes`` batches, each of its own n and m: a set to compare policies on."""
    counts = [len(part) for part in np.array_split(np.arange(count), min(sizes, count))]
    return [draw(rng, config, part) for part in counts]


def play(
    network: nn.Module, instances: Instances, config: ReinforceConfig, decode: Decode, keep: bool = False
) -> Episode:
    """Whole, on-policy episodes of ``network``, one per instance; ``keep`` the decisions, to learn from them.

    The one place where training meets the environment: in one process, with ``rollout``.
    """
    batch, n_nodes = instances.nodes.shape[:2]
    env = _environment(n_nodes, instances.n_agents, batch, config.speed, config.depot, config.device)
    with autocast(config):
        kept = (*OBSERVATION, "action_mask") if keep else ()
        return rollout(make_actor(network), env, decode, instances.nodes, kept)


def costs(network: nn.Module, instances: list[Instances], config: ReinforceConfig) -> Tensor:
    """(sum of B,) Greedy cost of every instance."""
    return torch.cat([-play(network, part, config, "greedy").reward for part in instances])


@lru_cache(maxsize=1024)
def _environment(n_nodes: int, n_agents: int, batch: int, speed: float, depot: str, device: str) -> BatchedMTSP:
    return BatchedMTSP(n_nodes, n_agents, [batch], speed, depot, device=device, check_actions=False)


@contextmanager
def autocast(config: ReinforceConfig) -> Iterator[None]:
    """The run's precision. On a CPU bfloat16 takes the plain attention: the fused kernel is slow backwards there."""
    kind = torch.device(config.device).type
    lower = config.precision == "bfloat16"
    kernel = sdpa_kernel(SDPBackend.MATH) if lower and kind == "cpu" else nullcontext()
    with torch.autocast(kind, torch.bfloat16, enabled=lower), kernel:
        yield
