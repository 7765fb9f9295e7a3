"""The picture of one instance: the artists that ``render`` and ``animation`` move about, and its colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from mtsp_env.instance import Instance
from mtsp_env.schedule import Moment
from mtsp_env.tours import path_lengths

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
BROKEN = "#777777"  # an agent that has broken down
LEGEND_ROWS = 24  # with more agents, the legend lists only this many of the longest tours


def format_lengths(lengths: Sequence[float]) -> list[str]:
    """Lengths as text, all with as many decimals as the longest needs for four digits."""
    longest = max(lengths, default=0.0)
    decimals = min(max(3 - math.floor(math.log10(longest)), 0), 12) if longest > 0 else 0
    return [f"{length:,.{decimals}f}" for length in lengths]


class Picture:
    """The artists of one instance's picture, made once and then moved, which is faster than making new ones.

    Args:
        ax: where to draw.
        instance: the problem.
        longest: the longest length that will be shown, in the instance's units. All lengths get the decimals that it
            needs, so that the numbers of an animation keep their form. 0: each picture decides by its own lengths.
    """

    def __init__(self, ax: Axes, instance: Instance, longest: float = 0.0):
        self.ax, self.instance = ax, instance
        nodes, n, m = instance.nodes, instance.n_nodes, instance.n_agents
        self.thin, self.bold = (1.6, 3.4) if n < 300 else (1.0, 2.4)
        self.longest = longest
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

    def update(
        self,
        tours: Sequence[Sequence[int]],
        known: np.ndarray | None = None,
        broken: np.ndarray | None = None,
        waits: np.ndarray | None = None,
    ) -> None:
        """Show tours, finished or partial. A ring marks the destination of an agent whose tour is still open.

        Args:
            tours: one per agent.
            known: (n,) bool; the other cities are hidden. None: all are known.
            broken: (m,) bool, the agents that have broken down: a grey disc marks where, if it is not the depot.
            waits: (m,) bool, the agents that wait at the depot.
        """
        nodes, lengths = self.instance.nodes, path_lengths(self.instance.nodes, tours)
        owner = np.full(len(nodes), -1)  # (n,) the agent that visits each node; -1: none
        for agent, tour in enumerate(tours):
            owner[list(tour)] = agent
        open_tours = [agent for agent, tour in enumerate(tours) if tour[-1] != 0]
        longest = int(lengths.argmax()) if lengths.any() else None
        broken = np.zeros(len(tours), bool) if broken is None else broken
        notes = _notes(broken, np.zeros(len(tours), bool) if waits is None else waits)
        self._show([nodes[list(tour)] for tour in tours], lengths, owner, longest, known, notes)
        rings, grey = self.colours[open_tours], broken[open_tours][:, None]
        edges, faces = np.where(grey, _rgba("white"), rings), np.where(grey, _rgba(BROKEN), _rgba("none"))
        self.heads.set(offsets=nodes[[tours[a][-1] for a in open_tours]], facecolor=faces, edgecolor=edges)

        visited = int((owner[1:] >= 0).sum())
        if not broken[open_tours].all() or visited < len(nodes) - 1:
            label = self._labels(lengths)[int(lengths.argmax())]
            cities = f"{len(nodes) - 1} cities" if known is None else f"{int(known[1:].sum())} known cities"
            self._set_title(f"{visited} of {cities}, longest tour so far {label}")
        else:
            self._set_title(self._summary(lengths))

    def update_moment(self, moment: Moment, time: float, end: float) -> None:
        """Show where a team is at ``time`` of a log that ends at ``end``.

        A disc marks where each agent is; it is grey if the agent has broken down. The legend says who has, and who
        waits at the depot. Cities are hidden until they appear.
        """
        over = time >= end  # until then, all agents of one speed have driven equally far
        longest = int(moment.lengths.argmax()) if over and moment.lengths.any() else None
        appears, breaks = self.instance.appears, self.instance.breaks
        known = np.ones(len(moment.owner), bool) if appears is None else appears <= time
        positions = np.array([path[-1] for path in moment.paths])
        broken = np.zeros(len(positions), bool) if breaks is None else breaks <= time
        notes = _notes(broken, moment.waits & (not over))
        self._show(moment.paths, moment.lengths, moment.owner, longest, known, notes)
        colours = np.where(broken[:, None], _rgba(BROKEN), self.colours)
        self.heads.set(offsets=positions, facecolor=colours, edgecolor="white")
        if over and math.isclose(moment.lengths.max(), end):  # nobody has waited: the time is the makespan
            self._set_title(self._summary(moment.lengths))
            return
        now = format_lengths([time * self.instance.scale, end * self.instance.scale])[0]
        reached = int((moment.owner[1:] >= 0).sum())
        cities = f"{len(moment.owner) - 1} cities" if appears is None else f"{int(known[1:].sum())} known cities"
        self._set_title(f"time {now}, {reached} of {cities}")

    def _show(
        self,
        paths: Sequence[np.ndarray],
        lengths: np.ndarray,
        owner: np.ndarray,
        longest: int | None,
        known: np.ndarray | None,
        notes: Sequence[str],
    ) -> None:
        """Move the lines to ``paths``, (k, 2) each; colour the cities by ``owner`` (n,); list ``lengths`` (m,).

        The line and the length of agent ``longest`` are bold. Cities that are not ``known`` (n,) are hidden. ``notes``
        (m,) follow the lengths.
        """
        for agent, (line, path) in enumerate(zip(self.lines, paths, strict=True)):
            line.set_data(*path.T)
            line.set_linewidth(self.bold if agent == longest else self.thin)
        visited = owner[1:, None] >= 0
        self.cities.set(
            facecolor=np.where(visited, self.colours[owner[1:]], _rgba("white")),
            edgecolor=np.where(visited, _rgba("white"), _rgba(UNVISITED)),
            alpha=None if known is None else known[1:].astype(float),
        )
        self._update_legend(lengths, self._labels(lengths), longest, notes)

    def _labels(self, lengths: np.ndarray) -> list[str]:
        return format_lengths([*(lengths * self.instance.scale).tolist(), self.longest])[: len(lengths)]

    def _summary(self, lengths: np.ndarray) -> str:
        longest = self._labels(lengths)[int(lengths.argmax())]
        what = "longest tour" if self.instance.world else "makespan"  # lengths are no times there
        return f"{self.instance.n_nodes - 1} cities, {self.instance.n_agents} agents, {what} {longest}"

    def _set_title(self, text: str) -> None:
        self.ax.set_title(f"{self.instance.name or 'mTSP'}: {text}", parse_math=False)

    def _update_legend(self, lengths: np.ndarray, labels: list[str], longest: int | None, notes: Sequence[str]) -> None:
        listed = np.sort(np.argsort(-lengths, kind="stable")[:LEGEND_ROWS])
        for agent, handle, text in zip(listed, self.legend.get_lines(), self.legend.get_texts(), strict=True):
            handle.set(color=self.colours[agent], linestyle=self.lines[agent].get_linestyle())
            handle.set_linewidth(self.bold if agent == longest else self.thin)
            note = notes[agent] or ("longest" if agent == longest else "")
            text.set_text(f"agent {agent}:  {labels[agent]}  {note}".rstrip())
            text.set_fontweight("bold" if agent == longest else "normal")


def _colours(n_agents: int) -> np.ndarray:
    """The agents' colours, RGBA (m, 4)."""
    from matplotlib.colors import to_rgba_array

    return to_rgba_array([COLOURS[agent % len(COLOURS)] for agent in range(n_agents)])


def _notes(broken: np.ndarray, waits: np.ndarray) -> list[str]:
    return ["broken" if fails else "waits" if idle else "" for fails, idle in zip(broken, waits, strict=True)]


def _rgba(colour: str) -> tuple[float, ...]:
    from matplotlib.colors import to_rgba

    return to_rgba(colour)


def new_figure(size: tuple[float, float], dpi: int = 100) -> Figure:
    """A figure of a size in inches that belongs to no window and no pyplot state."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise missing_matplotlib() from error
    figure = Figure(figsize=size, dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def missing_matplotlib() -> ImportError:
    """The error that says what to install."""
    return ImportError('pictures need matplotlib: pip install "mtsp-env[render]"')
