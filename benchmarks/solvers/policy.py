"""Policies played in the environment: the shipped DAN and the two that every learned one must beat."""

from __future__ import annotations

from benchmarks.policies import nearest as simple
from dan_policy import make_actor, solve
from mtsp_env.instance import Instance, Tours


def dan(instance: Instance, seconds: float, seed: int, samples: int | None, policy: str = "default") -> Tours:
    """The shipped DAN, greedy (``samples`` None) or the best of ``samples`` (paper, Sec. 6). Ignores ``seconds``."""
    if samples is None:
        return solve(instance, policy).tours
    return solve(instance, policy, "sample", samples, seed).tours


def nearest(instance: Instance, seconds: float, seed: int) -> Tours:
    """Each agent goes to the nearest unvisited city. Ignores ``seconds``."""
    return solve(instance, make_actor(simple.nearest)).tours


def uniformly_random(instance: Instance, seconds: float, seed: int) -> Tours:
    """One game of uniformly random legal actions. Ignores ``seconds``."""
    return solve(instance, make_actor(simple.uniformly_random), "sample", 1, seed).tours
