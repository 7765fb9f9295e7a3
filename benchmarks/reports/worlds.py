"""The table and the plots of games in worlds that change (``benchmarks/studies/worlds.py``)."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import sem

from benchmarks.files import write_text
from benchmarks.harness.world_rows import Row, parse_lines
from benchmarks.policies.in_worlds import BASELINE, METHODS, find_method
from benchmarks.reports.markdown import markdown_table
from benchmarks.reports.plots import OTHER, STYLE, save
from mtsp_env import SCENARIOS
from mtsp_env.reading import read_file

STYLES = {
    "random": ("0.75", "X"),
    "default": STYLE["joint-s64"],
    "dan": STYLE["dan-s64"],
    "world": ("#8c1c13", "P"),
    "plan-once": STYLE["ortools-gls"],
    "replanner-5": ("0.35", "D"),
    BASELINE: STYLE["reference"],
}

Games = dict[str, dict[tuple[str, str], dict[int, Row]]]
"""Rows by method, by (size, scenario) and by instance."""


def write_report(folder: Path) -> None:
    """Write ``report.md`` and one plot for each size beside the rows of ``folder``.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: a damaged row.
    """
    games = collect(list(parse_lines(folder / "rows.jsonl", read_file(folder / "rows.jsonl"))))
    sizes = sorted({size for cells in games.values() for size, _ in cells}, key=lambda size: int(size.split("x")[0]))
    parts = ["# Worlds that change"]
    for size in sizes:
        count = max(len(games[method].get((size, s), {})) for method in games for s in SCENARIOS)
        plot(games, size, folder / f"{size}.png")
        parts += [
            f"## n, m = {size.replace('x', ', ')}",
            f"Mean makespan ± standard error over {count} instances; in brackets the number of instances, if it is "
            "another.",
            makespans(games, size),
            f'Mean gap to "{METHODS[BASELINE].title}" on the same instances, in %, ± standard error.',
            gaps(games, size),
            f"![Gaps by scenario]({size}.png)",
        ]
    parts += [
        "## What it costs, and what it needs to know",
        "CPU time with one thread, which other work on the machine disturbs little. A planner's decisions are quick "
        "unless it searches: its last column is the time of all its decisions over its number of searches, at the "
        "size at which that is longest. A search has as many iterations as one core does in its milliseconds with "
        "half of the cities open.",
        costs(games, sizes),
    ]
    write_text(folder / "report.md", "\n\n".join(parts) + "\n")
    print("\n\n".join(parts))


def collect(rows: list[Row]) -> Games:
    """Rows by method, in the order of ``METHODS``, by (size, scenario), and by instance."""
    games: Games = defaultdict(lambda: defaultdict(dict))
    for row in rows:
        games[row.method][row.size, row.scenario][row.instance] = row
    known = [name for name in METHODS if name in games]
    return {name: games[name] for name in (*known, *sorted(games.keys() - METHODS))}


def relative_gaps(games: Games, method: str, size: str, scenario: str) -> np.ndarray:
    """Gaps to the baseline, in %, one for each instance that both have played."""
    own, base = (games.get(name, {}).get((size, scenario), {}) for name in (method, BASELINE))
    return np.array([100 * (own[i].makespan / base[i].makespan - 1) for i in sorted(own.keys() & base.keys())])


def makespans(games: Games, size: str) -> str:
    """The table of mean makespans of one size: a line for each method, a column for each scenario."""

    def values(method: str, scenario: str) -> np.ndarray:
        return np.array([row.makespan for row in games[method].get((size, scenario), {}).values()])

    return _table(games, size, values, decimals=3)


def gaps(games: Games, size: str) -> str:
    """The table of mean gaps to the baseline of one size."""
    return _table(games, size, lambda method, scenario: relative_gaps(games, method, size, scenario), decimals=1)


def _table(games: Games, size: str, values, decimals: int) -> str:
    scenarios = [name for name in SCENARIOS if any((size, name) in cells for cells in games.values())]
    cells = {(method, name): values(method, name) for method in games for name in scenarios}
    count = max(map(len, cells.values()), default=0)
    lines = []
    for method in games:
        found = [cells[method, name] for name in scenarios]
        lines.append([find_method(method).title, *(_mean(each, decimals, count) for each in found)])
    return markdown_table(["", *scenarios], lines)


def _mean(values: np.ndarray, decimals: int, count: int) -> str:
    if not len(values):
        return "–"
    text = f"{values.mean():.{decimals}f}"
    if len(values) > 1:
        text += f" ± {sem(values):.{decimals}f}"
    return text if len(values) == count else f"{text} ({len(values)})"


def costs(games: Games, sizes: list[str]) -> str:
    """The table of decisions per second, of the time of a search, and of what each method needs to know."""
    head = ["", "needs to know", *(f"decisions per second, {size}" for size in sizes), "ms per search"]
    lines = []
    for method, cells in games.items():
        rates, longest = [], 0.0
        for size in sizes:
            rows = [row for (own, _), rows in cells.items() if own == size for row in rows.values()]
            timed = [row for row in rows if row.seconds]
            rates.append(f"{sum(r.decisions for r in timed) / sum(r.seconds for r in timed):,.0f}" if timed else "–")
            searches = sum(row.searches or 0 for row in timed)
            if searches:
                longest = max(longest, 1000 * sum(row.seconds for row in timed) / searches)
        lines.append(
            [find_method(method).title, find_method(method).needs, *rates, f"{longest:.1f}" if longest else "–"]
        )
    return markdown_table(head, lines)


def plot(games: Games, size: str, path: Path) -> None:
    """Plot the mean gaps of one size: scenarios from left to right, a mark with its standard error for each method."""
    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    ax = figure.subplots()
    scenarios = [name for name in SCENARIOS if any((size, name) in cells for cells in games.values())]
    shown = [method for method in games if method != BASELINE]
    for index, method in enumerate(shown):
        points = []
        for x, scenario in enumerate(scenarios):
            values = relative_gaps(games, method, size, scenario)
            if len(values):
                offset = (index - (len(shown) - 1) / 2) * 0.8 / len(shown)
                points.append((x + offset, values.mean(), sem(values) if len(values) > 1 else 0.0))
        if points:
            colour, marker = STYLES.get(method) or STYLE.get(method) or OTHER[index % len(OTHER)]
            x, y, error = zip(*points, strict=True)
            ax.errorbar(x, y, error, color=colour, marker=marker, ms=7, mec="white", mew=0.5, lw=0, elinewidth=1,
                        label=find_method(method).title.replace("`", ""))  # fmt: skip
    ax.axhline(0.0, color="black", lw=1)
    ax.set_yscale("symlog", linthresh=10, linscale=1.5)
    ticks = [-5, 0, 5, 10, 20, 50, 100, 200, 500]
    ax.set_yticks(ticks, [str(tick) for tick in ticks])
    ax.minorticks_off()
    ax.set_xticks(range(len(scenarios)), scenarios)
    for x in range(1, len(scenarios)):
        ax.axvline(x - 0.5, color="0.9", lw=0.8)
    n, m = size.split("x")
    ax.set_title(f"n = {n}, m = {m}", fontsize=10)
    ax.set_ylabel(f"gap to {METHODS[BASELINE].title}, %")
    ax.grid(True, axis="y", color="0.92", lw=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right center", frameon=False, fontsize=9)
    save(figure, path)
