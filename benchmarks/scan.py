"""What ``solve`` chooses by itself, beside other choices: how surely samples are drawn, and how far an agent sees."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from scipy.stats import sem
from tqdm import tqdm

from benchmarks.files import replace_text
from benchmarks.run import describe_machine
from benchmarks.suite import Cell
from dan_policy import Solution, solve
from dan_policy.heuristics import sampling_clip
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance

RESULTS = Path(__file__).parent / "results"
SEED = 123  # of no test set and of no training
CLIP_SIZES = ("50x5", "50x10", "100x5", "100x10", "200x10")
FACTORS = (1.0, 0.5, 2.0)  # of sampling_clip's own C
VIEW_SIZES = ("200x10", "300x10", "500x10", "1000x10")
VIEWS = (200, 100, 50)


def clip(
    sizes: tuple[str, ...] = CLIP_SIZES,
    instances: int = 6,
    samples: int = 64,
    policy: str = "default",
    augment: bool = False,
    out: Path = RESULTS / "clip.md",
) -> None:
    """Sample with the C that ``sampling_clip`` gives, half and twice of it, on instances of seed 123; write a table.

    Args:
        sizes: such as 50x5.
        instances: of each, at least 2.
        samples: of each plan.
        policy: a shipped model or a file of weights.
        augment: see the instance in eight symmetries.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size.
    """

    def plan(instance: Instance, seed: int, value: float) -> Solution:
        return solve(instance, policy, decode="sample", samples=samples, seed=seed, augment=augment, clip=value)

    cells = _cells(sizes, instances)
    head = (
        f"# Samples over C: best of {samples}{' in eight symmetries' if augment else ''}",
        f"the C of `dan_policy.heuristics.sampling_clip`, which stands first, in %, ± standard error; "
        f'weights "{policy}". Made by `python -m benchmarks clip --sizes {" ".join(sizes)} --instances {instances} '
        f"--samples {samples}{' --augment' if augment else ''}`.",
    )
    values = [[factor * sampling_clip(10.0, cell.n_nodes, augment) for factor in FACTORS] for cell in cells]
    _write(out, *head, "C", cells, values, plan)


def view(
    sizes: tuple[str, ...] = VIEW_SIZES,
    instances: int = 8,
    samples: int | None = None,
    policy: str = "default",
    out: Path = RESULTS / "view.md",
) -> None:
    """Plan with agents that see all cities, and with ones that see the nearest few alone, on instances of seed 123.

    Args:
        sizes: such as 500x10.
        instances: of each, at least 2.
        samples: of each plan; None: greedy plans.
        policy: a shipped model or a file of weights.
        out: file for the table.

    Raises:
        ValueError: fewer than 2 instances, or a bad size.
    """

    def plan(instance: Instance, seed: int, value: float) -> Solution:
        decode = {"decode": "greedy"} if samples is None else {"decode": "sample", "samples": samples}
        return solve(instance, policy, seed=seed, view=int(value), **decode)

    cells = _cells(sizes, instances)
    processor = describe_machine()["processor"]
    head = (
        f"# What agents see: {'greedy plans' if samples is None else f'best of {samples} samples'}",
        f'seeing all cities, which stands first, in %, ± standard error; "{policy}", {processor}. '
        f"Made by `python -m benchmarks view --sizes {' '.join(sizes)} --instances {instances}"
        f"{'' if samples is None else f' --samples {samples}'}`.",
    )
    values = [[cell.n_nodes, *(view for view in VIEWS if view < cell.n_nodes)] for cell in cells]
    _write(out, *head, "cities in view", cells, values, plan)


def _cells(sizes: Iterable[str], instances: int) -> list[Cell]:
    check_count("instances", instances, minimum=2)
    return [_cell(size, instances) for size in sizes]


def _cell(size: str, instances: int) -> Cell:
    try:
        n_nodes, n_agents = map(int, size.split("x"))
    except ValueError:
        raise ValueError(f"sizes must be such as 50x5, got {size!r}") from None
    return Cell(n_nodes, n_agents, instances)


def _write(
    out: Path,
    title: str,
    compared: str,
    what: str,
    cells: list[Cell],
    values: list[list[float]],
    plan: Callable[[Instance, int, float], Solution],
) -> None:
    """A row for each cell and value; differences are to the cell's first value."""
    lines = [
        title,
        "",
        f"Mean makespan over {cells[0].count} uniform instances of seed {SEED} (no test's), and the paired difference "
        f"to {compared}",
        "",
        f"| n, m | {what} | makespan | difference, % | seconds |",
        "|---|---|---|---|---|",
    ]
    for cell, choices in zip(cells, values, strict=True):
        first = None
        for value in choices:
            instances = enumerate(tqdm(cell.instances(SEED), desc=f"{cell.label}, {what} {value:g}", leave=False))
            found = [plan(instance, i, value) for i, instance in instances]
            cost, seconds = (np.array([getattr(one, name) for one in found]) for name in ("makespan", "seconds"))
            first = cost if first is None else first
            change = 100 * (cost / first - 1)
            told = "–" if first is cost else f"{change.mean():+.2f} ± {sem(change):.2f}"
            lines.append(f"| {cell.heading} | {value:g} | {cost.mean():.4f} | {told} | {np.median(seconds):.2f} |")
    replace_text(out, "\n".join(lines) + "\n")
    print("\n".join(lines))
