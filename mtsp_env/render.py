"""Pictures of tours. Drawing needs the extra ``render``: matplotlib, which is imported with the first picture."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtsp_env.instance import Instance
from mtsp_env.tours import path_lengths
from mtsp_env.writing import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (
    # First Okabe and Ito's colours, then those that differ most from them and from each other under normal vision,
    # deuteranopia and protanopia. Agents from 20 on repeat the colours with dashed lines.
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#0000ff", "#691e00", "#5a1e4b", "#2d1ea5"),
    *("#5a78ff", "#69d278", "#ffa5b4", "#d22d4b", "#2d2d78", "#691e2d", "#3c4bf0", "#874b69", "#a53c0f", "#4b96f0"),
)
UNVISITED = "#8c8c8c"
LEGEND_ROWS = 24  # with more agents, the legend lists only this many of the longest tours


def draw_tours(instance: Instance, tours: Sequence[Sequence[int]], ax: Axes | None = None) -> Axes:
    """Draw finished or partial tours.

    Each agent has a colour, the depot is a black square, and unvisited cities are hollow. A tour that is still open has
    no return leg, and a ring marks its agent's destination. The legend gives lengths in the instance's units; the
    longest tour is bold.

    Args:
        instance: the problem.
        tours: one per agent; a tour that does not end at the depot is still open.
        ax: where to draw; None: into a new figure that belongs to no window.

    Returns:
        The axes; ``.figure`` is their figure.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: there is not one tour per agent, a tour does not begin at the depot, or a node does not exist.
    """
    _check_drawable(instance, tours)
    if ax is None:
        ax = _new_figure(_fitting_size(instance)).subplots()
    _Picture(ax, instance).update(tours)
    return ax


def save_picture(
    path: str | os.PathLike, instance: Instance, tours: Sequence[Sequence[int]], title: str | None = None
) -> None:
    """Draw tours into a file; its suffix decides the format: .png, .svg, .pdf, ...

    If this fails, an existing file stays as it was. ``title`` replaces the default title.

    Raises:
        ImportError: matplotlib is not installed.
        OSError: the file cannot be written.
        ValueError: the suffix is unknown, or ``draw_tours`` refuses the tours.
    """
    suffix = check_suffix(path)
    figure = _new_figure(_fitting_size(instance))
    ax = draw_tours(instance, tours, figure.subplots())
    if title is not None:
        ax.set_title(title, parse_math=False)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, format=suffix, dpi=150, bbox_inches="tight")


def check_suffix(path: str | os.PathLike) -> str:
    """The picture format that a path's suffix names.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: matplotlib cannot write such a file.
    """
    try:
        from matplotlib.backend_bases import FigureCanvasBase
    except ImportError as error:
        raise _missing() from error
    known = sorted(set(FigureCanvasBase.get_supported_filetypes()) - {"pgf"})  # pgf would run TeX
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in known:
        raise ValueError(f"{os.fspath(path)}: unknown picture suffix {suffix!r}; choose from {known}")
    return suffix


def format_lengths(lengths: Sequence[float]) -> list[str]:
    """Lengths as text, all with as many decimals as the longest needs for four digits."""
    longest = max(lengths, default=0.0)
    decimals = min(max(3 - math.floor(math.log10(longest)), 0), 12) if longest > 0 else 0
    return [f"{length:,.{decimals}f}" for length in lengths]


class Viewer:
    """Draws one game after another into the same figure, shown in a window (``show``) or returned as an array.

    A window never blocks. If matplotlib's backend has no windows (MPLBACKEND=Agg, no display), nothing is shown.
    """

    def __init__(self, show: bool):
        self.show = show
        self._figure: Figure | None = None
        self._instance: Instance | None = None

    def draw(self, instance: Instance, tours: Sequence[Sequence[int]]) -> np.ndarray | None:
        """Draw ``tours``; returns the picture, uint8 (600, 800, 3), or None if it is shown in a window.

        Raises:
            ImportError: matplotlib is not installed.
            ValueError: ``draw_tours`` refuses the tours.
        """
        _check_drawable(instance, tours)
        if self._figure is None or (self.show and not _is_open(self._figure)):
            self._figure = _new_window() if self.show else _new_figure((8.0, 6.0))
            self._instance = None
        if self._instance is not instance:
            self._figure.clear()
            self._picture = _Picture(self._figure.add_axes((0.02, 0.02, 0.70, 0.90)), instance)
            self._instance = instance
        self._picture.update(tours)

        canvas = self._figure.canvas
        if self.show:
            canvas.draw_idle()
            canvas.flush_events()
            return None
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        assert isinstance(canvas, FigureCanvasAgg)  # see _new_figure
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[:, :, :3])  # a copy: the canvas reuses its buffer

    def close(self) -> None:
        """Close the window, if there is one; drawing again opens a new one."""
        if self._figure is not None and self.show:
            from matplotlib import pyplot

            pyplot.close(self._figure)
        self._figure = self._instance = None


class _Picture:
    """The artists of one instance's picture, made once; ``update`` moves them, which is faster than making new ones."""

    def __init__(self, ax: Axes, instance: Instance):
        self.ax, self.instance = ax, instance
        nodes, n, m = instance.nodes, instance.n_nodes, instance.n_agents
        self.thin, self.bold = (1.6, 3.4) if n < 300 else (1.0, 2.4)
        self.colours = _colours(m)  # (m, 4)

        styles = ["-" if agent < len(COLOURS) else "--" for agent in range(m)]
        self.lines = [ax.plot([], [], style, color=c)[0] for style, c in zip(styles, self.colours, strict=True)]
        size = float(np.clip(4000 / n, 10, 45))  # points^2
        self.cities = ax.scatter(nodes[1:, 0], nodes[1:, 1], s=size, linewidths=0.9, zorder=3)
        self.heads = ax.scatter([], [], s=4 * size + 40, facecolors="none", linewidths=2.0, zorder=4)
        ax.plot(*nodes[0], "s", color="black", markeredgecolor="white", markersize=11, zorder=5)

        rows = self.lines[:LEGEND_ROWS]
        self.legend = ax.legend(
            rows,
            [" "] * len(rows),
            title=f"the {len(rows)} longest of {m} tours" if m > len(rows) else None,
            title_fontsize=9,
            fontsize=9,
            loc="upper left",
            bbox_to_anchor=(1.0, 1.0),
            frameon=False,
        )
        margin = 0.03 * (np.ptp(nodes, axis=0).max() or 1.0)
        ax.set_xlim(nodes[:, 0].min() - margin, nodes[:, 0].max() + margin)
        ax.set_ylim(nodes[:, 1].min() - margin, nodes[:, 1].max() + margin)
        ax.set(aspect="equal", xticks=[], yticks=[])  # hidden ticks would still take time
        ax.axis("off")

    def update(self, tours: Sequence[Sequence[int]]) -> None:
        nodes = self.instance.nodes
        lengths = path_lengths(nodes, tours) * self.instance.scale  # (m,)
        longest = int(lengths.argmax()) if lengths.any() else None

        owner = np.full(len(nodes), -1)  # (n,) the agent that visits each node; -1: none
        for agent, (line, tour) in enumerate(zip(self.lines, tours, strict=True)):
            line.set_data(*nodes[list(tour)].T)
            line.set_linewidth(self.bold if agent == longest else self.thin)
            owner[list(tour)] = agent
        owner = owner[1:]
        visited = owner[:, None] >= 0
        self.cities.set(
            facecolor=np.where(visited, self.colours[owner], _rgba("white")),
            edgecolor=np.where(visited, _rgba("white"), _rgba(UNVISITED)),
        )

        open_tours = [agent for agent, tour in enumerate(tours) if tour[-1] != 0]
        heads = nodes[[tours[agent][-1] for agent in open_tours]]
        self.heads.set(offsets=heads, edgecolor=self.colours[open_tours])

        labels = format_lengths(lengths.tolist())
        self._update_legend(lengths, labels, longest)
        title = self._title(labels[longest or 0], int(visited.sum()), bool(open_tours))
        self.ax.set_title(title, parse_math=False)

    def _update_legend(self, lengths: np.ndarray, labels: list[str], longest: int | None) -> None:
        listed = np.sort(np.argsort(-lengths, kind="stable")[:LEGEND_ROWS])
        for agent, handle, text in zip(listed, self.legend.get_lines(), self.legend.get_texts(), strict=True):
            handle.set(color=self.colours[agent], linestyle=self.lines[agent].get_linestyle())
            handle.set_linewidth(self.bold if agent == longest else self.thin)
            text.set_text(f"agent {agent}:  {labels[agent]}{'  longest' if agent == longest else ''}")
            text.set_fontweight("bold" if agent == longest else "normal")

    def _title(self, longest: str, visited: int, any_open: bool) -> str:
        name, cities = self.instance.name or "mTSP", self.instance.n_nodes - 1
        if any_open or visited < cities:
            return f"{name}: {visited} of {cities} cities, longest tour so far {longest}"
        return f"{name}: {cities} cities, {self.instance.n_agents} agents, makespan {longest}"


def _check_drawable(instance: Instance, tours: Sequence[Sequence[int]]) -> None:
    if len(tours) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} tours, one per agent, got {len(tours)}")
    for agent, tour in enumerate(tours):
        if len(tour) == 0 or tour[0] != 0:
            raise ValueError(f"tour {agent} must begin at the depot 0, got {list(tour)[:5]}")
        outside = [node for node in tour if not 0 <= node < instance.n_nodes]
        if outside:
            raise ValueError(f"tour {agent} visits node {outside[0]}, outside 0..{instance.n_nodes - 1}")


def _fitting_size(instance: Instance) -> tuple[float, float]:
    """Size (width, height) in inches that leaves little empty space around wide or high instances."""
    width, height = np.ptp(instance.nodes, axis=0) + 0.06
    return float(np.clip(7 * width / height, 3, 7)), float(np.clip(7 * height / width, 3, 7))


def _colours(n_agents: int) -> np.ndarray:
    """The agents' colours, RGBA (m, 4)."""
    from matplotlib.colors import to_rgba_array

    return to_rgba_array([COLOURS[agent % len(COLOURS)] for agent in range(n_agents)])


def _rgba(colour: str) -> tuple[float, ...]:
    from matplotlib.colors import to_rgba

    return to_rgba(colour)


def _new_figure(size: tuple[float, float]) -> Figure:
    """A figure of a size in inches that belongs to no window and no pyplot state."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise _missing() from error
    figure = Figure(figsize=size, dpi=100)
    FigureCanvasAgg(figure)
    return figure


def _new_window() -> Figure:
    try:
        from matplotlib import pyplot
        from matplotlib.backend_bases import NonGuiException
    except ImportError as error:
        raise _missing() from error
    figure = pyplot.figure(figsize=(8.0, 6.0))
    window = figure.canvas.manager
    if window is not None:
        window.set_window_title("mTSP")
        with contextlib.suppress(NonGuiException):  # a backend without windows
            window.show()
    return figure


def _is_open(window: Figure) -> bool:
    from matplotlib import pyplot

    return pyplot.fignum_exists(window.number)


def _missing() -> ImportError:
    return ImportError('pictures need matplotlib: pip install "mtsp-env[render]"')
