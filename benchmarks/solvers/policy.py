"""Policies played in the environment: the shipped DAN and the two that every learned one must beat.

All on the CPU, as every other solver: times are to be compared.
"""

from __future__ import annotations

from benchmarks.policies import nearest as simple
from dan_policy import solve as play
from mtsp_env.instance import Instance, Tours


def dan(
    instance: Instance,
    seconds: float,
    seed: int,
    samples: int | None = None,
    augment: bool = False,
    policy: str = "default",
) -> Tours:
    """The shipped DAN, greedy (``samples`` None) or the best of ``samples`` (paper, Sec. 6). Ignores ``seconds``.

    ``augment``: in the square's symmetries.
    """
    if samples is None:
        return play(instance, policy, augment=augment, device="cpu").tours
    return play(instance, policy, decode="sample", samples=samples, seed=seed, device="cpu", augment=augment).tours


def improved_dan(instance: Instance, seconds: float, seed: int, policy: str = "default") -> Tours:
    """The shipped DAN, greedy, its tours polished by the reference solver for ``seconds`` after that."""
    return play(instance, policy, seed=seed, device="cpu", improve=seconds).tours


def nearest(instance: Instance, seconds: float, seed: int) -> Tours:
    """Each agent goes to the nearest unvisited city. Ignores ``seconds``."""
    return play(instance, simple.nearest, device="cpu").tours


def uniformly_random(instance: Instance, seconds: float, seed: int) -> Tours:
    """One game of uniformly random legal actions. Ignores ``seconds``."""
    return play(instance, simple.uniformly_random, decode="sample", samples=1, seed=seed, device="cpu").tours
