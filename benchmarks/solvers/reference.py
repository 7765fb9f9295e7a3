"""The reference solver of ``mtsp_env``: ruin and recreate, near-optimal in milliseconds to seconds."""

from __future__ import annotations

from mtsp_env.instance import Instance, Tours


def solve(instance: Instance, seconds: float, seed: int) -> Tours:
    """Tours by ``mtsp_env.reference.improve`` after ``seconds``, from greedy insertion."""
    from mtsp_env.reference import improve  # imports Numba

    return improve(instance, seconds=seconds, seed=seed)
