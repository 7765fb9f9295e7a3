"""Results on disk: a JSON line for each (method, instance), appended whole, read back with every damage named."""

from __future__ import annotations

import fcntl
import gzip
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from mtsp_env.instance import Tours

STATUSES = ("ok", "unavailable", "no tours", "wrong tours", "error", "crash", "timeout")


@dataclass(frozen=True)
class Row:
    """What one solver did with one instance.

    Attributes:
        table, cell, instance, name: which instance: the table and its cell's label, the number in the cell, its name.
        method: the solver's name.
        budget: seconds that it was given; None: it takes none, and is run once.
        seed: of the test set; the solver's own is this plus ``instance``.
        status: one of STATUSES.
        error: why not "ok"; None where it is.
        makespan: by ``mtsp_env.tours``, in the unit square's lengths; None without right tours, as the next three.
        bound: no makespan is below this, where the solver says so.
        length, rounded_length: the makespan in the units of a TSPLIB file, and with every leg rounded as TSPLIB does.
        seconds: wall time of the solver alone, measured in its process; of a killed one, until it was killed.
        cpu_seconds: of its process and their children; None where the process ended.
        tours: one per agent.
        versions: of what the method runs on; "weights" is the beginning of their SHA-256.
        machine: processor, cores, platform, Python.
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
        """It has right tours."""
        return self.status == "ok"

    @property
    def key(self) -> tuple:
        """What is not run again."""
        return self.table, self.cell, self.instance, self.method, self.budget, self.seed

    @property
    def label(self) -> str:
        """The method, and its budget where it takes one."""
        return self.method if self.budget is None else f"{self.method} {self.budget:g} s"


def parse(line: str) -> Row:
    """The row that a line holds. Raises ValueError where it holds none."""
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
        raise ValueError("instance, seed, seconds and, where the status is ok, makespan and tours must be there")
    return row


def read(path: Path) -> list[Row]:
    """The rows of a file of JSON lines, gzipped where its name ends in ".gz".

    Raises:
        OSError: no such file.
        ValueError: a damaged line; the message names the file and the line.
    """
    data = path.read_bytes()
    if path.suffix == ".gz":
        try:
            data = gzip.decompress(data)
        except (EOFError, OSError) as error:
            raise ValueError(f"{path}: not a whole gzip file ({error})") from error
    return list(_parse_all(path, data))


def _parse_all(path: Path, data: bytes) -> Iterable[Row]:
    for number, line in enumerate(data.splitlines(), start=1):
        try:
            yield parse(line.decode("utf-8"))
        except ValueError as error:
            raise ValueError(f"{path}:{number}: damaged line: {error}") from error


class Journal:
    """A file of rows that grows: what it held is in ``rows``; ``append`` returns when the new one is on disk.

    A last line that was cut off when its writer was killed is dropped. One writer at a time holds the file's lock.

    Raises:
        OSError: the file cannot be written.
        ValueError: a damaged line before the last, a gzipped file, or another writer.
    """

    def __init__(self, path: Path) -> None:
        if path.suffix == ".gz":
            raise ValueError(f"{path}: rows are appended to plain files only; gzip it when it is complete")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(path, "a+b")  # noqa: SIM115 (closed by __exit__)
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._file.seek(0)
            whole = self._file.read().rpartition(b"\n")[0]
            self._file.truncate(len(whole) + 1 if whole else 0)
            self.rows = list(_parse_all(path, whole))
        except BlockingIOError:
            self._file.close()
            raise ValueError(f"{path}: another run is writing to it") from None
        except BaseException:
            self._file.close()
            raise

    def append(self, row: Row) -> None:
        """Write a row, whole and to the disk."""
        self._file.write(json.dumps(asdict(row), separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
