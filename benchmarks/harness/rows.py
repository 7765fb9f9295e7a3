"""Rows of results: one JSON line for each instance that a solver was run on."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from benchmarks.suite import MOST_INSTANCES
from mtsp_env.instance import Tours
from mtsp_env.reading import read_file

Status = Literal["ok", "unavailable", "no tours", "wrong tours", "error", "crash", "timeout"]
Seconds = Annotated[float, Meta(ge=0)]
Length = Annotated[float, Meta(ge=0)]


@dataclass(frozen=True)
class Row:
    """The result of one solver on one instance. ``parse`` reads it, and checks it against these annotations.

    Attributes:
        table: key of ``suite.TABLES``.
        cell: label of the table's cell.
        instance: number of the instance in its cell.
        name: name of the instance.
        method: name of the solver.
        budget: seconds that the solver was given; None if it takes no budget.
        seed: seed of the test set; the solver's own seed is this plus ``instance``.
        status: what became of the run.
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
    instance: Annotated[int, Meta(ge=0, lt=MOST_INSTANCES)]
    name: str
    method: str
    budget: Annotated[float, Meta(gt=0)] | None
    seed: Annotated[int, Meta(ge=0)]
    status: Status
    error: str | None
    makespan: Length | None
    bound: float | None
    length: Length | None
    rounded_length: Annotated[int, Meta(ge=0)] | None
    seconds: Seconds
    cpu_seconds: Seconds | None
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


FIELDS = tuple(field.name for field in fields(Row))


def parse(line: str | bytes) -> Row:
    """Parse one line. Raises ValueError if it is not a row."""
    try:
        data = msgspec.json.decode(line)
        if not isinstance(data, dict) or data.keys() != set(FIELDS):
            raise ValueError(f"expected an object with the fields {list(FIELDS)}")
        row = msgspec.convert(data, Row)
    except msgspec.ValidationError as error:  # its message names the field
        raise ValueError(f"not a row ({error})") from error
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from error
    numbers = (row.budget, row.makespan, row.bound, row.length, row.seconds, row.cpu_seconds)
    if not all(number is None or math.isfinite(number) for number in numbers):
        raise ValueError("numbers must be finite")
    if row.ok != (row.makespan is not None) or row.ok != (row.tours is not None):
        raise ValueError(f"makespan and tours belong to status 'ok', and to no other; got {row.status!r}")
    return row


def parse_lines(path: Path, data: bytes) -> Iterator[Row]:
    """Parse the content of a file; a ValueError names ``path`` and the line."""
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            yield parse(line)
        except ValueError as error:
            raise ValueError(f"{path}:{number}: damaged line: {error}") from error


def read(path: Path) -> list[Row]:
    """Read a file of JSON lines, gzipped if its name ends in ".gz".

    Raises:
        OSError: the file cannot be read.
        ValueError: not a regular file, or a damaged line; the message names the file and the line.
    """
    data = read_file(path)
    if path.suffix == ".gz":
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError, zlib.error) as error:
            raise ValueError(f"{path}: not a whole gzip file ({error})") from error
    return list(parse_lines(path, data))
