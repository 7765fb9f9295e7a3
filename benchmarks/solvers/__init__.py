"""Solvers for the tables: ``solve(instance, seconds, seed) -> tours``, one file each; SOLVERS names them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from benchmarks.solvers import policy, reference
from mtsp_env.instance import Instance, Tours

Solve = Callable[[Instance, float, int], Tours]

SOLVERS: dict[str, Solve] = {
    "random": policy.uniformly_random,
    "nearest": policy.nearest,
    "dan-greedy": partial(policy.dan, samples=None),
    "dan-s64": partial(policy.dan, samples=64),
    "reference": reference.solve,
}


def find(name: str) -> Solve:
    """The solver of that name. Raises ValueError where there is none."""
    if name not in SOLVERS:
        raise ValueError(f"unknown solver {name!r}; choose from {sorted(SOLVERS)}")
    return SOLVERS[name]
