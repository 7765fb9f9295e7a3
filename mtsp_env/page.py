"""A page for the browser: the tours on a map with a slider over time, and the table beside it, in one HTML file.

The file loads nothing from anywhere. ``page.html`` is its template.
"""

from __future__ import annotations

import html
import json
import math
import os
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from mtsp_env.instance import Instance
from mtsp_env.picture import COLOURS, format_lengths
from mtsp_env.schedule import Drive, drives, end_time, make_log, moment
from mtsp_env.tours import Log
from mtsp_env.writing import atomic_write


def save_page(
    path: str | os.PathLike,
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    log: Sequence[Sequence[Sequence[float]]] | None = None,
    notes: Sequence[str] = (),
) -> None:
    """Write ``make_page(...)`` to a file. If this fails, an existing file stays as it was.

    Raises:
        OSError: the file cannot be written.
        ValueError: tours or a log that do not fit the instance.
    """
    page = make_page(instance, tours, log, notes)
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def make_page(
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    log: Sequence[Sequence[Sequence[float]]] | None = None,
    notes: Sequence[str] = (),
) -> str:
    """A team on its tours as an HTML page: a map, a slider over time, and a table of the tours.

    In a world that changes, cities are hidden until they appear, tours are drawn as far as they have been driven, an
    agent that has broken down is grey, and the table says who has, and who waits at the depot.

    Args:
        instance: the problem.
        tours: one per agent. All agents set off at time 0 and never wait. The instance must have neither ``appears``
            nor ``breaks``.
        log: instead of tours, one list of (node, departed, arrived, ready) per agent, in units of time.
        notes: sentences below the table.

    Raises:
        ValueError: not exactly one of ``tours`` and ``log``, or one that does not fit the instance.
    """
    data = _describe(instance, make_log(instance, tours, log), are_tours=log is None, notes=notes)
    template = files("mtsp_env").joinpath("page.html").read_text(encoding="utf-8")
    encoded = json.dumps(data, allow_nan=False).replace("<", "\\u003c")  # a name may hold "</script>"
    parts = {"{{title}}": html.escape(instance.name or "mTSP"), "{{data}}": encoded}
    return re.sub(r"{{title}}|{{data}}", lambda found: parts[found[0]], template)


def _describe(instance: Instance, log: Log, are_tours: bool, notes: Sequence[str]) -> dict[str, Any]:
    """What the script of the page reads. Times are in units of distance at speed 1; infinity becomes null."""
    lengths = moment(instance, log, math.inf).lengths * instance.scale
    end = end_time(log)
    in_shares = are_tours and instance.world == ()
    # Plain tours take as long as they are. The times of a log are those of the clock, which counts in whole ticks.
    last, *labels = format_lengths([end * instance.scale, *lengths.tolist()])
    parts = [drives(instance, agent, legs) for agent, legs in enumerate(log)]
    ends = [own[-1].until if own else 0.0 for own in parts]
    agents = []
    for agent, (own, label) in enumerate(zip(parts, labels, strict=True)):
        part = f"{ends[agent] / end:.0%}" if end else ""
        agents.append(
            {
                "colour": COLOURS[agent % len(COLOURS)],
                "dashed": agent >= len(COLOURS),
                "drives": [[drive.node, drive.departed, _finite(drive.until), drive.share] for drive in own],
                "cities": sum(drive.node != 0 and drive.share == 1.0 for drive in own),
                "length": label,
                "breaks": None if instance.breaks is None else _finite(float(instance.breaks[agent])),
                "last": part if in_shares else _home(own, instance.scale, end),
            }
        )
    ending = f"makespan {last}" if are_tours else f"the end at {last}"
    return {
        "heading": f"{instance.name or 'mTSP'}: {instance.n_nodes - 1} cities, {len(log)} agents, {ending}",
        "nodes": instance.nodes.tolist(),
        "appears": None if instance.appears is None else instance.appears.tolist(),
        "changes": instance.waiting_counts,
        "scale": instance.scale,
        "decimals": len(last.partition(".")[2]),
        "end": end,
        "agents": agents,
        "longest": int(np.argmax(ends)) if are_tours and end else -1,
        "lastColumn": "share" if in_shares else "home at",
        "notes": list(notes),
    }


def _finite(time: float) -> float | None:
    return time if math.isfinite(time) else None


def _home(own: Sequence[Drive], scale: float, end: float) -> str:
    """When an agent has come home for good; a dash if it has not."""
    if not own:
        return format_lengths([0.0, end * scale])[0]
    if own[-1].node != 0 or own[-1].share < 1.0:
        return "–"
    return format_lengths([own[-1].until * scale, end * scale])[0]
