"""Rows of results: one JSON line for each instance that a solver was run on."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mtsp_env.instance import Tours

STATUSES = ("ok", "unavailable", "no tours", "wrong tours", "error", "crash", "timeout")


@dataclass(frozen=True)
class Row:
    """The result of one solver on one instance.

    Attributes:
        table: key of ``suite.TABLES``.
        cell: label of the table's cell.
        instance: number of the instance in its cell.
        name: name of the instance.
        method: name of the solver.
        budget: seconds that the solver was given; None if it takes no budget.
        seed: seed of the test set; the solver's own seed is this plus ``instance``.
        status: one of STATUSES.
        error: the reason for any status but "ok", else None.
        makespan: makespan by ``mtsp_env.tours``, in lengths of the unit square; None without valid tours.
        bound: lower bound on the makespan, if the solver gives one.
        length: makespan in the units of a TSPLIB file.
        rounded_length: the same with every leg rounded as TSPLIB does.
        seconds: wall time of the solver alone, measured in its process; for a killed one, the time until then.
        cpu_seconds: CPU time of the solver's process and its children; None if the process ended.
        tours: one tour per agent; None unless they are valid.
        versions: versions of the packages behind the method; "weights" is the beginning of their SHA-256.
        machine: processor, cores, platform and Python version.
    """

    table: str
    cell: str
    instance: int
    name: str
    method: str
    budget: float | None
    seed: int
    status: str
    error: str | None
    makespan: float | None
    bound: float | None
    length: float | None
    rounded_length: int | None
    seconds: float
    cpu_seconds: float | None
    tours: Tours | None
    versions: dict[str, str]
    machine: dict[str, Any]

    @property
    def ok(self) -> bool:
        """Whether the solver returned valid tours."""
        return self.status == "ok"

    @property
    def key(self) -> tuple:
        """Identifies the run: a row with the same key is not measured again."""
        return self.table, self.cell, self.instance, self.method, self.budget, self.seed

    @property
    def label(self) -> str:
        """The method, with its budget if it takes one."""
        return self.method if self.budget is None else f"{self.method} {self.budget:g} s"


def parse(line: str) -> Row:
    """Parse one line. Raises ValueError if it is not a row."""
    try:
        data = json.loads(line)
    except ValueError as error:
        raise ValueError(f"not JSON ({error})") from error
    names = [field.name for field in fields(Row)]
    if not isinstance(data, dict) or sorted(data) != sorted(names):
        raise ValueError(f"expected an object with the fields {names}")
    row = Row(**data)
    numbers = (row.seconds, row.instance, row.seed, *([row.makespan] if row.ok else []))
    if row.status not in STATUSES:
        raise ValueError(f"status must be one of {STATUSES}, got {row.status!r}")
    if not all(isinstance(number, (int, float)) for number in numbers) or (row.ok and not isinstance(row.tours, list)):
        raise ValueError(
            "instance, seed and seconds must be numbers, and so must makespan, with tours, if status is ok"
        )
    return row


def parse_lines(path: Path, data: bytes) -> Iterator[Row]:
    """Parse the content of a file; a ValueError names ``path`` and the line."""
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            yield parse(line.decode("utf-8"))
        except ValueError as error:
            raise ValueError(f"{path}:{number}: damaged line: {error}") from error


def read(path: Path) -> list[Row]:
    """Read a file of JSON lines, gzipped if its name ends in ".gz".

    Raises:
        OSError: the file cannot be read.
        ValueError: a damaged line; the message names the file and the line.
    """
    data = path.read_bytes()
    if path.suffix == ".gz":
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError) as error:
            raise ValueError(f"{path}: not a whole gzip file ({error})") from error
    return list(parse_lines(path, data))
