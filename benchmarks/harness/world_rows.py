"""Rows of games in worlds that change: one JSON line for each game of one method."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta


@dataclass(frozen=True)
class Row:
    """One game of one method. ``parse_lines`` reads it, and checks it against these annotations.

    Attributes:
        scenario, size, instance: which instance, see ``benchmarks.studies.worlds.Cell``.
        method: a key of ``benchmarks.policies.in_worlds.METHODS``, or a file of weights.
        makespan: by ``mtsp_env.check_log``; of a game that was cut off, with the penalty.
        truncated: whether the game was cut off.
        decisions: number of decisions.
        seconds: CPU time of all decisions, with one thread; None: not measured.
        searches: a planner's number of searches, else None.
        iterations: a planner's iterations in each search, else None.
        machine: processor, cores, platform and Python version.
    """

    scenario: str
    size: str
    instance: Annotated[int, Meta(ge=0)]
    method: str
    makespan: Annotated[float, Meta(ge=0)]
    truncated: bool
    decisions: Annotated[int, Meta(ge=0)]
    seconds: Annotated[float, Meta(ge=0)] | None
    searches: Annotated[int, Meta(ge=0)] | None
    iterations: Annotated[int, Meta(ge=0)] | None
    machine: dict[str, Any]

    @property
    def key(self) -> tuple:
        """Identifies the game: a row with the same key is not played again."""
        return self.scenario, self.size, self.instance, self.method


def parse_lines(path: Path, data: bytes) -> Iterator[Row]:
    """Parse the content of a file of rows; a ValueError names ``path`` and the line."""
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            row = msgspec.json.decode(line, type=Row)
            if not math.isfinite(row.makespan):
                raise ValueError(f"makespan must be finite, got {row.makespan}")
        except (msgspec.DecodeError, ValueError) as error:
            raise ValueError(f"{path}:{number}: damaged line: {error}") from error
        yield row
