"""Jobs: which solver is run on which instance, for how long, and the row that comes of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks import solvers
from benchmarks.harness.rows import Row
from benchmarks.suite import AnyCell, TsplibCell, rounded_length
from mtsp_env.checks import check_seconds
from mtsp_env.instance import Instance


@dataclass(frozen=True)
class Job:
    """One solver, one instance, one budget.

    Attributes:
        table, cell, number, instance: the instance, its number in its cell, and the cell's table.
        method: name of the solver.
        budget: seconds; None if the solver takes no budget.
        seed: seed of the test set; the solver's own seed is this plus ``number``.
    """

    table: str
    cell: AnyCell
    number: int
    instance: Instance
    method: str
    budget: float | None
    seed: int

    @property
    def key(self) -> tuple:
        """The same as ``Row.key`` of the row that the job gives."""
        return self.table, self.cell.label, self.number, self.method, self.budget, self.seed

    def to_row(self, outcome: dict[str, Any], versions: dict[str, str], machine: dict[str, Any]) -> Row:
        """The row of results, from the fields that a worker reports (``worker.attempt``)."""
        fields = {"error": None, "makespan": None, "bound": None, "tours": None, "cpu_seconds": None} | outcome
        length = rounded = None
        if isinstance(self.cell, TsplibCell) and fields["tours"] is not None:
            length = fields["makespan"] * self.instance.scale
            rounded = rounded_length(self.instance, fields["tours"])
        return Row(
            table=self.table,
            cell=self.cell.label,
            instance=self.number,
            name=self.instance.name,
            method=self.method,
            budget=self.budget,
            seed=self.seed,
            length=length,
            rounded_length=rounded,
            versions=versions,
            machine=machine,
            **fields,
        )


@dataclass(frozen=True)
class Limits:
    """Time limits, in seconds.

    Attributes:
        limit: for solvers without a budget, and for the tours that a solver improves within its budget.
        grace: time beyond its budget or limit after which a solver is killed.
        warm_up: time to load a solver and solve a tiny instance, which is not measured.
    """

    limit: float = 600.0
    grace: float = 10.0
    warm_up: float = 300.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_seconds(name, value)

    def seconds(self, job: Job) -> float:
        """Seconds that a job may take, without grace."""
        if job.budget is None:
            return self.limit
        return job.budget + (self.limit if solvers.look_up(job.method).polishes else 0.0)


def make_jobs(
    cells: Sequence[AnyCell], table: str, methods: Sequence[str], seed: int, seconds: Sequence[float]
) -> list[Job]:
    """All jobs of a table. Those of one instance are neighbours, so that a slow hour of the machine affects all.

    A solver that takes a budget gets a job for each of ``seconds``, the others one job.
    """
    budgets = tuple(dict.fromkeys(map(float, seconds)))
    return [
        Job(table, cell, number, instance, method, budget, seed)
        for cell in cells
        for number, instance in enumerate(cell.instances(seed))
        for method in methods
        for budget in (budgets if solvers.look_up(method).anytime else (None,))
    ]
