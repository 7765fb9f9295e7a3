"""``python -m benchmarks run``: runs every method on every instance of a table and keeps a row for each.

Solvers run in processes of their own (``supervisor.py``, ``worker.py``). POSIX only.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from benchmarks import solvers, suite
from benchmarks.harness.jobs import Limits, make_jobs
from benchmarks.harness.journal import Journal
from benchmarks.harness.machine import describe_machine
from benchmarks.harness.rows import Row
from benchmarks.harness.supervisor import run_jobs
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.machine import usable_cores


def run(
    table: str,
    out: Path,
    methods: tuple[str, ...] = ("nearest", "dan-greedy", "dan-s64", "reference"),
    instances: int | None = None,
    seed: int | None = None,
    seconds: tuple[float, ...] = (1.0,),
    limit: float = 600.0,
    grace: float = 10.0,
    warm_up: float = 300.0,
    workers: int = 1,
    tsplib: Path | None = None,
    cells: tuple[str, ...] = (),
    retry_failed: bool = False,
) -> str:
    """Solve a table's instances with every method and append a row of JSON for each; existing rows are not run again.

    Args:
        table: 1, 2, 3, figure4, seed3333 or smoke.
        out: file of JSON lines to append to.
        methods: names of solvers or groups (dan, all), separated by spaces or commas; package.module:function names a
            solver of your own.
        instances: number of instances in each cell; by default the table's.
        seed: seed of the instances; by default 7, and 3333 for the table seed3333: best known tours are kept for these.
        seconds: budgets for the solvers that take one; each budget gives a row.
        limit: seconds that the other solvers may take.
        grace: seconds beyond its budget or limit after which a solver is killed.
        warm_up: seconds to load a solver and solve a tiny instance, which is not measured.
        workers: number of processes, each with one thread on a core of its own.
        tsplib: folder with the TSPLIB files of table 3.
        cells: labels of the cells to run, such as 50x5 or eil51x5; by default all cells of the table.
        retry_failed: run the failed rows of the file again; the newer row counts.

    Returns:
        One line that says how many rows are new.

    Raises:
        OSError: ``out`` or a TSPLIB file cannot be read or written.
        ValueError: an unknown name, a number outside its range, or an ``out`` with rows that do not fit.
    """
    limits, methods = Limits(limit, grace, warm_up), solvers.expand(methods)
    cores = usable_cores()
    check_count("workers", workers, minimum=1)
    if workers > len(cores):
        raise ValueError(f"workers must be at most {len(cores)}, the number of cores, got {workers}")
    for budget in seconds:
        check_seconds("seconds", budget)
    for method in methods:
        if method not in solvers.SOLVERS:
            solvers.find(method)  # a misspelt name should not fill the file with errors
    versions = {method: solvers.look_up(method).versions() for method in methods}
    chosen = suite.choose(suite.cells(table, tsplib, instances), cells)
    jobs = make_jobs(chosen, table, methods, suite.seed_of(table, seed), seconds)
    count = failed = 0
    with Journal(out) as journal:
        _check_weights(out, journal.rows, versions)
        done = {row.key for row in journal.rows if row.ok or not retry_failed}
        jobs = [job for job in jobs if job.key not in done]
        machine = describe_machine()
        with _progress() as progress:
            task = progress.add_task(f"table {table}", total=len(jobs), failed=0)
            with closing(run_jobs(jobs, limits, cores[:workers])) as outcomes:
                for job, outcome in outcomes:
                    row = job.to_row(outcome, versions[job.method], machine)
                    journal.append(row)
                    count, failed = count + 1, failed + (not row.ok)
                    progress.update(task, advance=1, failed=failed)
    return f"{out}: {count} new rows, {failed} of them failed"


def _check_weights(out: Path, rows: Sequence[Row], versions: dict[str, dict[str, str]]) -> None:
    """Raise ValueError if the file has rows of the same method with other weights: a report would average both."""
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
