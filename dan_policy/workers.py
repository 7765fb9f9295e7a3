"""The processes that plan for the service, so that the one that answers is never kept waiting by Python's lock."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from threading import Lock
from typing import Literal

from mtsp_env import reference
from mtsp_env.instance import Instance, Tours, from_coordinates
from mtsp_env.machine import check_memory
from mtsp_env.processes import end_with_parent

Method = Literal["reference", "dan"]
BYTES_PER_PROCESS = 2**27  # that has imported Numba, at least
NICENESS = 5  # of the planning processes: the one that answers goes first
_policy: str | None = None  # in a planning process: the name or file of its policy


class Workers:
    """Plans in processes of their own; calls may come from several threads at once.

    Args:
        count: number of processes.
        policy: a shipped model or a weights file for the method "dan"; None: only "reference" is planned.

    Raises:
        ImportError: the policy's packages are missing.
        OSError: no such weights.
        ValueError: so many processes do not fit into the memory.
    """

    def __init__(self, count: int, policy: str | None):
        check_memory("processes", count, BYTES_PER_PROCESS)
        self.count, self.policy = count, policy
        if policy is not None:
            _load(policy)  # here, so that what is wrong with it is an error of this process
        self._lock = Lock()
        self._pool = self._start()

    def __call__(
        self, instance: Instance, method: Method, seconds: float, seed: int, prefixes: Sequence[Sequence[int]] | None
    ) -> Tours:
        """Tours that begin with ``prefixes``, planned by a process."""
        pool = self._pool
        try:
            return pool.submit(plan, instance, method, seconds, seed, prefixes).result()
        except BrokenProcessPool:  # a process was killed, for example because memory ran out
            with self._lock:
                if self._pool is pool:
                    self._pool = self._start()
            raise

    def close(self) -> None:
        """End the processes; plans that have not begun are dropped."""
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _start(self) -> ProcessPoolExecutor:
        pool = ProcessPoolExecutor(
            self.count, multiprocessing.get_context("spawn"), initializer=_prepare, initargs=(self.policy,)
        )
        for ready in [pool.submit(reference.compile_kernels) for _ in range(self.count)]:
            ready.result()
        return pool


def plan(
    instance: Instance, method: Method, seconds: float, seed: int, prefixes: Sequence[Sequence[int]] | None
) -> Tours:
    """Tours by the reference solver in about ``seconds``, or by the policy, greedily, however long that takes."""
    if method == "reference":
        return reference.improve(instance, seconds=seconds, seed=seed, prefixes=prefixes)
    from dan_policy.planning import solve

    assert _policy is not None  # the service refuses the method otherwise
    return solve(instance, _policy, device="cpu", prefixes=prefixes).tours


def _prepare(policy: str | None) -> None:
    global _policy
    end_with_parent()
    os.nice(NICENESS)
    reference.compile_kernels()
    if policy is not None:
        _load(policy)
    _policy = policy


def _load(policy: str) -> None:
    """Read the weights, which stay in memory, and plan once. A process plans with one thread."""
    try:
        import torch

        from dan_policy.planning import solve
    except ImportError as error:
        raise ImportError(f'--policy needs torch and torchrl ({error}): pip install "mtsp-env[dan]"') from error
    torch.set_num_threads(1)  # the process is the service's own
    solve(from_coordinates([[0.0, 0.0], [1.0, 1.0]], n_agents=1), policy, device="cpu")
