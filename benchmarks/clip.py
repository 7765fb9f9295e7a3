"""How surely samples should be drawn: the best of them at ``sample_clip``'s C, at half and at twice of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.stats import sem
from tqdm import tqdm

from benchmarks.files import replace_text
from benchmarks.suite import Cell
from dan_policy.solution import sample_clip, solve

RESULTS = Path(__file__).parent / "results"
SEED = 123  # of no test set and of no training
SIZES = ("50x5", "50x10", "100x5", "100x10", "200x10")
FACTORS = (0.5, 1.0, 2.0)  # of sample_clip's own C


def main(
    sizes: tuple[str, ...] = SIZES,
    instances: int = 6,
    samples: int = 64,
    policy: str = "default",
    augment: bool = False,
    out: Path = RESULTS / "clip.md",
) -> None:
    """Sample with the C that ``sample_clip`` gives, half and twice of it, on instances of seed 123; write a table.

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
    if instances < 2:
        raise ValueError(f"instances must be at least 2, got {instances}")
    lines = [
        f"# Samples over C: best of {samples}{' in eight symmetries' if augment else ''}",
        "",
        f"Mean makespan over {instances} uniform instances of seed {SEED} (no test's), and the paired difference to "
        "the C of `dan_policy.solution.sample_clip` in %, ± standard error; weights "
        f'"{policy}". Made by `python -m benchmarks clip --sizes {" ".join(sizes)} --instances {instances} '
        f"--samples {samples}{' --augment' if augment else ''}`.",
        "",
        "| n, m | C | makespan | difference, % |",
        "|---|---|---|---|",
    ]
    for cell in [_cell(size, instances) for size in sizes]:
        own = sample_clip(10.0, cell.n_nodes, augment)
        costs = {factor: _costs(cell, own * factor, samples, policy, augment) for factor in FACTORS}
        for factor, cost in costs.items():
            change = 100 * (cost / costs[1.0] - 1)
            told = "–" if factor == 1.0 else f"{change.mean():+.2f} ± {sem(change):.2f}"
            lines.append(f"| {cell.heading} | {own * factor:g} | {cost.mean():.4f} | {told} |")
    replace_text(out, "\n".join(lines) + "\n")
    print("\n".join(lines))


def _costs(cell: Cell, clip: float, samples: int, policy: str, augment: bool) -> np.ndarray:
    """(instances,) makespans."""
    plans = tqdm(cell.instances(SEED), desc=f"{cell.label}, C = {clip:g}", leave=False)
    found = [solve(one, policy, "sample", samples, i, augment=augment, clip=clip) for i, one in enumerate(plans)]
    return np.array([solution.makespan for solution in found])


def _cell(size: str, instances: int) -> Cell:
    try:
        n_nodes, n_agents = map(int, size.split("x"))
    except ValueError:
        raise ValueError(f"sizes must be such as 50x5, got {size!r}") from None
    return Cell(n_nodes, n_agents, instances)
