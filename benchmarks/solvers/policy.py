"""Policies as solvers: the shipped networks, ScheduleNet, and the two that a trained policy must beat.

They run on the CPU, as all other solvers do, so that times can be compared.
"""

from __future__ import annotations

from functools import cache

from torch import nn

from benchmarks.policies import nearest as policies
from benchmarks.solvers import WEIGHTS
from dan_policy import SolveOptions, load
from dan_policy import solve as solve_with
from mtsp_env.instance import Instance, Tours


def shipped(
    instance: Instance,
    seconds: float,
    seed: int,
    samples: int | None = None,
    augment: bool = False,
    reconstruct: int = 0,
    policy: str = "default",
) -> Tours:
    """Tours by a shipped network, greedy or the best of ``samples`` (paper, Sec. 6); ``seconds`` is ignored.

    With ``augment`` the instance is solved in the eight symmetries of the square. After that, parts of the best tours
    are planned again in ``reconstruct`` rounds.
    """
    return _plan(policy, instance, seed, samples, augment, reconstruct)


def schedulenet(
    instance: Instance, seconds: float, seed: int, samples: int | None = None, augment: bool = False
) -> Tours:
    """Tours by ScheduleNet (``benchmarks/policies/schedulenet.py``); arguments as in ``shipped``."""
    return _plan(_schedulenet(), instance, seed, samples, augment)


def _plan(
    policy: str | nn.Module, instance: Instance, seed: int, samples: int | None, augment: bool, reconstruct: int = 0
) -> Tours:
    options = SolveOptions(augment=augment, reconstruct=reconstruct, seed=seed, device="cpu")
    if samples is None:
        return solve_with(instance, policy, options).tours
    return solve_with(instance, policy, options, decode="sample", samples=samples).tours


@cache
def _schedulenet() -> nn.Module:
    return load(WEIGHTS / "schedulenet.safetensors", network="benchmarks.policies.schedulenet:ScheduleNet")


def improved(instance: Instance, seconds: float, seed: int, policy: str) -> Tours:
    """Greedy tours by a shipped network, improved by the reference solver for ``seconds``."""
    return solve_with(instance, policy, seed=seed, device="cpu", improve=seconds).tours


def nearest(instance: Instance, seconds: float, seed: int) -> Tours:
    """Tours of agents that go to the nearest unvisited city; ``seconds`` is ignored."""
    return solve_with(instance, policies.nearest, device="cpu").tours


def uniformly_random(instance: Instance, seconds: float, seed: int) -> Tours:
    """Tours of one episode of uniformly random legal actions; ``seconds`` is ignored."""
    return solve_with(instance, policies.uniformly_random, decode="sample", samples=1, seed=seed, device="cpu").tours
