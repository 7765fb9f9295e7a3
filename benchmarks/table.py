"""Tables: how far methods are from the best known tours, on the same instances, by the same judge."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from rich.progress import Progress
from scipy.stats import sem

from benchmarks import best, solvers
from benchmarks.suite import cells
from mtsp_env.tours import check_tours, makespan


def gaps(name: str, methods: list[str], seed: int, seconds: float = 1.0) -> dict[str, dict[str, np.ndarray]]:
    """method -> cell -> (count, 2): each instance's gap to its best known tours (0.1 is 10 %), and seconds."""
    found: dict[str, dict[str, np.ndarray]] = {}
    with Progress() as progress:
        for method in methods:
            solve = solvers.find(method)
            task = progress.add_task(method, total=sum(cell.count for cell in cells(name)))
            found[method] = {}
            for cell in cells(name):
                solve(cell.instances(seed)[0], seconds, seed)  # not counted: loads weights, warms caches
                rows = []
                for i, (instance, known) in enumerate(zip(cell.instances(seed), best.costs(cell, seed), strict=True)):
                    start = time.perf_counter()
                    tours = solve(instance, seconds, seed + i)
                    rows.append((0.0, time.perf_counter() - start))
                    check_tours(instance, tours)
                    rows[-1] = (makespan(instance.nodes, tours) / known - 1.0, rows[-1][1])
                    progress.advance(task)
                found[method][cell.label] = np.array(rows)
    return found


def markdown(name: str, found: dict[str, dict[str, np.ndarray]]) -> str:
    """Mean gap in per cent with its standard error, per cell and over all instances, and mean seconds."""
    labels = [cell.label for cell in cells(name)]
    counts = [cell.count for cell in cells(name)]
    heads = [f"{label.replace('x', ', ')} ({count})" for label, count in zip(labels, counts, strict=True)]
    lines = [
        f"| gap to best known, % (instances) | {' | '.join(heads)} | all ({sum(counts)}) | seconds |",
        "|---|" + "---|" * (len(heads) + 2),
    ]
    for method, rows in found.items():
        everything = np.concatenate(list(rows.values()))
        columns = [_percent(rows[label][:, 0]) for label in labels] + [_percent(everything[:, 0])]
        lines.append(f"| {method} | {' | '.join(columns)} | {everything[:, 1].mean():.3f} |")
    return "\n".join(lines)


def _percent(gap: np.ndarray) -> str:
    mean = round(100 * gap.mean(), 1) + 0.0  # no -0.0
    return f"{mean:.1f} ± {100 * sem(gap):.1f}"


def plot(name: str, found: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    """Mean gap (and its standard error) against mean seconds: a point per method, all instances of the set together."""
    from matplotlib.figure import Figure

    ax = (figure := Figure(figsize=(6.4, 4.0), layout="constrained")).subplots()
    for method, rows in found.items():
        everything = np.concatenate(list(rows.values()))
        gap, seconds = 100 * everything[:, 0], everything[:, 1].mean()
        ax.errorbar(seconds, gap.mean(), yerr=sem(gap), fmt="o", capsize=3, label=method)
        ax.annotate(method, (seconds, gap.mean()), xytext=(8, 4), textcoords="offset points")
    ax.set_xscale("log")
    ax.set_yscale("symlog", linthresh=10)
    ax.set_yticks([0, 5, 10, 20, 50, 100, 200], ["0", "5", "10", "20", "50", "100", "200"])
    ax.set(xlabel="seconds per instance", ylabel="gap to the best known tours, %", ylim=(-1, None))
    ax.set_title(f"{sum(cell.count for cell in cells(name))} uniform instances", fontsize=11)
    ax.margins(x=0.25)
    ax.spines[["top", "right"]].set_visible(False)
    temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
    figure.savefig(temporary, dpi=130)
    temporary.replace(path)
