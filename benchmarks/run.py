"""``python -m benchmarks run``: every method on every instance of a table, a row each, whatever a solver does.

Solvers run in processes of their own (``crew.py``, ``worker.py``). POSIX only.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks import solvers
from benchmarks.crew import Limits, check_seconds, outcomes, usable_cores
from benchmarks.rows import Journal, Row
from benchmarks.suite import AnyCell, TsplibCell, cells, rounded_length
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance


@dataclass(frozen=True)
class Job:
    """One row to be: a method and an instance."""

    table: str
    cell: AnyCell
    number: int
    instance: Instance
    method: str
    budget: float | None
    seed: int

    @property
    def key(self) -> tuple:
        """As of the row that will be."""
        return self.table, self.cell.label, self.number, self.method, self.budget, self.seed

    def row(self, outcome: dict[str, Any], versions: dict[str, str], machine: dict[str, Any]) -> Row:
        """The row, from what a worker says."""
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


def run(
    table: str,
    methods: Sequence[str],
    out: Path,
    instances: int | None = None,
    seed: int = 7,
    seconds: Sequence[float] = (1.0,),
    limits: Limits | None = None,
    workers: int = 1,
    tsplib: Path | None = None,
    only: Sequence[str] = (),
    retry_failed: bool = False,
) -> list[Row]:
    """Run what ``out`` has no row of yet, and append a row for each; returns the new ones.

    Args:
        table: a key of ``suite.TABLES``.
        methods: names of solvers and groups.
        out: a file of JSON lines, made where there is none.
        instances: of each cell; None: as many as the table says.
        seed: of the test set; a solver gets this plus the number of the instance.
        seconds: budgets of the solvers that take one; each is a row.
        limits: of time.
        workers: processes, each on a core of its own.
        tsplib: a folder with the files of table 3.
        only: labels of the cells to run; none: all.
        retry_failed: run failed rows again; the newer row counts.

    Raises:
        OSError: ``out`` or a TSPLIB file cannot be read or written.
        ValueError: an unknown name, a number outside its range, or an ``out`` that does not fit.
    """
    limits, methods = limits or Limits(), solvers.expand(methods)
    cores = usable_cores()
    check_count("workers", workers, minimum=1)
    if workers > len(cores):
        raise ValueError(f"workers must be at most {len(cores)}, a core each, got {workers}")
    for budget in seconds:
        check_seconds("seconds", budget)
    for method in methods:
        if method not in solvers.SOLVERS:
            solvers.find(method)  # a mistyped name of one's own should not fill the file with errors
    versions = {method: solvers.look_up(method).versions() for method in methods}
    jobs = plan(_chosen(cells(table, tsplib, instances), only), table, methods, seed, seconds)
    new: list[Row] = []
    with Journal(out) as journal:
        _check_weights(out, journal.rows, versions)
        done = {row.key for row in journal.rows if row.ok or not retry_failed}
        jobs = [job for job in jobs if job.key not in done]
        machine = describe_machine()
        with _progress() as progress:
            task = progress.add_task(f"table {table}", total=len(jobs), failed=0)
            with closing(outcomes(jobs, limits, cores[:workers])) as ended:
                for job, outcome in ended:
                    new.append(job.row(outcome, versions[job.method], machine))
                    journal.append(new[-1])
                    progress.update(task, advance=1, failed=sum(not row.ok for row in new))
    return new


def plan(
    cells: Sequence[AnyCell], table: str, methods: Sequence[str], seed: int, seconds: Sequence[float]
) -> list[Job]:
    """All jobs, an instance's methods one after the other, so that a slow hour of the machine meets them all."""
    return [
        Job(table, cell, number, instance, method, budget, seed)
        for cell in cells
        for number, instance in enumerate(cell.instances(seed))
        for method in methods
        for budget in (dict.fromkeys(map(float, seconds)) if solvers.look_up(method).anytime else (None,))
    ]


def describe_machine() -> dict[str, Any]:
    """Processor, cores that this process may use, platform and Python."""
    name = platform.processor() or platform.machine()
    with suppress(OSError), open("/proc/cpuinfo") as file:
        name = next((line.split(":", 1)[1].strip() for line in file if line.startswith("model name")), name)
    return {
        "processor": name,
        "cores": len(usable_cores()),
        "platform": platform.platform(),
        "python": platform.python_version(),
    }


def _chosen(all_cells: Sequence[AnyCell], only: Sequence[str]) -> list[AnyCell]:
    labels = [cell.label for cell in all_cells]
    for label in only:
        if label not in labels:
            raise ValueError(f"unknown cell {label!r}; choose from {labels}")
    return [cell for cell in all_cells if not only or cell.label in only]


def _check_weights(out: Path, rows: Sequence[Row], versions: dict[str, dict[str, str]]) -> None:
    """Two networks under one name would be averaged."""
    for row in rows:
        ours, theirs = versions.get(row.method, {}).get("weights"), row.versions.get("weights")
        if ours is not None and theirs is not None and ours != theirs:
            raise ValueError(
                f"{out}: holds rows of {row.method} with weights {theirs}, now they are {ours}; use another file"
            )


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[failed]} failed"),
        console=Console(stderr=True),
    )
