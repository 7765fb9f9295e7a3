"""The teacher: tours of the reference solver, put in a canonical form, and the policy that follows them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from dan_policy.actor import OBSERVATION
from dan_policy.episode import rollout
from mtsp_env.instance import Tours, sample_nodes
from train.collect import draw_size, environment
from train.config import ImitateConfig


class Demonstrations(NamedTuple):
    """Instances of one size, and each agent's way through them."""

    nodes: np.ndarray  # (B, n, 2) float64
    first: np.ndarray  # (B, m) int64, each agent's first city
    following: np.ndarray  # (B, n) int64, the node that a city is left for; 0 at the depot


def demonstrate(config: ImitateConfig, index: int) -> Demonstrations:
    """The ``index``-th set of a run: depends on ``config`` and ``index`` alone, wherever and whenever it is made."""
    from mtsp_env.reference import improve_batch  # numba: only where it is needed

    rng = np.random.default_rng([config.seed, index])
    n_nodes, n_agents = draw_size(rng, config)
    batch = int(np.clip(config.set_tokens // n_nodes, 16, 256))
    batch = 1 << batch.bit_length() - 1  # few shapes: few kernels to build
    nodes = sample_nodes(config.distribution, rng, batch, n_nodes)
    iterations = config.teacher_iterations * n_nodes
    tours = improve_batch(nodes, n_agents, iterations, seed=int(rng.integers(2**31)), threads=1, tidy=True)
    links = [as_links(canonical(*one), n_nodes) for one in zip(nodes, tours, strict=True)]
    first, following = (np.stack(part) for part in zip(*links, strict=True))
    return Demonstrations(nodes, first, following)


def canonical(nodes: np.ndarray, tours: Tours) -> Tours:
    """The same tours, in the one order and direction that a network can learn.

    Agents are alike and tours have no direction, so any solution is one of m! 2^m, and a network that is shown them at
    random learns their average. Here tours run counter-clockwise, and agents take them in the order of the angle at
    which their centroids are seen from the depot. Nobody stays at home (depot rule "final"): an idle agent takes over
    a city, which makes no tour longer.

    Args:
        nodes: (n, 2); tours: of m < n agents.
    """
    tours = [[node for node in tour if node != 0] for tour in tours]
    for tour in tours:
        if not tour:
            tour.append(max(tours, key=len).pop())
    tours = [tour if _signed_area(nodes, tour) >= 0 else tour[::-1] for tour in tours]
    east, north = np.array([nodes[tour].mean(0) - nodes[0] for tour in tours]).T
    return [[0, *tours[i], 0] for i in np.argsort(np.arctan2(north, east), kind="stable")]


def _signed_area(nodes: np.ndarray, tour: list[int]) -> float:
    """Twice the area that a closed tour goes round, positive counter-clockwise (the shoelace formula)."""
    x, y = (nodes[tour] - nodes[0]).T  # the depot is the origin and adds nothing
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())


def as_links(tours: Tours, n_nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """(m,) first cities and (n,) following nodes of ``tours``."""
    following = np.zeros(n_nodes, np.int64)
    for tour in tours:
        following[tour[1:-1]] = tour[2:]
    return np.array([tour[1] for tour in tours]), following


def follow(demonstrations: Demonstrations, device: torch.device | str = "cpu") -> TensorDictModule:
    """A TorchRL policy, plugged in like any other: every agent takes the next node of its tour."""
    first = torch.as_tensor(demonstrations.first, device=device)
    following = torch.as_tensor(demonstrations.following, device=device)

    def next_node(agent: Tensor, destination: Tensor) -> Tensor:
        """Who decides (B,), where everybody stands or goes (B, m) -> (B,)"""
        at = destination.gather(1, agent[:, None])
        starts = first.gather(1, agent[:, None])
        return torch.where(at == 0, starts, following.gather(1, at))[:, 0]

    return TensorDictModule(next_node, ["agent", "destination"], ["action"])


def replay(demonstrations: Demonstrations, config: ImitateConfig) -> tuple[TensorDictBase, Tensor]:
    """Let the environment's clock turn tours into decisions.

    Returns:
        decisions [T, B] with the observation of each and the teacher's ``action``; valid (T, B) bool.
    """
    batch, n_nodes = demonstrations.nodes.shape[:2]
    env = environment(n_nodes, demonstrations.first.shape[1], batch, config)
    nodes = torch.as_tensor(demonstrations.nodes, device=config.device)
    kept = (*OBSERVATION, "action_mask")
    episode = rollout(follow(demonstrations, config.device), env, "greedy", nodes, kept)
    return episode.decisions, episode.valid
