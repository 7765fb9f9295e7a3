"""The reference solver's aims: its mean gap to the best known tours within milliseconds to seconds on one core."""

from __future__ import annotations

import json
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy.stats import sem

from benchmarks import best
from benchmarks.files import replace_text
from benchmarks.run import describe_machine
from benchmarks.suite import SEED, Cell
from mtsp_env.instance import Instance, Tours, check_count
from mtsp_env.reference import check_seconds, compile_kernels, improve
from mtsp_env.tours import lower_bound, makespan

REPORT = Path(__file__).parent / "results" / "aims.md"


@dataclass(frozen=True)
class Aim:
    """On uniform instances of one size: a mean ``gap`` (0.01 is 1 %) of at most this within ``seconds``."""

    n_nodes: int
    n_agents: int
    seconds: float
    gap: float

    @property
    def label(self) -> str:
        """For example "50x5", as of ``suite.Cell``."""
        return self.cell(1).label

    def cell(self, count: int) -> Cell:
        """Its instances: the first of them are those of the tables."""
        return Cell(self.n_nodes, self.n_agents, count)


AIMS = (
    Aim(50, 5, 0.005, 0.01),
    Aim(100, 5, 0.04, 0.015),
    Aim(100, 10, 0.01, 0.005),
    Aim(200, 10, 0.06, 0.005),
    Aim(500, 10, 2.0, 0.02),
    Aim(1000, 10, 10.0, 0.02),
)


@dataclass(frozen=True)
class Measured:
    """What came of an aim: arrays (instances,)."""

    aim: Aim
    gap: np.ndarray  # to the best known tours, 0.01 is 1 %
    wall: np.ndarray  # seconds
    cpu: np.ndarray  # seconds
    searched: np.ndarray  # seconds of the long run that the best known tours are at least as good as
    proved: np.ndarray  # bool, the best known tours are at the lower bound

    @property
    def met(self) -> bool:
        """The mean gap is what was aimed at, or less."""
        return bool(self.gap.mean() <= self.aim.gap)


def main(
    instances: int = 50,
    cells: tuple[str, ...] = tuple(aim.label for aim in AIMS),
    best_seconds: float | None = None,
    workers: int = 1,
    seed: int = SEED,
    out: Path = REPORT,
    folder: Path = best.FOLDER,
) -> None:
    """Look for the best tours where asked to, measure, print the table and write it to ``out``.

    Args:
        instances: in each cell, at least 2.
        cells: labels of aims, such as "50x5".
        best_seconds: of a long run on each instance before anything is measured; those that had as long a run already
            (``out`` with the suffix ".json" remembers) are not run again. None: no long runs.
        workers: long runs side by side. Measurements have the machine to themselves.
        seed: of the instances.
        out: file for the table in Markdown.
        folder: of the best known tours, which only ever improve, also by what is measured.

    Raises:
        ValueError: an argument outside its range.
    """
    check_count("instances", instances, minimum=2)
    check_count("workers", workers, minimum=1)
    known = {aim.label: aim for aim in AIMS}
    if unknown := [label for label in cells if label not in known]:
        raise ValueError(f"unknown cell {unknown[0]!r}; choose from {list(known)}")
    if best_seconds is not None:
        check_seconds("best_seconds", best_seconds)
    compile_kernels()
    aims, spent = [known[label] for label in cells], out.with_suffix(".json")
    if best_seconds is not None:
        for aim in aims:
            search(aim.cell(instances), seed, best_seconds, workers, spent, folder)
    found = [measure(aim, aim.cell(instances), seed, spent, folder) for aim in aims]
    table = markdown(found)
    print(table)
    head = (
        f"{instances} uniform instances of each size, seed {seed}; one thread on {_machine()}. "
        f"Made by `python -m benchmarks aims --instances {instances}` after long runs (`--best-seconds`)."
    )
    replace_text(out, f"# The reference solver's aims\n\n{head}\n\n{table}\n\n{NOTE}\n")


def search(cell: Cell, seed: int, seconds: float, workers: int, spent: Path, folder: Path) -> None:
    """A long run on each instance that had none as long; its tours are kept as it ends, and then ``spent`` knows."""
    done = _spent(spent, cell, seed)
    jobs = [(i, instance) for i, instance in enumerate(cell.instances(seed)) if done[i] < seconds]

    def run(job: tuple[int, Instance]) -> tuple[int, Tours]:
        i, instance = job
        return i, improve(instance, seconds=seconds, seed=seed + i)

    with ThreadPoolExecutor(workers) as pool:  # the kernels run outside of Python's lock
        for i, tours in track(pool.map(run, jobs), total=len(jobs), description=f"{cell.label}: long runs"):
            best.merge(cell, seed, {i: tours}, folder)
            done[i] = seconds
            replace_text(spent, json.dumps({**_read(spent), f"{cell.label}-seed{seed}": done}))


def measure(aim: Aim, cell: Cell, seed: int, spent: Path, folder: Path) -> Measured:
    """``improve`` for the aim's seconds on each instance of the cell."""
    instances, found, wall, cpu = cell.instances(seed), {}, [], []
    for i, instance in enumerate(track(instances, description=f"{cell.label}: {aim.seconds:g} s")):
        started, started_cpu = time.perf_counter(), time.process_time()
        found[i] = improve(instance, seconds=aim.seconds, seed=seed + i)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - started_cpu)
    best.merge(cell, seed, found, folder)
    kept = best.read(cell, seed, folder)
    cost, least = (np.array([makespan(x.nodes, tours[i]) for i, x in enumerate(instances)]) for tours in (found, kept))
    bound = np.array([lower_bound(instance) for instance in instances])
    searched = np.array(_spent(spent, cell, seed)[: cell.count])
    gap = np.maximum(cost / least - 1.0, 0.0)  # ties in the last bit are no gap below 0
    return Measured(aim, gap, np.array(wall), np.array(cpu), searched, least <= bound + best.CLOSED)


NOTE = (
    "Gap: mean ± standard error of the makespan over that of the best known tours of the same instance, which are at "
    "least as good as a long run's of the reference solver itself; proved: best known tours at the lower bound, so "
    "optimal. Wall: mean (largest) time of the whole call; cpu: mean time that the process had a core."
)


def markdown(found: list[Measured]) -> str:
    """A row for each aim."""
    lines = [
        "| n, m | aim | gap, % | met | wall, ms | cpu, ms | long runs, s | proved |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in found:
        aim, count = one.aim, len(one.gap)
        columns = [
            f"{aim.n_nodes}, {aim.n_agents}",
            f"{100 * aim.gap:g} % in {_milliseconds(aim.seconds)} ms",
            f"{100 * one.gap.mean():.2f} ± {100 * sem(one.gap):.2f}",
            "yes" if one.met else "no",
            f"{_milliseconds(one.wall.mean())} ({_milliseconds(one.wall.max())})",
            _milliseconds(one.cpu.mean()),
            f"{one.searched.min():g}",
            f"{one.proved.sum()} of {count}",
        ]
        lines.append(f"| {' | '.join(columns)} |")
    return "\n".join(lines)


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:,.1f}".removesuffix(".0")


def _machine() -> str:
    machine = describe_machine()
    versions = f"Python {machine['python']}, Numba {version('numba')}, NumPy {version('numpy')}"
    return f"{machine['processor']}, {machine['cores']} cores; {machine['platform']}, {versions}"


def _spent(path: Path, cell: Cell, seed: int) -> list[float]:
    """Seconds of the longest run on each instance, of the cell's at least; 0: none."""
    done = _read(path).get(f"{cell.label}-seed{seed}", [])
    return done + [0.0] * (cell.count - len(done))


def _read(path: Path) -> dict[str, list[float]]:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
