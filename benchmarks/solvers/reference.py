"""The reference solver: ruin and recreate, near-optimal in milliseconds to seconds."""

from __future__ import annotations

from mtsp_env.instance import Instance, Tours


def solve(instance: Instance, seconds: float, seed: int) -> Tours:
    """``mtsp_env.reference.improve`` from greedy insertion, for ``seconds``."""
    from mtsp_env.reference import improve  # numba: only where it is needed

    return improve(instance, seconds=seconds, seed=seed)
