"""A table of tours on the terminal, for ``mtsp solve``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from mtsp_env.reading import printable
from mtsp_env.render import format_lengths

MOST_AT_HOME = 20  # agents without cities that have lines of their own


def print_table(record: dict[str, Any]) -> None:
    """Print the agents and their tours, the longest in bold, then the makespan beside its lower bound.

    If speeds differ or visits take time, a column has the time that each tour takes. Agents without cities are only
    counted if there are more than ``MOST_AT_HOME``.

    Args:
        record: the object that ``mtsp solve --json`` prints.
    """
    console = Console(highlight=False)
    is_timed = record["times"] != record["lengths"]
    lengths = format_lengths(record["lengths"])
    *times, bound = format_lengths([*record["times"], record["lower_bound"]])
    makespan, longest = record["makespan"], int(np.argmax(record["times"]))

    table = Table(box=box.SIMPLE, title_justify="left", title_style="bold")
    table.title = Text(
        f"{printable(record['name']) or 'mTSP'}: {record['n_nodes'] - 1} cities, {record['n_agents']} agents"
    )
    for heading in ("agent", "cities", "length", *(["time"] if is_timed else []), "share"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("tour (0: the depot)" if is_timed else "tour (0: the depot, the file's first node)", no_wrap=True)
    column = max(7, *map(len, lengths))
    width = console.width - 15 - (5 if is_timed else 4) * column
    at_home = [agent for agent, tour in enumerate(record["tours"]) if not any(tour)]
    hidden = set(at_home) if len(at_home) > MOST_AT_HOME else set()
    for agent, tour in enumerate(record["tours"]):
        if agent in hidden:
            continue
        share = f"{record['times'][agent] / makespan:.0%}" if makespan else ""
        cities = str(sum(node != 0 for node in tour))
        style = "bold" if agent == longest and makespan else None
        time = [times[agent]] if is_timed else []
        table.add_row(str(agent), cities, lengths[agent], *time, share, _elide(tour, width), style=style)
    console.print(table)
    if hidden:
        console.print(Text(f"{len(hidden)} agents stay at home\n"))

    console.print(Text(f"makespan {times[longest]}; {_compare(makespan, record['lower_bound'], bound)}"))
    console.print(Text(f"{record['method']} in {record['seconds']:.3g} s"))


def _compare(makespan: float, lower_bound: float, formatted_bound: str) -> str:
    gap = makespan / lower_bound - 1 if lower_bound else 0.0
    if gap <= 1e-9:
        return "the best possible"
    return f"at most {gap:.1%} above the best possible (lower bound {formatted_bound})"


def _elide(tour: Sequence[int], width: int) -> str:
    """A tour in at most ``width`` characters if possible: its beginning, dots, its end."""
    whole = " ".join(map(str, tour))
    if len(whole) <= width:
        return whole
    shown = min(len(tour) - 1, width // 2)
    while True:
        end = max(2, shown // 3)
        begin = max(2, shown - end)
        text = " ".join([*map(str, tour[:begin]), "...", *map(str, tour[-end:])])
        if len(text) <= width or shown <= 4:
            return text
        shown -= 1
