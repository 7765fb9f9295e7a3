"""The reference solver's aims: its mean gap to the best known tours within milliseconds to seconds on one core."""

from __future__ import annotations

import json
import math
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
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours
from mtsp_env.reference import compile_kernels, improve
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
    shorter: dict[int, float]  # what far longer runs took off best known tours (0.01 is 1 %), by the instance's number

    @property
    def met(self) -> bool:
        """The mean gap is what was aimed at, or less."""
        return bool(self.gap.mean() <= self.aim.gap)

    @property
    def gap_of_sample(self) -> tuple[float, float]:
        """Mean gap, and its standard error, if all that is not proved gave way as the sampled instances did."""
        shorter = np.array(list(self.shorter.values()))
        left = ~self.proved
        left[list(self.shorter)] = False  # their best known tours are those of the far longer run already
        share = left.mean()
        return self.gap.mean() + share * shorter.mean(), math.hypot(sem(self.gap), share * sem(shorter))


def main(
    instances: int = 50,
    cells: tuple[str, ...] = tuple(aim.label for aim in AIMS),
    best_seconds: float | None = None,
    sample: int = 0,
    sample_seconds: float = 600.0,
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
        sample: so many instances of each cell, drawn from those that are not proved optimal, are run for
            ``sample_seconds`` (``out`` with "-sample.json" remembers), for what that takes off their best known tours.
            0: none. At least 2, for a standard error.
        sample_seconds: of these far longer runs.
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
    check_count("sample", sample, minimum=0)
    if sample == 1:
        raise ValueError("sample must be 0 or at least 2, got 1")
    check_seconds("sample_seconds", sample_seconds)
    compile_kernels()
    aims, spent = [known[label] for label in cells], out.with_suffix(".json")
    if best_seconds is not None:
        for aim in aims:
            search(aim.cell(instances), seed, best_seconds, workers, spent, folder)
    sampled = out.with_name(f"{out.stem}-sample.json")
    for aim in aims if sample else []:
        search_sample(aim.cell(instances), seed, sample_seconds, sample, workers, sampled, folder)
    found = [measure(aim, aim.cell(instances), seed, out, folder, sample_seconds) for aim in aims]
    table = markdown(found)
    if any(len(one.shorter) > 1 for one in found):
        table += f"\n\n{sample_markdown(found, sample_seconds)}"
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


def search_sample(cell: Cell, seed: int, seconds: float, count: int, workers: int, sampled: Path, folder: Path) -> None:
    """Far longer runs on ``count`` instances that are not proved; ``sampled`` has by how much their best known tours
    became shorter, and the runs that it has are not run again."""
    instances, kept = cell.instances(seed), best.read(cell, seed, folder)
    key, done = _sample_key(cell, seed, seconds), _read(sampled).get(_sample_key(cell, seed, seconds), {})
    cost = {i: makespan(instances[i], tours) for i, tours in kept.items()}
    order = [int(i) for i in np.random.default_rng(seed).permutation(cell.count)]
    unproved = [i for i in order if i in cost and cost[i] > lower_bound(instances[i]) + best.CLOSED]
    jobs = [i for i in unproved if str(i) not in done][: max(count - len(done), 0)]

    def run(i: int) -> tuple[int, Tours]:
        return i, improve(instances[i], seconds=seconds, seed=seed + i)

    with ThreadPoolExecutor(workers) as pool:
        for i, tours in track(pool.map(run, jobs), total=len(jobs), description=f"{cell.label}: {seconds:g} s"):
            best.merge(cell, seed, {i: tours}, folder)
            done[str(i)] = max(0.0, 1.0 - makespan(instances[i], tours) / cost[i])
            replace_text(sampled, json.dumps({**_read(sampled), key: done}))


def measure(aim: Aim, cell: Cell, seed: int, out: Path, folder: Path, sample_seconds: float = 600.0) -> Measured:
    """``improve`` for the aim's seconds on each instance of the cell; what was run before stands beside ``out``."""
    instances, found, wall, cpu = cell.instances(seed), {}, [], []
    for i, instance in enumerate(track(instances, description=f"{cell.label}: {aim.seconds:g} s")):
        started, started_cpu = time.perf_counter(), time.process_time()
        found[i] = improve(instance, seconds=aim.seconds, seed=seed + i)
        wall.append(time.perf_counter() - started)
        cpu.append(time.process_time() - started_cpu)
    best.merge(cell, seed, found, folder)
    kept = best.read(cell, seed, folder)
    cost, least = (np.array([makespan(x, tours[i]) for i, x in enumerate(instances)]) for tours in (found, kept))
    bound = np.array([lower_bound(instance) for instance in instances])
    searched = np.array(_spent(out.with_suffix(".json"), cell, seed)[: cell.count])
    sampled = _read(out.with_name(f"{out.stem}-sample.json")).get(_sample_key(cell, seed, sample_seconds), {})
    shorter = {int(i): gain for i, gain in sampled.items() if int(i) < cell.count}
    gap = np.maximum(cost / least - 1.0, 0.0)  # ties in the last bit are no gap below 0
    return Measured(aim, gap, np.array(wall), np.array(cpu), searched, least <= bound + best.CLOSED, shorter)


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


def sample_markdown(found: list[Measured], seconds: float) -> str:
    """What far longer runs of some instances say of the best known tours, a row for each aim that has two or more."""
    lines = [
        f"Runs of {seconds:g} s (`--sample`), on instances drawn from those that are not proved, and the mean gap if "
        "the best known tours of the others gave way as much:",
        "",
        "| n, m | instances | best known tours became shorter by, % | gap then, % | met |",
        "|---|---|---|---|---|",
    ]
    for one in found:
        if len(one.shorter) > 1:  # one alone has no standard error
            shorter, (gap, error) = np.array(list(one.shorter.values())), one.gap_of_sample
            lines.append(
                f"| {one.aim.n_nodes}, {one.aim.n_agents} | {len(shorter)} "
                f"| {100 * shorter.mean():.3f} ± {100 * sem(shorter):.3f} | {100 * gap:.2f} ± {100 * error:.2f} "
                f"| {'yes' if gap <= one.aim.gap else 'no'} |"
            )
    return "\n".join(lines)


def _sample_key(cell: Cell, seed: int, seconds: float) -> str:
    return f"{cell.label}-seed{seed}-{seconds:g}s"


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


def _read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
