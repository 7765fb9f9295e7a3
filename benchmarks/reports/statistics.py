"""Statistics of results: checked by the judge, compared with the best known tours and with each other."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import sem, wilcoxon

from benchmarks import best_known
from benchmarks.harness.judge import TIE, read_judged
from benchmarks.harness.rows import Row
from benchmarks.solvers import SOLVERS
from benchmarks.suite import (
    PUBLIC_SEED,
    PUBLIC_SIZE,
    TABLES,
    AnyCell,
    PublicCell,
    TsplibCell,
    cells,
    rounded_bound,
)
from mtsp_env.instance import Instance
from mtsp_env.tours import farthest_trip, makespan

InstanceKey = tuple[int, int]
"""An instance of a cell: (seed, number)."""


class Mean(NamedTuple):
    """A mean and its standard error, which is None for a single value."""

    mean: float
    error: float | None
    count: int


class Comparison(NamedTuple):
    """One method compared with another on the same instances.

    Attributes:
        wins, ties, losses: number of instances on which its makespan is smaller, equal and larger.
        p: two-sided p-value of the Wilcoxon signed-rank test on differences of gaps without ties; 1 if all are ties.
        difference: difference of the mean gaps; negative if the method is better.
    """

    wins: int
    ties: int
    losses: int
    p: float
    difference: float


class Bound(NamedTuple):
    """The trip from the depot to the farthest city and back, a lower bound on the makespan. Fields as in ``Row``.

    If legs are rounded, the trip takes the shortest path (``suite.rounded_bound``).
    """

    makespan: float
    length: float
    rounded_length: int


@dataclass(frozen=True)
class Results:
    """The results of one table.

    Attributes:
        table: key of ``suite.TABLES``.
        cells: cells with results, in the table's order.
        labels: methods, each with its budget if it takes one, in the order of SOLVERS.
        rows: label -> cell -> instance -> row.
        best: cell -> instance -> makespan of the best known tours, those of these rows included.
        bounds: cell -> instance -> lower bound; cells whose TSPLIB file was not given are left out.
        public_best: cell of the public test set -> mean makespan of the best known tours of all its 100 instances;
            cells in which some instance has none are left out.
        unkept: number of instances without kept tours, or without the TSPLIB file to judge them by.
    """

    table: str
    cells: list[AnyCell]
    labels: list[str]
    rows: dict[str, dict[str, dict[InstanceKey, Row]]]
    best: dict[str, dict[InstanceKey, float]]
    bounds: dict[str, dict[InstanceKey, Bound]]
    public_best: dict[str, float]
    unkept: int

    def all_rows(self) -> list[Row]:
        """All rows of all methods."""
        return [row for cells in self.rows.values() for rows in cells.values() for row in rows.values()]

    def methods(self) -> dict[str, list[str]]:
        """Each method's labels, in order."""
        labels: dict[str, list[str]] = {}
        for label in self.labels:
            method = next(row.method for rows in self.rows[label].values() for row in rows.values())
            labels.setdefault(method, []).append(label)
        return labels

    def solved(self, label: str, cell: str) -> dict[InstanceKey, Row]:
        """A method's rows with valid tours in a cell."""
        return {key: row for key, row in self.rows[label].get(cell, {}).items() if row.ok}

    def gaps(self, label: str, cell: str) -> dict[InstanceKey, float]:
        """Gaps to the best known makespans; 0.1 is 10 %."""
        return {key: row.makespan / self.best[cell][key] - 1 for key, row in self.solved(label, cell).items()}

    def instances(self, cell: str) -> set[InstanceKey]:
        """The instances of the cell on which any method was run."""
        return {key for label in self.labels for key in self.rows[label].get(cell, {})}

    def compare(self, label: str, other: str, cells: Sequence[str]) -> Comparison | None:
        """Compare two methods on the instances of these cells that both solved; None if there are none."""
        differences = []
        for cell in cells:
            ours, theirs = self.gaps(label, cell), self.gaps(other, cell)
            differences += [ours[key] - theirs[key] for key in sorted(ours.keys() & theirs.keys())]
        return compare(np.array(differences)) if differences else None


def compare(differences: np.ndarray) -> Comparison:
    """Wins, ties, losses and the test, from differences (k,) of gaps; a negative one is a win."""
    untied = differences[np.abs(differences) > TIE]
    p = float(wilcoxon(untied).pvalue) if len(untied) else 1.0
    wins, losses = int((untied < 0).sum()), int((untied > 0).sum())
    return Comparison(wins, len(differences) - len(untied), losses, p, float(differences.mean()))


def mean(values: Sequence[float]) -> Mean | None:
    """The mean and its standard error; None without values."""
    values = np.asarray(list(values), dtype=np.float64)
    if not len(values):
        return None
    return Mean(float(values.mean()), float(sem(values)) if len(values) > 1 else None, len(values))


def load(files: Sequence[Path], tsplib: Path | None = None, folder: Path = best_known.FOLDER) -> list[Results]:
    """Load the results of files, one for each table. Of two rows with the same key the later one counts.

    Args:
        files: files of rows.
        tsplib: folder with TSPLIB files, to judge tours of table 3.
        folder: folder of the best known tours.

    Raises:
        OSError: a file cannot be read.
        ValueError: as ``judge.read_judged``.
    """
    return collect(read_judged(files, tsplib), tsplib, folder)


def collect(judged: Iterable[Row], tsplib: Path | None = None, folder: Path = best_known.FOLDER) -> list[Results]:
    """The results of judged rows, one for each table. Arguments as for ``load``."""
    latest = {row.key: row for row in judged}
    by_table = {table: [row for row in latest.values() if row.table == table] for table in TABLES}
    return [_results(table, rows, tsplib, folder) for table, rows in by_table.items() if rows]


def _results(table: str, table_rows: Sequence[Row], tsplib: Path | None, folder: Path) -> Results:
    rows: dict[str, dict[str, dict[InstanceKey, Row]]] = defaultdict(lambda: defaultdict(dict))
    best: dict[str, dict[InstanceKey, float]] = defaultdict(dict)
    for row in table_rows:
        key = (row.seed, row.instance)
        rows[row.label][row.cell][key] = row
        if row.ok:
            best[row.cell][key] = min(row.makespan, best[row.cell].get(key, math.inf))
    present = [cell for cell in cells(table) if any(row.cell == cell.label for row in table_rows)]
    unkept = sum(map(len, best.values()))
    bounds: dict[str, dict[InstanceKey, Bound]] = defaultdict(dict)
    public_best = {}
    for cell in present:
        if isinstance(cell, TsplibCell):
            if tsplib is None:
                continue
            cell = replace(cell, folder=tsplib)
        for seed in {row.seed for row in table_rows if row.cell == cell.label}:
            numbers = {row.instance for row in table_rows if (row.cell, row.seed) == (cell.label, seed)}
            if not isinstance(cell, TsplibCell):
                cell = replace(cell, count=max(numbers) + 1)
            instances = cell.instances(seed)
            bounds[cell.label] |= {(seed, number): bound(instances[number]) for number in numbers}
            unkept -= _include_kept(best[cell.label], cell, instances, seed, folder)
        if isinstance(cell, PublicCell):
            public_best |= _public_best(replace(cell, count=PUBLIC_SIZE), folder)
    order = {name: place for place, name in enumerate(SOLVERS)}
    example = {row.label: row for row in table_rows}
    labels = sorted(example, key=lambda x: (order.get(example[x].method, len(order)), example[x].budget or 0.0, x))
    by_label = {label: dict(rows[label]) for label in labels}
    return Results(table, present, labels, by_label, dict(best), dict(bounds), public_best, unkept)


def bound(instance: Instance) -> Bound:
    """The lower bound of an instance."""
    trip = farthest_trip(instance.nodes)
    return Bound(trip, trip * instance.scale, rounded_bound(instance))


def _include_kept(
    best: dict[InstanceKey, float], cell: AnyCell, instances: Sequence[Instance], seed: int, folder: Path
) -> int:
    """Lower a cell's ``best`` makespans to those of its kept tours; returns the number of instances that have any."""
    kept = {i: tours for i, tours in best_known.read(cell, seed, folder).items() if (seed, i) in best}
    for i, tours in kept.items():
        best[seed, i] = min(best[seed, i], makespan(instances[i], tours))
    return len(kept)


def _public_best(cell: PublicCell, folder: Path) -> dict[str, float]:
    """The mean makespan of a cell's kept tours under its label; nothing unless every instance has any."""
    kept = best_known.read(cell, PUBLIC_SEED, folder)
    if len(kept) < cell.count:
        return {}
    instances = cell.instances(PUBLIC_SEED)
    return {cell.label: float(np.mean([makespan(instances[i], tours) for i, tours in kept.items()]))}
