"""Instances to train on, and whole episodes of a policy on them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torchrl.modules import ProbabilisticActor

from dan_policy.actor import OBSERVATION, make_actor
from dan_policy.episode import Decode, Episode, rollout
from dan_policy.symmetry import views
from mtsp_env.batched import BatchedMTSP
from mtsp_env.distributions import sample
from train.config import RunConfig


class Instances(NamedTuple):
    """A batch of instances of one size."""

    nodes: Tensor  # (B, n, 2) float64
    n_agents: int


def draw_size(rng: np.random.Generator, config: RunConfig) -> tuple[int, int]:
    """n and m, uniform in their ranges."""
    n_nodes = int(rng.integers(*config.n_nodes, endpoint=True))
    most = max(config.n_agents[0], min(config.n_agents[1], n_nodes // config.nodes_per_agent))
    return n_nodes, int(rng.integers(config.n_agents[0], most, endpoint=True))


def draw(
    rng: np.random.Generator,
    config: RunConfig,
    batch: int,
    tokens: int | None = None,
    size: tuple[int, int] | None = None,
) -> Instances:
    """``batch`` fresh instances, fewer where they would hold more than ``tokens`` nodes; one n and m for all.

    ``size`` gives n and m; None draws them.
    """
    n_nodes, n_agents = size or draw_size(rng, config)
    batch = batch if tokens is None else max(1, min(batch, tokens // n_nodes))
    problem = sample(config.distribution, rng, batch, n_nodes, n_agents)
    return Instances(torch.as_tensor(problem.nodes, device=config.device), n_agents)


def repeat(instances: Instances, samples: int) -> Instances:
    """Each instance ``samples`` times in a row, in another of the square's eight symmetries each time."""
    if samples == 1:
        return instances
    return Instances(views(instances.nodes, samples).flatten(0, 1), instances.n_agents)


def draw_set(rng: np.random.Generator, config: RunConfig, count: int, sizes: int = 8) -> list[Instances]:
    """``count`` instances in about ``sizes`` batches, each of its own n and m: a set to compare policies on."""
    counts = [len(part) for part in np.array_split(np.arange(count), min(sizes, count))]
    return [draw(rng, config, part) for part in counts]


def play(policy: nn.Module, instances: Instances, config: RunConfig, decode: Decode, keep: bool = False) -> Episode:
    """Whole episodes of a network, or of its actor, one per instance; ``keep`` the decisions, to learn from them.

    The one place where training meets the environment: in one process, with ``rollout``.
    """
    batch, n_nodes = instances.nodes.shape[:2]
    env = environment(n_nodes, instances.n_agents, batch, config)
    with autocast(config):
        kept = (*OBSERVATION, "action_mask") if keep else ()
        actor = policy if isinstance(policy, ProbabilisticActor) else make_actor(policy)
        return rollout(actor, env, decode, instances.nodes, kept)


def costs(network: nn.Module, instances: list[Instances], config: RunConfig) -> Tensor:
    """(sum of B,) Greedy cost of every instance."""
    return torch.cat([-play(network, part, config, "greedy").reward for part in instances])


def environment(n_nodes: int, n_agents: int, batch: int, config: RunConfig) -> BatchedMTSP:
    """The run's environment for a batch of one size; they are kept, because building their specs takes milliseconds."""
    return _environment(n_nodes, n_agents, batch, config.speed, config.depot, config.device)


@lru_cache(maxsize=1024)
def _environment(n_nodes: int, n_agents: int, batch: int, speed: float, depot: str, device: str) -> BatchedMTSP:
    return BatchedMTSP(n_nodes, n_agents, [batch], speed, depot, device=device, check_actions=False)


def autocast(config: RunConfig) -> torch.autocast:
    """The run's precision, as a context."""
    return torch.autocast(torch.device(config.device).type, torch.bfloat16, enabled=config.precision == "bfloat16")
