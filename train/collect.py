"""Instances to train on, and whole episodes of a policy on them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn

from dan_policy.actor import as_actor
from dan_policy.episode import Episode, rollout
from dan_policy.network import Decode, Key
from dan_policy.symmetry import views
from mtsp_env.batched import BatchedMTSP
from mtsp_env.distributions import sample
from mtsp_env.instance import FIELDS, Problem
from mtsp_env.machine import check_memory
from mtsp_env.rules import Depot
from train.config import RunConfig

BYTES_PER_NODE = 48  # of an instance while it is drawn: two float64, and copies


def draw_size(rng: np.random.Generator, config: RunConfig) -> tuple[int, int]:
    """n and m, uniform in their ranges."""
    n_nodes = int(rng.integers(*config.n_nodes, endpoint=True))
    greatest = max(config.n_agents[0], min(config.n_agents[1], n_nodes // config.nodes_per_agent))
    return n_nodes, int(rng.integers(config.n_agents[0], greatest, endpoint=True))


def draw_scenario(rng: np.random.Generator, config: RunConfig) -> str:
    """One of the run's scenarios, all of them equally often."""
    return config.scenario[rng.integers(len(config.scenario))] if len(config.scenario) > 1 else config.scenario[0]


def draw(
    rng: np.random.Generator,
    config: RunConfig,
    batch: int,
    tokens: int | None = None,
    size: tuple[int, int] | None = None,
    scenario: str | None = None,
) -> Problem:
    """A problem of fresh instances, torch tensors on the run's device.

    Args:
        batch: number of instances.
        tokens: upper bound on instances times nodes, which may reduce their number to no less than 1; None: no bound.
        size: n and m; None draws them.
        scenario: one of ``config.scenario``; None draws it.

    Raises:
        ValueError: the instances do not fit into the memory, or the distribution or scenario cannot be drawn from.
    """
    n_nodes, n_agents = size or draw_size(rng, config)
    scenario = scenario or draw_scenario(rng, config)
    batch = batch if tokens is None else max(1, min(batch, tokens // n_nodes))
    check_memory(f"the number of instances with {n_nodes} nodes", batch, BYTES_PER_NODE * n_nodes)
    try:
        arrays = sample(config.generator(), rng, batch, n_nodes, n_agents, config.world(scenario)).arrays
    except TypeError as error:  # a function of the user's that takes or returns something else
        given = {"distribution": config.distribution, "scenario": scenario}
        theirs = [f"{option}={name!r}" for option, name in given.items() if ":" in name]
        if not theirs:
            raise
        raise ValueError(f"{' or '.join(theirs)} cannot be drawn from ({error})") from error
    return Problem(n_agents, {name: torch.as_tensor(array, device=config.device) for name, array in arrays.items()})


def rotated(rng: np.random.Generator, problem: Problem) -> Problem:
    """The problem with each instance turned by a random angle about the middle of the unit square.

    An instance some of whose nodes would leave the square is scaled down until they lie on its edge, by at most
    sqrt(2).
    """
    middle = 0.5
    nodes = torch.as_tensor(problem.nodes) - middle
    angle = torch.as_tensor(rng.uniform(0, 2 * np.pi, len(nodes)), device=nodes.device)
    cos, sin = angle.cos(), angle.sin()
    turns = torch.stack([torch.stack([cos, sin], 1), torch.stack([-sin, cos], 1)], 1)  # (B, 2, 2), for row vectors
    turned = nodes @ turns
    turned = turned * (middle / turned.abs().amax((1, 2), keepdim=True)).clamp(max=1.0)
    return Problem(problem.n_agents, {**problem.arrays, "nodes": (turned + middle).clamp(0, 1)})


def repeat(problem: Problem, samples: int) -> Problem:
    """Each instance ``samples`` times in succession, going through the eight symmetries of the square."""
    if samples == 1:
        return problem
    check_memory("samples", samples, BYTES_PER_NODE * len(problem.nodes) * problem.n_nodes)
    repeated = {name: array.repeat_interleave(samples, 0) for name, array in problem.arrays.items()}
    return Problem(problem.n_agents, repeated | {"nodes": views(problem.nodes, samples).flatten(0, 1)})


def draw_set(rng: np.random.Generator, config: RunConfig, count: int, sizes: int = 8) -> list[Problem]:
    """``count`` instances to compare policies on, in at most ``sizes`` batches, each with its own n and m.

    There are more batches if there are more scenarios, which take turns.
    """
    check_memory("the number of instances to compare policies on", count, BYTES_PER_NODE * config.n_nodes[0])
    turns = config.scenario
    sizes = min(max(sizes, len(turns)), count)
    counts = [count // sizes + (number < count % sizes) for number in range(sizes)]
    return [draw(rng, config, part, scenario=turns[i % len(turns)]) for i, part in enumerate(counts)]


def play(policy: nn.Module, problem: Problem, config: RunConfig, decode: Decode, keep: bool = False) -> Episode:
    """Play whole episodes, one per instance. The only place where training meets the environment in one process.

    Args:
        policy: a network, or its actor.
        keep: keep each decision's action and what the policy read, so that it can be evaluated again.
    """
    actor = as_actor(policy)
    env = environment(problem, config)
    keys = present(env, actor.in_keys) if keep else ()
    with autocast(config):
        return rollout(actor, env, decode, problem, keys)


def costs(policy: nn.Module, problems: list[Problem], config: RunConfig) -> Tensor:
    """(sum of B,) Greedy cost (the makespan, or the penalty of a truncated episode) of every instance."""
    return torch.cat([-play(policy, part, config, "greedy").reward for part in problems])


def present(env: BatchedMTSP, keys: Iterable[Key]) -> tuple[Key, ...]:
    """Those of ``keys`` that the environment's observations have, each once: some come in worlds only."""
    has = set(env.observation_spec.keys(include_nested=True))
    return tuple(dict.fromkeys(key for key in keys if key in has))


def environment(problem: Problem, config: RunConfig) -> BatchedMTSP:
    """The run's environment for a batch of that size and with such world fields.

    Environments are reused: building their specs is slow.
    """
    world = tuple((name, tuple(problem.arrays[name].shape[1:])) for name in problem.world)
    depot = config.world_depot if world else config.depot
    return _environment(
        problem.n_nodes, problem.n_agents, len(problem.nodes), world, config.speed, depot, config.device
    )


@lru_cache(maxsize=1024)
def _environment(
    n_nodes: int,
    n_agents: int,
    batch: int,
    world: tuple[tuple[str, tuple[int, ...]], ...],
    speed: float,
    depot: Depot,
    device: str,
) -> BatchedMTSP:
    def uneventful(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
        """A world with the same fields in which everything goes as in the plain problem."""
        return {name: np.full((batch, *shape), FIELDS[name].usual) for name, shape in world}

    options = {"device": device, "check_actions": False}
    return BatchedMTSP(n_nodes, n_agents, batch, speed, depot, scenario=uneventful, **options)


def autocast(config: RunConfig) -> torch.autocast:
    """A context with the run's precision."""
    return torch.autocast(torch.device(config.device).type, torch.bfloat16, enabled=config.precision == "bfloat16")
