"""What rows of results say: judged once more, set against the best known tours, compared pair by pair."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import sem, wilcoxon

from benchmarks import best
from benchmarks.rows import Row, read
from benchmarks.solvers import SOLVERS
from benchmarks.suite import TABLES, AnyCell, TsplibCell, cells, find_cell
from mtsp_env.instance import Instance
from mtsp_env.tours import check_tours, makespan

TIE = 1e-9  # makespans that differ by less, relative to the best known, are equal

Which = tuple[int, int]
"""An instance of a cell: (seed, number)."""


class Mean(NamedTuple):
    """A mean and its standard error; None where there is one value."""

    mean: float
    error: float | None
    count: int


class Paired(NamedTuple):
    """One method against another on the same instances.

    Attributes:
        wins, ties, losses: instances where its makespan is smaller, the same, larger.
        p: two-sided, of the Wilcoxon signed-rank test on differences of gaps, ties left out; 1 where all are ties.
        difference: of the mean gaps; below 0 where it is better.
    """

    wins: int
    ties: int
    losses: int
    p: float
    difference: float


@dataclass(frozen=True)
class Results:
    """Rows of one table.

    Attributes:
        table: a key of ``suite.TABLES``.
        cells: those with rows, in the table's order.
        labels: a method each, with its budget where it takes one, in the order of SOLVERS.
        rows: label -> cell -> instance -> row.
        best: cell -> instance -> makespan of the best known tours, of these rows or of the kept ones.
        unkept: how many of these instances have no kept tours to count, or no TSPLIB file to judge them by.
    """

    table: str
    cells: list[AnyCell]
    labels: list[str]
    rows: dict[str, dict[str, dict[Which, Row]]]
    best: dict[str, dict[Which, float]]
    unkept: int

    def every(self) -> list[Row]:
        """All rows."""
        return [row for cells in self.rows.values() for rows in cells.values() for row in rows.values()]

    def methods(self) -> dict[str, list[str]]:
        """Each method's labels, in order."""
        found: dict[str, list[str]] = {}
        for label in self.labels:
            found.setdefault(
                next(row.method for rows in self.rows[label].values() for row in rows.values()), []
            ).append(label)
        return found

    def right(self, label: str, cell: str) -> dict[Which, Row]:
        """The rows of a method in a cell that have right tours."""
        return {which: row for which, row in self.rows[label].get(cell, {}).items() if row.ok}

    def gaps(self, label: str, cell: str) -> dict[Which, float]:
        """By how much makespans exceed the best known: 0.1 is 10 %."""
        return {which: row.makespan / self.best[cell][which] - 1 for which, row in self.right(label, cell).items()}

    def instances(self, cell: str) -> set[Which]:
        """Every instance of the cell that any method was run on."""
        return {which for label in self.labels for which in self.rows[label].get(cell, {})}

    def paired(self, label: str, other: str, cells: Sequence[str]) -> Paired | None:
        """A method against another, on the instances of these cells that both solved; None where there are none."""
        found = []
        for cell in cells:
            ours, theirs = self.gaps(label, cell), self.gaps(other, cell)
            found += [ours[which] - theirs[which] for which in sorted(ours.keys() & theirs.keys())]
        return compare(np.array(found)) if found else None


def compare(differences: np.ndarray) -> Paired:
    """Wins, ties, losses and the test, from differences (k,) of gaps; below 0 is a win."""
    untied = differences[np.abs(differences) > TIE]
    p = float(wilcoxon(untied).pvalue) if len(untied) else 1.0
    wins, losses = int((untied < 0).sum()), int((untied > 0).sum())
    return Paired(wins, len(differences) - len(untied), losses, p, float(differences.mean()))


def mean(values: Sequence[float]) -> Mean | None:
    """The mean and its standard error; None of nothing."""
    values = np.asarray(list(values), dtype=np.float64)
    if not len(values):
        return None
    return Mean(float(values.mean()), float(sem(values)) if len(values) > 1 else None, len(values))


def load(files: Sequence[Path], tsplib: Path | None = None, folder: Path = best.FOLDER) -> list[Results]:
    """The tables that the files hold. Of two rows for the same thing the later one counts.

    Raises:
        OSError: no such file.
        ValueError: a damaged line; a makespan that its tours do not have; two networks under one name.
    """
    latest: dict[tuple, Row] = {}
    weights: dict[str, tuple[str, Path]] = {}
    judge = _Judge(tsplib)
    for file in files:
        for number, row in enumerate(read(file), start=1):
            try:
                judge.check(row)
                _check_weights(row, file, weights)
            except ValueError as error:
                raise ValueError(f"{file}:{number}: {error}") from error
            latest[row.key] = row
    return [
        _results(table, [row for row in latest.values() if row.table == table], tsplib, folder)
        for table in TABLES
        if any(row.table == table for row in latest.values())
    ]


class _Judge:
    """Instances, drawn when they are first needed, and what the judge says of a row's tours."""

    def __init__(self, tsplib: Path | None) -> None:
        self.tsplib = tsplib
        self.drawn: dict[tuple, list[Instance]] = {}

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
        key = (cell.label, seed)
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
        first, where = seen.setdefault(row.method, (row.versions["weights"], file))
        if first != row.versions["weights"]:
            raise ValueError(
                f"rows of {row.method} with weights {row.versions['weights']}, in {where} with {first}; "
                "report them apart"
            )


def _results(table: str, rows: Sequence[Row], tsplib: Path | None, folder: Path) -> Results:
    found: dict[str, dict[str, dict[Which, Row]]] = defaultdict(lambda: defaultdict(dict))
    known: dict[str, dict[Which, float]] = defaultdict(dict)
    for row in rows:
        which = (row.seed, row.instance)
        found[row.label][row.cell][which] = row
        if row.ok:
            known[row.cell][which] = min(row.makespan, known[row.cell].get(which, math.inf))
    present = [cell for cell in cells(table) if any(row.cell == cell.label for row in rows)]
    unkept = sum(map(len, known.values()))
    for cell in present:
        if isinstance(cell, TsplibCell):
            if tsplib is None:
                continue
            cell = replace(cell, folder=tsplib)
        for seed in {row.seed for row in rows if row.cell == cell.label}:
            unkept -= _use_kept(known[cell.label], cell, seed, folder)
    order = {name: place for place, name in enumerate(SOLVERS)}
    one_each = {row.label: row for row in rows}
    labels = sorted(one_each, key=lambda x: (order.get(one_each[x].method, len(order)), one_each[x].budget or 0.0, x))
    return Results(table, present, labels, {label: dict(found[label]) for label in labels}, dict(known), unkept)


def _use_kept(known: dict[Which, float], cell: AnyCell, seed: int, folder: Path) -> int:
    """Lower the best makespans ``known`` of a cell to those of its kept tours; returns how many it has."""
    numbers = [number for its_seed, number in known if its_seed == seed]
    if numbers and not isinstance(cell, TsplibCell):
        cell = replace(cell, count=max(numbers) + 1)
    instances = cell.instances(seed)
    kept = {(seed, number): tours for number, tours in best.read(cell, seed, folder).items() if number in numbers}
    for which, tours in kept.items():
        known[which] = min(known[which], makespan(instances[which[1]].nodes, tours))
    return len(kept)
