"""Pictures of tours, as files, arrays and windows; animations and pages for the browser are here by name as well.

Drawing needs the extra ``render``: matplotlib, which is imported with the first picture. Pages need nothing.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtsp_env.animation import animate, check_animation_suffix
from mtsp_env.instance import Instance
from mtsp_env.page import make_page, save_page
from mtsp_env.picture import COLOURS, Picture, format_lengths, missing_matplotlib, new_figure
from mtsp_env.schedule import check_paths
from mtsp_env.writing import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = [
    "COLOURS",
    "Viewer",
    "animate",
    "check_animation_suffix",
    "check_suffix",
    "draw_tours",
    "format_lengths",
    "make_page",
    "save_page",
    "save_picture",
]


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
    check_paths(instance, tours)
    if ax is None:
        ax = new_figure(_fitting_size(instance)).subplots()
    Picture(ax, instance).update(tours)
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
    figure = new_figure(_fitting_size(instance))
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
        raise missing_matplotlib() from error
    known = sorted(set(FigureCanvasBase.get_supported_filetypes()) - {"pgf"})  # pgf would run TeX
    suffix = Path(path).suffix.lower().removeprefix(".")
    if suffix not in known:
        raise ValueError(f"{os.fspath(path)}: unknown picture suffix {suffix!r}; choose from {known}")
    return suffix


class Viewer:
    """Draws one game after another into the same figure, shown in a window (``show``) or returned as an array.

    A window never blocks. If matplotlib's backend has no windows (MPLBACKEND=Agg, no display), nothing is shown.
    """

    def __init__(self, show: bool):
        self.show = show
        self._figure: Figure | None = None
        self._instance: Instance | None = None

    def draw(
        self,
        instance: Instance,
        tours: Sequence[Sequence[int]],
        known: np.ndarray | None = None,
        broken: np.ndarray | None = None,
        waits: np.ndarray | None = None,
    ) -> np.ndarray | None:
        """Draw ``tours``; returns the picture, uint8 (600, 800, 3), or None if it is shown in a window.

        ``known`` (n,), ``broken`` (m,) and ``waits`` (m,), bool, say what a world has come to: see ``Picture.update``.

        Raises:
            ImportError: matplotlib is not installed.
            ValueError: ``draw_tours`` refuses the tours.
        """
        check_paths(instance, tours)
        if self._figure is None or (self.show and not _is_open(self._figure)):
            self._figure = _new_window() if self.show else new_figure((8.0, 6.0))
            self._instance = None
        if self._instance is not instance:
            self._figure.clear()
            self._picture = Picture(self._figure.add_axes((0.02, 0.02, 0.70, 0.90)), instance)
            self._instance = instance
        self._picture.update(tours, known, broken, waits)

        canvas = self._figure.canvas
        if self.show:
            canvas.draw_idle()
            canvas.flush_events()
            return None
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        assert isinstance(canvas, FigureCanvasAgg)  # see new_figure
        canvas.draw()
        return np.array(np.asarray(canvas.buffer_rgba())[:, :, :3])  # a copy: the canvas reuses its buffer

    def close(self) -> None:
        """Close the window, if there is one; drawing again opens a new one."""
        if self._figure is not None and self.show:
            from matplotlib import pyplot

            pyplot.close(self._figure)
        self._figure = self._instance = None


def _fitting_size(instance: Instance) -> tuple[float, float]:
    """Size (width, height) in inches that leaves little empty space around wide or high instances."""
    width, height = np.ptp(instance.nodes, axis=0) + 0.06
    return float(np.clip(7 * width / height, 3, 7)), float(np.clip(7 * height / width, 3, 7))


def _new_window() -> Figure:
    try:
        from matplotlib import pyplot
        from matplotlib.backend_bases import NonGuiException
    except ImportError as error:
        raise missing_matplotlib() from error
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
