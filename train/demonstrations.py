"""The teacher: tours of the reference solver, put in a canonical form, and the policy that follows them.

Alone, the teacher only shows what to do where it leads. With ``roll_in`` a student plays the beginning of every game,
mistakes and all, and the teacher takes over from there (DAgger: Ross, Gordon & Bagnell 2011).
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from dan_policy.actor import OBSERVATION, make_actor
from dan_policy.episode import rollout
from mtsp_env import rules
from mtsp_env.distributions import sample
from mtsp_env.instance import Tours
from mtsp_env.tours import is_closed
from train.collect import autocast, draw_size, environment
from train.config import ImitateConfig
from train.learner import make_network


class Demonstrations(NamedTuple):
    """Instances of one size, and each agent's way through them."""

    nodes: np.ndarray  # (B, n, 2) float64
    first: np.ndarray  # (B, m) int64, each agent's first city
    following: np.ndarray  # (B, n) int64, the node that a city is left for; 0 at the depot
    begin: int = 0  # decisions of each game before the teacher's first


def demonstrate(config: ImitateConfig, index: int) -> Demonstrations:
    """The ``index``-th set of a run: depends on ``config`` and ``index`` alone, wherever and whenever it is made."""
    from mtsp_env.reference import improve_batch  # numba: only where it is needed

    rng = np.random.default_rng([config.seed, index])
    n_nodes, n_agents = draw_size(rng, config)
    batch = int(np.clip(config.set_tokens // n_nodes, 16, 256))
    batch = 1 << batch.bit_length() - 1  # few shapes: few kernels to build
    nodes = sample(config.distribution, rng, batch, n_nodes, n_agents).nodes
    seed = int(rng.integers(2**31))
    begin = 0 if config.roll_in is None else int(rng.integers(n_nodes - 1))  # every game takes n - 1 or more
    prefixes = roll_in(config, nodes, n_agents, begin) if begin else [[[0]] * n_agents] * batch
    iterations = config.teacher_iterations * (n_nodes - begin)
    tours = improve_batch(nodes, n_agents, iterations, seed, threads=1, tidy=True, prefixes=prefixes)
    links = [as_links(canonical(*one), n_nodes) for one in zip(nodes, tours, prefixes, strict=True)]
    first, following = (np.stack(part) for part in zip(*links, strict=True))
    return Demonstrations(nodes, first, following, begin)


def roll_in(config: ImitateConfig, nodes: np.ndarray, n_agents: int, begin: int) -> list[Tours]:
    """How the tours begin, after the student's first ``begin`` decisions on ``nodes`` (B, n, 2), each its likeliest."""
    config = replace(config, device="cpu")  # where the teacher works
    env = environment(nodes.shape[1], n_agents, len(nodes), config)
    with autocast(config):
        last = rollout(_student(config), env, "greedy", torch.from_numpy(nodes), most=begin).last
    states = zip(last["game", "visits"].numpy(), last["game", "destination"].numpy(), strict=True)
    return [rules.tours(*state, close=False) for state in states]


@lru_cache(maxsize=1)
def _student(config: ImitateConfig) -> nn.Module:
    """The actor of ``roll_in``'s weights."""
    return make_actor(make_network(replace(config, init=config.roll_in)).eval())


def canonical(nodes: np.ndarray, tours: Tours, prefixes: Tours | None = None) -> Tours:
    """The same tours, in the one order and direction that a network can learn.

    Agents are alike and tours have no direction, so any solution is one of m! 2^m, and a network that is shown them at
    random learns their average. Here tours run counter-clockwise, and agents take them in the order of the angle at
    which their centroids are seen from the depot. Nobody stays at home (depot rule "final"): an idle agent takes over
    a city, which makes no tour longer. All that holds for the agents that are still at the depot; who is under way goes
    on as planned.

    Args:
        nodes: (n, 2); tours: of m < n agents.
        prefixes: how they begin; None: with nothing but the depot.
    """
    prefixes = [[0]] * len(tours) if prefixes is None else prefixes
    rests = [[node for node in tour[len(prefix) :] if node != 0] for tour, prefix in zip(tours, prefixes, strict=True)]
    waiting = [agent for agent, prefix in enumerate(prefixes) if len(prefix) == 1]
    for agent in waiting:
        spare = [len(rest) - (other in waiting) for other, rest in enumerate(rests)]
        if not rests[agent] and max(spare) > 0:
            rests[agent].append(rests[np.argmax(spare)].pop())

    def angle(tour: list[int]) -> float:
        east, north = nodes[tour].mean(0) - nodes[0] if tour else (-1.0, 0.0)  # who has nothing to do comes last
        return float(np.arctan2(north, east))

    ordered = [rests[agent] if _signed_area(nodes, rests[agent]) >= 0 else rests[agent][::-1] for agent in waiting]
    for agent, rest in zip(waiting, sorted(ordered, key=angle), strict=True):
        rests[agent] = rest
    return [prefix if is_closed(prefix) else [*prefix, *rest, 0] for prefix, rest in zip(prefixes, rests, strict=True)]


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

    return TensorDictModule(next_node, ["agent", ("game", "destination")], ["action"])


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
