"""Reads rows and checks them: reports and best known tours accept the same rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks.harness.rows import Row, read
from benchmarks.suite import AnyCell, TsplibCell, find_cell
from mtsp_env.instance import Instance
from mtsp_env.tours import check_tours, makespan

TIE = 1e-9  # makespans that differ by less, relative to the best known, are equal


def read_judged(files: Sequence[Path], tsplib: Path | None = None) -> Iterator[Row]:
    """The rows of files, each checked.

    Args:
        files: files of rows.
        tsplib: folder with TSPLIB files, to judge tours of table 3; without it these are not judged.

    Raises:
        OSError: a file cannot be read.
        ValueError: a damaged line; tours that do not solve their instance, or whose makespan is another; two networks
            under one name.
    """
    weights: dict[str, tuple[str, Path]] = {}
    judge = Judge(tsplib)
    for file in files:
        for number, row in enumerate(read(file), start=1):
            try:
                judge.check(row)
                _check_weights(row, file, weights)
            except ValueError as error:
                raise ValueError(f"{file}:{number}: {error}") from error
            yield row


class Judge:
    """Checks the tours of rows; draws the instances of a cell when they are first needed."""

    def __init__(self, tsplib: Path | None) -> None:
        self.tsplib = tsplib
        self.drawn: dict[str, list[Instance]] = {}

    def check(self, row: Row) -> None:
        cell = find_cell(row.table, row.cell)
        if not row.ok or (isinstance(cell, TsplibCell) and self.tsplib is None):
            return
        instance = self._instance(cell, row.seed, row.instance)
        check_tours(instance, row.tours)
        judged = makespan(instance, row.tours)
        if not math.isclose(judged, row.makespan, rel_tol=TIE):
            raise ValueError(f"its makespan is {row.makespan!r}, that of its tours {judged!r}")

    def _instance(self, cell: AnyCell, seed: int, number: int) -> Instance:
        key = cell.file(seed)
        if len(self.drawn.get(key, [])) <= number:
            if isinstance(cell, TsplibCell):
                cell = replace(cell, folder=self.tsplib)
            else:
                cell = replace(cell, count=max(cell.count, number + 1))
            self.drawn[key] = cell.instances(seed)
        if number >= len(self.drawn[key]):
            raise ValueError(f"{cell.label} has no instance {number}")
        return self.drawn[key][number]


def _check_weights(row: Row, file: Path, seen: dict[str, tuple[str, Path]]) -> None:
    if "weights" in row.versions:
        first, first_file = seen.setdefault(row.method, (row.versions["weights"], file))
        if first != row.versions["weights"]:
            raise ValueError(
                f"rows of {row.method} with weights {row.versions['weights']}, in {first_file} with {first}; "
                "report them apart"
            )
