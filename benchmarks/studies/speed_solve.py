"""How fast ``dan_policy.solve`` plans with the shipped model, and what memory that takes: a process for each row."""

from __future__ import annotations

import multiprocessing
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from statistics import median

import torch
from rich.console import Console
from rich.table import Table

from benchmarks.speed import machine
from benchmarks.suite import SEED, Cell
from dan_policy import solve
from dan_policy.episode import Decode


@dataclass(frozen=True)
class Plan:
    """What is planned, and within how many seconds it should be (None: nothing was aimed at)."""

    n_nodes: int
    n_agents: int
    decode: Decode
    aim: float | None = None

    @property
    def name(self) -> str:
        """For example "50, 5, s.64"."""
        return f"{self.n_nodes}, {self.n_agents}, {'g.' if self.decode == 'greedy' else 's.64'}"


PLANS = (
    Plan(50, 5, "greedy", 0.06),
    Plan(50, 5, "sample", 1.5),
    Plan(200, 10, "greedy", 0.5),
    Plan(200, 10, "sample"),
    Plan(1000, 10, "greedy", 6.0),
)


@dataclass(frozen=True)
class Measured:
    """Seconds of the first call in a process and the median of later ones; the peak of its memory, in bytes.

    ``before`` is the memory of Python, torch and the loaded model, ``peak`` that and what planning added.
    """

    first: float
    later: float
    before: int
    peak: int


def main(threads: tuple[int, ...] = (1, 2), repeats: int = 5) -> None:
    """Print the table."""
    title = f"dan_policy.solve, shipped model; {machine()}"
    table = Table("n, m", "threads", "aim, s", "first, s", "later, s", "memory, MiB", "of these before", title=title)
    spawn = multiprocessing.get_context("spawn")
    for plan in PLANS:
        for count in threads:
            with ProcessPoolExecutor(1, spawn) as pool:
                found = pool.submit(measure, plan, count, repeats).result()
            aim = "" if plan.aim is None else f"{plan.aim:g}"
            memory = [f"{size / 2**20:,.0f}" for size in (found.peak, found.before)]
            table.add_row(plan.name, str(count), aim, f"{found.first:.3f}", f"{found.later:.3f}", *memory)
    Console(width=130).print(table)


def measure(plan: Plan, threads: int, repeats: int) -> Measured:
    """In this process: the first plan of a test instance, then ``repeats`` more of it."""
    torch.set_num_threads(threads)
    tiny, (instance,) = Cell(5, 2, 1).instances(SEED)[0], Cell(plan.n_nodes, plan.n_agents, 1).instances(SEED)
    solve(tiny, device="cpu")  # loads the model
    before = peak_memory()
    seconds = [solve(instance, decode=plan.decode, device="cpu").seconds for _ in range(1 + repeats)]
    return Measured(seconds[0], median(seconds[1:]), before, peak_memory())


def peak_memory() -> int:
    """Bytes that this process has held in memory at most. Raises OSError where the system does not say."""
    try:
        import resource
    except ModuleNotFoundError as error:
        raise OSError(f"{sys.platform} does not say how much memory a process has held") from error
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
