"""Plots of results: gap against time, and planning time against the size of the instances."""

from __future__ import annotations

import math
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator

from benchmarks.reports.statistics import Results, mean
from benchmarks.solvers import SOLVERS
from benchmarks.suite import AnyCell, TsplibCell
from mtsp_env.writing import atomic_write

# A colour and a marker for each method: warm colours for DAN, magenta for the joint network, brown and pink for other
# papers' networks, black for the reference, cold ones for the others
STYLE = {
    "random": ("0.75", "x"),
    "nearest": ("0.5", "X"),
    "dan-greedy": ("#fdae61", "o"),
    "dan-greedy-x8": ("#fdae61", "d"),
    "dan-s64": ("#f46d43", "o"),
    "dan-s64-x8": ("#f46d43", "d"),
    "dan-s256": ("#d73027", "o"),
    "dan-paper-greedy": ("#c9a227", "o"),
    "dan-paper-s64": ("#c9a227", "p"),
    "joint-greedy": ("#e6007e", "H"),
    "joint-greedy-x8": ("#e6007e", "D"),
    "joint-s64": ("#99004d", "H"),
    "joint-s64-x8": ("#99004d", "D"),
    "joint-r16": ("#4d0026", "H"),
    "dan-improve": ("#8c1c13", "P"),
    "schedulenet-greedy": ("#8c6d31", "o"),
    "schedulenet-greedy-x8": ("#8c6d31", "d"),
    "schedulenet-s64": ("#5f4b1b", "o"),
    "hu-greedy": ("#ce6dbd", "o"),
    "hu-s64": ("#7b4173", "o"),
    "reference": ("black", "*"),
    "ortools": ("#4575b4", "s"),
    "ortools-gls": ("#74add1", "s"),
    "ortools-first": ("#313695", "s"),
    "lkh3": ("#1b7837", "D"),
    "exact": ("#762a83", "^"),
    "exact-gurobi": ("#9970ab", "^"),
    "exact-cplex": ("#c2a5cf", "^"),
    "ea": ("#01665e", "v"),
    "som": ("#35978f", "<"),
}
OTHER = [("#b15928", "h"), ("#e377c2", "p"), ("#bcbd22", "d"), ("#17becf", ">")]  # for solvers that are not in SOLVERS


def gaps(results: Results, path: Path) -> None:
    """Plot the mean gap to the best known tours against mean seconds: a panel per cell, a point per method and budget.

    A line joins the budgets of one method. Cells with a single instance share one panel.
    """
    cells = results.cells
    shared = all(len(results.instances(cell.label)) == 1 for cell in cells) and len(cells) > 1
    panels = [cells] if shared else [[cell] for cell in cells]
    columns = min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    width = 1.6 + 3.3 * columns if columns > 1 else 7.2
    figure = Figure(figsize=(width, 1.0 + 2.7 * rows if columns > 1 else 4.6), layout="constrained")
    axes = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for ax, panel in zip(axes.flat, panels, strict=False):
        title = f"{len(cells)} instances" if shared else _title(results, panel[0])
        _gap_panel(ax, results, [cell.label for cell in panel], title)
    for ax in axes.flat[len(panels) :]:
        ax.set_axis_off()
    figure.supxlabel("seconds per instance, one thread", fontsize=10)
    figure.supylabel("gap to the best known tours, %", fontsize=10)
    _legend(figure, axes.flat[: len(panels)])
    save(figure, path)


def _title(results: Results, cell: AnyCell) -> str:
    name = cell.file_name if isinstance(cell, TsplibCell) else f"n = {cell.n_nodes}"
    return f"{name}, m = {cell.n_agents} ({len(results.instances(cell.label))})"


def _gap_panel(ax: Axes, results: Results, cells: list[str], title: str) -> None:
    for method, labels in results.methods().items():
        points = []
        for label in labels:
            gap = mean([100 * value for cell in cells for value in results.gaps(label, cell).values()])
            if gap is not None:
                seconds = mean([row.seconds for cell in cells for row in results.solved(label, cell).values()])
                points.append((seconds.mean, max(gap.mean, 0.0), gap.error or 0.0))
        if points:
            colour, marker = _style(method, results)
            x, y, error = zip(*sorted(points), strict=True)
            size = {"*": 11, "P": 9, "X": 9}.get(marker, 6.5)
            ax.errorbar(x, y, error, color=colour, marker=marker, ms=size, mec="white", mew=0.5, lw=1, label=method)
    ax.set_xscale("log")
    ax.set_yscale("symlog", linthresh=1, linscale=0.6)
    ax.set_yticks([0, 0.5, 1, 2, 5, 10, 20, 50, 100, 200], minor=False)
    ax.yaxis.set_minor_locator(NullLocator())
    ax.set_ylim(bottom=-0.2)
    ax.set_title(title, fontsize=10)
    _tidy(ax)


def planning_time(results: Results, path: Path) -> None:
    """Plot mean seconds against n for the methods without a budget: the paper's Figure 4, on logarithmic axes.

    A cross marks a size at which a method was killed at its limit.
    """
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    ax = figure.subplots()
    for method, labels in results.methods().items():
        if labels != [method]:
            continue  # it takes a budget and uses all of it
        colour, marker = _style(method, results)
        finished, killed = [], []
        for cell in results.cells:
            rows = results.rows[method].get(cell.label, {}).values()
            seconds = mean([row.seconds for row in rows if row.ok])
            if seconds is not None:
                finished.append((cell.n_nodes, seconds.mean, seconds.error or 0.0))
            late = mean([row.seconds for row in rows if row.status == "timeout"])
            if late is not None and seconds is None:
                killed.append((cell.n_nodes, late.mean))
        if finished:
            x, y, error = zip(*finished, strict=True)
            ax.errorbar(x, y, error, color=colour, marker=marker, ms=5, lw=1.2, label=method)
        if killed:
            ax.plot(*zip(*killed, strict=True), color=colour, marker="x", ms=8, lw=0, label=f"{method}: killed")
    ax.set_xscale("log")
    ax.set_yscale("log")
    sizes = [cell.n_nodes for cell in results.cells]
    ax.set_xticks(sizes)
    ax.xaxis.set_minor_locator(NullLocator())
    ax.set(xlabel="n, nodes (m = 5 agents)", ylabel="seconds per instance, one thread")
    _tidy(ax)
    _legend(figure, [ax])
    save(figure, path)


def _style(method: str, results: Results) -> tuple[str, str]:
    if method in STYLE:
        return STYLE[method]
    others = [name for name in results.methods() if name not in SOLVERS]
    return OTHER[others.index(method) % len(OTHER)]


def _tidy(ax: Axes) -> None:
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.grid(True, color="0.92", lw=0.8)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def _legend(figure: Figure, axes) -> None:
    """Draw one legend for all panels."""
    handles = {}
    for ax in axes:
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(handles.values(), handles.keys(), loc="outside right center", frameon=False, fontsize=9)


def save(figure: Figure, path: Path) -> None:
    """Write a figure atomically, in the format that the path's suffix names."""
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=path.suffix[1:], dpi=130)
