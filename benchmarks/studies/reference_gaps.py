"""The reference solver's mean gaps to the best known tours after milliseconds to seconds, against targets."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy.stats import sem

from benchmarks import best_known
from benchmarks.files import write_text
from benchmarks.harness.machine import describe_machine
from benchmarks.reports.markdown import markdown_table
from benchmarks.suite import SEED, Cell, check_instances
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.files import read_json
from mtsp_env.instance import Tours
from mtsp_env.reference import compile_kernels, improve
from mtsp_env.tours import lower_bound, makespan
from mtsp_env.writing import alone_in

REPORT = Path(__file__).parents[1] / "results" / "reference-gaps.md"


@dataclass(frozen=True)
class Target:
    """A mean ``gap`` (0.01 is 1 %) that the solver should reach within ``seconds`` on uniform instances of one size."""

    n_nodes: int
    n_agents: int
    seconds: float
    gap: float

    @property
    def label(self) -> str:
        """The label of its cell, such as "50x5"."""
        return self.cell(1).label

    def cell(self, count: int) -> Cell:
        """``count`` instances of this size; the first of them are those of the paper's tables."""
        return Cell(self.n_nodes, self.n_agents, count)


TARGETS = (
    Target(50, 5, 0.005, 0.01),
    Target(100, 5, 0.04, 0.015),
    Target(100, 10, 0.01, 0.005),
    Target(200, 10, 0.06, 0.005),
    Target(500, 10, 2.0, 0.02),
    Target(1000, 10, 10.0, 0.02),
)


@dataclass(frozen=True)
class Outcome:
    """What was measured for a target; arrays are (instances,).

    Attributes:
        target: the target.
        gap: gap to the best known tours; 0.01 is 1 %.
        wall: wall time of a run, in seconds.
        cpu: CPU time of a run, in seconds.
        long_run: seconds of the longest run that the best known tours are at least as good as.
        proved: bool, whether the best known tours are at the lower bound.
        reduction: by how much runs of far longer shortened best known tours (0.01 is 1 %), by instance number.
    """

    target: Target
    gap: np.ndarray
    wall: np.ndarray
    cpu: np.ndarray
    long_run: np.ndarray
    proved: np.ndarray
    reduction: dict[int, float]

    @property
    def reached(self) -> bool:
        """Whether the mean gap is at most that of the target."""
        return bool(self.gap.mean() <= self.target.gap)

    @property
    def extrapolated_gap(self) -> tuple[float, float]:
        """Mean gap and its standard error if all unproved tours can be shortened as much as the sampled ones were."""
        reduction = np.array(list(self.reduction.values()))
        unproved = ~self.proved
        unproved[list(self.reduction)] = False  # their best known tours are those of the far longer runs already
        share = unproved.mean()
        return self.gap.mean() + share * reduction.mean(), math.hypot(sem(self.gap), share * sem(reduction))


def main(
    instances: int = 50,
    cells: tuple[str, ...] = (),
    best_seconds: float | None = None,
    sample: int = 0,
    sample_seconds: float = 600.0,
    workers: int = 1,
    seed: int = SEED,
    out: Path = REPORT,
    folder: Path = best_known.FOLDER,
) -> None:
    """Measure the reference solver's mean gaps within milliseconds to seconds against its targets; write a table.

    Args:
        instances: number of instances in each cell, at least 2.
        cells: labels of targets, such as 50x5; by default all targets.
        best_seconds: seconds of a long run on each instance before anything is measured; by default there is none.
            Instances that had as long a run already (``out`` with the suffix .json lists them) are not run again.
        sample: number of instances of each cell, drawn from those that are not proved optimal, that are run for
            ``sample_seconds`` to see how much that shortens their best known tours (``out`` with the suffix
            -sample.json lists them). 0, or at least 2 for a standard error.
        sample_seconds: seconds of these far longer runs.
        workers: number of long runs at a time. Measurements have the machine to themselves.
        seed: seed of the instances.
        out: file for the table in Markdown.
        folder: folder of the best known tours; every run may improve them.

    Raises:
        ValueError: an argument outside its range.
    """
    check_instances(instances, minimum=2)
    check_count("workers", workers, minimum=1)
    check_count("seed", seed, minimum=0)
    by_label = {target.label: target for target in TARGETS}
    if unknown := [label for label in cells if label not in by_label]:
        raise ValueError(f"unknown cell {unknown[0]!r}; choose from {list(by_label)}")
    if best_seconds is not None:
        check_seconds("best_seconds", best_seconds)
    check_count("sample", sample, minimum=0)
    if sample == 1:
        raise ValueError("sample must be 0 or at least 2, got 1")
    check_seconds("sample_seconds", sample_seconds)
    compile_kernels()
    targets = [by_label[label] for label in cells or by_label]
    if best_seconds is not None:
        for target in targets:
            run_long(target.cell(instances), seed, best_seconds, workers, _long_runs_file(out), folder)
    if sample:
        for target in targets:
            run_sample(target.cell(instances), seed, sample_seconds, sample, workers, _sample_file(out), folder)
    outcomes = [measure(target, target.cell(instances), seed, out, folder, sample_seconds) for target in targets]
    tables = to_markdown(outcomes)
    if any(len(outcome.reduction) > 1 for outcome in outcomes):
        tables += f"\n\n{sample_to_markdown(outcomes, sample_seconds)}"
    print(tables)
    machine = describe_machine()
    head = (
        f"{instances} uniform instances of each size, seed {seed}; one thread on {machine['processor']}, "
        f"{machine['cores']} cores; {machine['platform']}, Python {machine['python']}, Numba {version('numba')}, "
        f"NumPy {version('numpy')}. Made by `python -m benchmarks reference-gaps --instances {instances}` after long "
        "runs (`--best-seconds`)."
    )
    write_text(out, f"# Gaps of the reference solver\n\n{head}\n\n{tables}\n\n{LEGEND}\n")


def run_long(cell: Cell, seed: int, seconds: float, workers: int, long_runs: Path, folder: Path) -> None:
    """Run the solver for ``seconds`` on each instance that had no run as long, and keep tours that are better.

    The file ``long_runs`` is updated after every run, so that an interrupted series can be resumed.
    """
    longest, instances = _longest_runs(long_runs, cell, seed), cell.instances(seed)

    def run(i: int) -> tuple[int, Tours]:
        return i, improve(instances[i], seconds=seconds, seed=seed + i)

    jobs = [i for i in range(cell.count) if longest[i] < seconds]
    for i, tours in _in_threads(run, jobs, workers, f"{cell.label}: long runs"):
        best_known.merge(cell, seed, {i: tours}, folder)
        longest[i] = seconds
        _update_json(long_runs, f"{cell.label}-seed{seed}", longest)


def run_sample(cell: Cell, seed: int, seconds: float, count: int, workers: int, file: Path, folder: Path) -> None:
    """Run the solver for ``seconds`` on ``count`` instances that are not proved optimal.

    ``file`` keeps by how much their best known tours became shorter; the runs that it lists are not run again.
    """
    instances, kept = cell.instances(seed), best_known.read(cell, seed, folder)
    key = _sample_key(cell, seed, seconds)
    reduction = _read_json(file).get(key, {})
    cost = {i: makespan(instances[i], tours) for i, tours in kept.items()}
    order = [int(i) for i in np.random.default_rng(seed).permutation(cell.count)]
    unproved = [i for i in order if i in cost and cost[i] > lower_bound(instances[i]) + best_known.TOLERANCE]
    jobs = [i for i in unproved if str(i) not in reduction][: max(count - len(reduction), 0)]

    def run(i: int) -> tuple[int, Tours]:
        return i, improve(instances[i], seconds=seconds, seed=seed + i)

    for i, tours in _in_threads(run, jobs, workers, f"{cell.label}: {seconds:g} s"):
        best_known.merge(cell, seed, {i: tours}, folder)
        reduction[str(i)] = max(0.0, 1.0 - makespan(instances[i], tours) / cost[i])
        _update_json(file, key, reduction)


def _in_threads(
    run: Callable[[int], tuple[int, Tours]], jobs: list[int], workers: int, description: str
) -> Iterable[tuple[int, Tours]]:
    with ThreadPoolExecutor(workers) as pool:  # the solver's kernels release Python's lock
        yield from track(pool.map(run, jobs), total=len(jobs), description=description)


def measure(target: Target, cell: Cell, seed: int, out: Path, folder: Path, sample_seconds: float = 600.0) -> Outcome:
    """Run ``improve`` for the target's seconds on each instance of the cell; the files beside ``out`` give the rest."""
    instances, tours, wall, cpu = cell.instances(seed), {}, [], []
    for i, instance in enumerate(track(instances, description=f"{cell.label}: {target.seconds:g} s")):
        start, cpu_start = time.perf_counter(), time.process_time()
        tours[i] = improve(instance, seconds=target.seconds, seed=seed + i)
        wall.append(time.perf_counter() - start)
        cpu.append(time.process_time() - cpu_start)
    best_known.merge(cell, seed, tours, folder)
    kept = best_known.read(cell, seed, folder)
    cost = np.array([makespan(instance, tours[i]) for i, instance in enumerate(instances)])
    best = np.array([makespan(instance, kept[i]) for i, instance in enumerate(instances)])
    bound = np.array([lower_bound(instance) for instance in instances])
    reduction = _read_json(_sample_file(out)).get(_sample_key(cell, seed, sample_seconds), {})
    return Outcome(
        target,
        gap=np.maximum(cost / best - 1.0, 0.0),  # rounding could make it negative
        wall=np.array(wall),
        cpu=np.array(cpu),
        long_run=np.array(_longest_runs(_long_runs_file(out), cell, seed)[: cell.count]),
        proved=best <= bound + best_known.TOLERANCE,
        reduction={int(i): value for i, value in reduction.items() if int(i) < cell.count},
    )


LEGEND = (
    "Gap: mean ± standard error of the gap to the best known tours of the same instance, which are at least as good as "
    "those of a long run of the reference solver itself. Proved: the best known tours are at the lower bound, so they "
    "are optimal. Wall: mean (largest) wall time of the whole call. CPU: mean CPU time of the process."
)


def to_markdown(outcomes: list[Outcome]) -> str:
    """A table with a line for each target."""
    lines = [
        [
            f"{outcome.target.n_nodes}, {outcome.target.n_agents}",
            f"{100 * outcome.target.gap:g} % in {_milliseconds(outcome.target.seconds)} ms",
            f"{100 * outcome.gap.mean():.2f} ± {100 * sem(outcome.gap):.2f}",
            "yes" if outcome.reached else "no",
            f"{_milliseconds(outcome.wall.mean())} ({_milliseconds(outcome.wall.max())})",
            _milliseconds(outcome.cpu.mean()),
            f"{outcome.long_run.min():g}",
            f"{outcome.proved.sum()} of {len(outcome.gap)}",
        ]
        for outcome in outcomes
    ]
    heads = ["n, m", "target", "gap, %", "reached", "wall, ms", "CPU, ms", "long runs, s", "proved"]
    return markdown_table(heads, lines)


def sample_to_markdown(outcomes: list[Outcome], seconds: float) -> str:
    """What far longer runs say about the best known tours: a line for each target with two or more of them."""
    lines = []
    for outcome in outcomes:
        if len(outcome.reduction) > 1:  # a single one has no standard error
            reduction, (gap, error) = np.array(list(outcome.reduction.values())), outcome.extrapolated_gap
            lines.append(
                [
                    f"{outcome.target.n_nodes}, {outcome.target.n_agents}",
                    len(reduction),
                    f"{100 * reduction.mean():.3f} ± {100 * sem(reduction):.3f}",
                    f"{100 * gap:.2f} ± {100 * error:.2f}",
                    "yes" if gap <= outcome.target.gap else "no",
                ]
            )
    heads = ["n, m", "instances", "reduction of the best known makespan, %", "extrapolated gap, %", "reached"]
    return (
        f"Runs of {seconds:g} s (`--sample`) on instances drawn from those that are not proved optimal, and the mean "
        "gap if the best known tours of the other unproved instances could be shortened as much:\n\n"
        f"{markdown_table(heads, lines)}"
    )


def _milliseconds(seconds: float) -> str:
    return f"{1e3 * seconds:,.1f}".removesuffix(".0")


def _long_runs_file(out: Path) -> Path:
    return out.with_suffix(".json")


def _sample_file(out: Path) -> Path:
    return out.with_name(f"{out.stem}-sample.json")


def _sample_key(cell: Cell, seed: int, seconds: float) -> str:
    return f"{cell.label}-seed{seed}-{seconds:g}s"


def _longest_runs(file: Path, cell: Cell, seed: int) -> list[float]:
    """Seconds of the longest run on each instance, 0 if there was none; at least ``cell.count`` of them."""
    longest = _read_json(file).get(f"{cell.label}-seed{seed}", [])
    return longest + [0.0] * (cell.count - len(longest))


def _update_json(path: Path, key: str, value: object) -> None:
    """Set one entry of a file; processes that do so at the same time wait for one another."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with alone_in(path.parent):
        write_text(path, json.dumps({**_read_json(path), key: value}))


def _read_json(path: Path) -> dict:
    return read_json(path, keys=()) if path.exists() else {}
