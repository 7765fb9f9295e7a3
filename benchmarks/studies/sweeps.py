"""Sweeps over options of ``solve``: C, the range of the logits of samples, the cities in view, how certain foreseen
decisions must be, and ways to search."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.progress import track
from scipy.stats import sem

from benchmarks.files import write_text
from benchmarks.harness.machine import describe_machine
from benchmarks.reports.markdown import markdown_table
from benchmarks.suite import Cell, check_instances
from dan_policy import SolveOptions, solve
from dan_policy.heuristics import sampling_clip

RESULTS = Path(__file__).parents[1] / "results"
SEED = 123  # not that of a test set or of training
C_FACTORS = (1.0, 0.5, 2.0)  # in units of the C that ``solve`` uses
VIEWS = (200, 100, 50)  # cities
CONFIDENCES = (1.0, 0.99, 0.97, 0.95, 0.9)


def sweep_clip(
    sizes: tuple[str, ...] = ("50x5", "50x10", "100x5", "100x10", "200x10"),
    instances: int = 6,
    samples: int = 64,
    policy: str = "dan",
    augment: bool = False,
    out: Path = RESULTS / "clip.md",
) -> None:
    """Compare makespans of samples drawn with the C that ``solve`` uses, half of it and twice of it; write a table.

    Args:
        sizes: sizes of the instances, such as 50x5.
        instances: number of instances of each size, at least 2.
        samples: number of samples of each solve.
        policy: a shipped model or a file of weights.
        augment: solve each instance in its eight symmetries.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size.
    """
    cells = _cells(sizes, instances)
    title = f"# Samples over C: best of {samples}{' in eight symmetries' if augment else ''}"
    note = (
        f'C is `dan_policy.heuristics.sampling_clip`; the first line of a size has its value. Weights "{policy}". '
        f"Made by `python -m benchmarks sweep-clip --sizes {' '.join(sizes)} --instances {instances} "
        f"--samples {samples}{' --augment' if augment else ''}`."
    )
    common = SolveOptions(decode="sample", samples=samples, augment=augment)
    values = [[factor * sampling_clip(10.0, cell.n_nodes, augment) for factor in C_FACTORS] for cell in cells]
    choices = [{f"{c:g}": replace(common, clip=c) for c in cell_values} for cell_values in values]
    _sweep(out, title, note, "C", cells, choices, policy)


def sweep_view(
    sizes: tuple[str, ...] = ("200x10", "300x10", "500x10", "1000x10"),
    instances: int = 8,
    samples: int | None = None,
    policy: str = "dan",
    out: Path = RESULTS / "view.md",
) -> None:
    """Compare tours of agents that see all cities with those of agents that see only the nearest ones; write a table.

    Args:
        sizes: sizes of the instances, such as 500x10.
        instances: number of instances of each size, at least 2.
        samples: number of samples of each solve; by default decoding is greedy.
        policy: a shipped model or a file of weights.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size.
    """
    cells = _cells(sizes, instances)
    title = f"# Cities in view: {'greedy' if samples is None else f'best of {samples} samples'}"
    note = (
        f'In the first line of a size agents see all cities. Weights "{policy}", {describe_machine()["processor"]}. '
        f"Made by `python -m benchmarks sweep-view --sizes {' '.join(sizes)} --instances {instances}"
        f"{'' if samples is None else f' --samples {samples}'}`."
    )
    common = SolveOptions() if samples is None else SolveOptions(decode="sample", samples=samples)
    values = [[cell.n_nodes, *(view for view in VIEWS if view < cell.n_nodes)] for cell in cells]
    choices = [{f"{view}": replace(common, view=view) for view in cell_values} for cell_values in values]
    _sweep(out, title, note, "cities in view", cells, choices, policy)


def sweep_confidence(
    sizes: tuple[str, ...] = ("50x5", "100x5", "100x10", "200x10"),
    instances: int = 32,
    policy: str = "default",
    out: Path = RESULTS / "confidence.md",
) -> None:
    """Compare greedy games in which agents look for themselves with those in which they use what was foreseen.

    Args:
        sizes: sizes of the instances, such as 50x5.
        instances: number of instances of each size, at least 2.
        policy: a shipped model or a file of weights.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size.
    """
    cells = _cells(sizes, instances)
    note = (
        f"In the first line of a size, every agent looks for itself. Seconds on one thread, median over the instances. "
        f'Weights "{policy}", {describe_machine()["processor"]}. '
        f"Made by `python -m benchmarks sweep-confidence --sizes {' '.join(sizes)} --instances {instances}`."
    )
    choices = {f"{confidence:g}": SolveOptions(confidence=confidence) for confidence in CONFIDENCES}
    with _one_thread():
        _sweep(out, "# Confidence: greedy", note, "confidence", cells, [choices] * len(cells), policy)


def sweep_search(
    sizes: tuple[str, ...] = ("50x5", "50x10", "100x5", "100x10", "200x10"),
    instances: int = 12,
    samples: tuple[int, ...] = (64, 128),
    rounds: tuple[int, ...] = (4, 8, 16),
    policy: str = "default",
    out: Path = RESULTS / "search.md",
) -> None:
    """Compare ways to search with a policy: symmetries, samples, and re-construction of parts; write a table.

    Args:
        sizes: sizes of the instances, such as 50x5.
        instances: number of instances of each size, at least 2.
        samples: numbers of samples, drawn in the eight symmetries.
        rounds: numbers of rounds of re-construction, from the best of eight greedy games.
        policy: a shipped model or a file of weights.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size, number of samples or of rounds.
    """
    cells = _cells(sizes, instances)
    note = (
        f'Seconds on one thread, median over the instances. Weights "{policy}", {describe_machine()["processor"]}. '
        f"Made by `python -m benchmarks sweep-search --sizes {' '.join(sizes)} --instances {instances} "
        f"--samples {' '.join(map(str, samples))} --rounds {' '.join(map(str, rounds))} --policy {policy}`."
    )
    symmetric = SolveOptions(augment=True)
    ways = {"greedy": SolveOptions(), "greedy x8": symmetric}
    ways |= {f"best of {k} samples": replace(symmetric, decode="sample", samples=k) for k in samples}
    ways |= {f"greedy x8, {k} rounds": replace(symmetric, reconstruct=k) for k in rounds}
    with _one_thread():
        _sweep(out, "# Search with a policy", note, "way", cells, [ways] * len(cells), policy)


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch with one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _cells(sizes: Iterable[str], instances: int) -> list[Cell]:
    check_instances(instances, minimum=2)
    return [_cell(size, instances) for size in sizes]


def _cell(size: str, instances: int) -> Cell:
    try:
        n_nodes, n_agents = map(int, size.split("x"))
    except ValueError:
        raise ValueError(f"sizes must be such as 50x5, got {size!r}") from None
    return Cell(n_nodes, n_agents, instances)


def _sweep(
    out: Path,
    title: str,
    note: str,
    parameter: str,
    cells: list[Cell],
    choices: list[dict[str, SolveOptions]],
    policy: str,
) -> None:
    """Solve the instances of each cell with each of its choices; differences are to the cell's first choice."""
    lines = []
    for cell, cell_choices in zip(cells, choices, strict=True):
        first = None
        for name, options in cell_choices.items():
            instances = track(cell.instances(SEED), f"{cell.label}, {parameter} {name}", transient=True)
            solutions = [solve(instance, policy, options, seed=i) for i, instance in enumerate(instances)]
            cost = np.array([solution.makespan for solution in solutions])
            seconds = np.median([solution.seconds for solution in solutions])
            first = cost if first is None else first
            change = 100 * (cost / first - 1)
            difference = "–" if first is cost else f"{change.mean():+.2f} ± {sem(change):.2f}"
            lines.append([cell.heading, name, f"{cost.mean():.4f}", difference, f"{seconds:.2f}"])
    table = markdown_table(["n, m", parameter, "makespan", "difference, %", "seconds"], lines)
    text = (
        f"{title}\n\nMean makespan over {cells[0].count} uniform instances of seed {SEED}, which is neither that of a "
        f"test set nor of training, and paired difference to the first line of the size in %, ± standard error. "
        f"{note}\n\n{table}\n"
    )
    write_text(out, text)
    print(text)
