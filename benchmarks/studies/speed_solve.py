"""Time and memory of ``dan_policy.solve`` with shipped models, each case in a process of its own."""

from __future__ import annotations

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from statistics import median

import torch
from rich.table import Table

from benchmarks.studies.timing import machine_title
from benchmarks.suite import SEED, Cell
from dan_policy import solve
from dan_policy.network import Decode
from mtsp_env.processes import end_with_parent


@dataclass(frozen=True)
class Case:
    """A size and a way of decoding, and a target in seconds, if there is one."""

    n_nodes: int
    n_agents: int
    decode: Decode
    target: float | None = None

    @property
    def name(self) -> str:
        """For example "50, 5, s.64"."""
        return f"{self.n_nodes}, {self.n_agents}, {'g.' if self.decode == 'greedy' else 's.64'}"


CASES = (
    Case(50, 5, "greedy", 0.06),
    Case(50, 5, "sample", 1.5),
    Case(200, 10, "greedy", 0.5),
    Case(200, 10, "sample"),
    Case(1000, 10, "greedy", 6.0),
)
POLICIES = ("default", "dan")


@dataclass(frozen=True)
class Cost:
    """What solving takes.

    Attributes:
        first: seconds of the first call in a process.
        later: median seconds of later calls.
        memory_before: peak memory in bytes before the first call, with the model loaded.
        memory: peak memory in bytes.
    """

    first: float
    later: float
    memory_before: int
    memory: int


def speed_table(threads: int = 1, repeats: int = 5) -> Table:
    """Measure every case with each policy."""
    heads = ("n, m", "policy", "target, s", "first call, s", "later calls, s", "memory, MiB", "before solving, MiB")
    table = Table(*heads, title=f"dan_policy.solve, {threads} thread{'s' * (threads > 1)}; {machine_title()}")
    spawn = multiprocessing.get_context("spawn")
    for case in CASES:
        for policy in POLICIES:
            with ProcessPoolExecutor(1, spawn, end_with_parent) as pool:
                cost = pool.submit(measure, case, policy, threads, repeats).result()
            target = "" if case.target is None else f"{case.target:g}"
            memory = [f"{size / 2**20:,.0f}" for size in (cost.memory, cost.memory_before)]
            table.add_row(case.name, policy, target, f"{cost.first:.3f}", f"{cost.later:.3f}", *memory)
    return table


def measure(case: Case, policy: str, threads: int, repeats: int) -> Cost:
    """Solve a test instance in this process, once and then ``repeats`` times more."""
    torch.set_num_threads(threads)
    tiny, (instance,) = Cell(5, 2, 1).instances(SEED)[0], Cell(case.n_nodes, case.n_agents, 1).instances(SEED)
    solve(tiny, policy, device="cpu")  # loads the model
    before = peak_memory()
    seconds = [solve(instance, policy, decode=case.decode, device="cpu").seconds for _ in range(1 + repeats)]
    return Cost(seconds[0], median(seconds[1:]), before, peak_memory())


def peak_memory() -> int:
    """Peak memory of this process in bytes. Raises OSError if the system does not report it."""
    try:
        import resource
    except ModuleNotFoundError as error:
        raise OSError(f"{sys.platform} does not report the peak memory of a process") from error
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
