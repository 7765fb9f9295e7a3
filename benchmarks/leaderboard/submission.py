"""A submission: a JSON file with the tours of one method on one test set, read and judged."""

from __future__ import annotations

import gzip
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from benchmarks.harness.rows import Row
from benchmarks.leaderboard import test_sets
from benchmarks.leaderboard.test_sets import TestSet
from benchmarks.suite import AnyCell
from mtsp_env.instance import Tours
from mtsp_env.reading import read_file
from mtsp_env.tours import check_tours, makespan
from mtsp_env.writing import atomic_write

Knows = Literal["observation", "global", "map"]
"""What a method may know: "observation", what one agent sees when it decides, and no more; "global", everything that is
known to anybody at that time; "map", the whole instance from the beginning, for example to plan centrally or to play
whole games and choose the best."""

Text = Annotated[str, Meta(max_length=80, pattern=r"^[^|\r\n<>`\[\]]*$")]  # shown in a table
Name = Annotated[str, Meta(min_length=1, max_length=80, pattern=r"^[^|\r\n<>`\[\]]+$")]


class CellResult(msgspec.Struct, forbid_unknown_fields=True):
    """One size of a test set.

    Attributes:
        seconds: mean wall time of one instance; null: not measured.
        tours: the tours of each instance, in the test set's order.
        decisions: for the test set "worlds", which has no tours: the nodes that the agents picked in each game, in
            turn.
    """

    seconds: Annotated[float, Meta(ge=0)] | None
    tours: list[Tours] | None = None
    decisions: list[list[int]] | None = None


class Submission(msgspec.Struct, forbid_unknown_fields=True):
    """What a file holds; ``cells`` may leave out sizes, but a size has the tours of all its instances.

    Attributes:
        method: the method's name.
        by: who submits it.
        test_set: name of a test set (``test_sets.TEST_SETS``), or "worlds".
        knows: what the method may know; see ``Knows``.
        machine: the machine that the seconds were measured on, and the number of threads.
        cells: label of a size, such as "50x5" for n = 50 and m = 5 -> its results.
        link: address of a paper or a repository.
    """

    method: Name
    by: Name
    test_set: str
    knows: Knows
    machine: Text
    cells: dict[str, CellResult]
    link: Annotated[str, Meta(max_length=200, pattern=r"^(https?://[^\s()<>|]+)?$")] = ""


def read(path: Path) -> Submission:
    """Read a submission, gzipped if its name ends in ".gz". It is not judged yet.

    Raises:
        OSError: the file cannot be read.
        ValueError: not a submission; the message names the file and the field.
    """
    data = read_file(path)
    try:
        if path.suffix == ".gz":
            data = gzip.decompress(data)
        return msgspec.json.decode(data, type=Submission)
    except msgspec.ValidationError as error:
        raise ValueError(f"{path}: not a submission ({error})") from error
    except (msgspec.DecodeError, RecursionError) as error:
        raise ValueError(f"{path}: not JSON ({error})") from error
    except (EOFError, OSError, zlib.error) as error:
        raise ValueError(f"{path}: not a whole gzip file ({error})") from error


def write(path: Path, submission: Submission) -> None:
    """Write a submission atomically, gzipped if the file's name ends in ".gz"."""
    data = msgspec.json.encode(submission)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        temporary.write_bytes(gzip.compress(data, mtime=0) if path.suffix == ".gz" else data)


def judge(submission: Submission) -> list[Row]:
    """A row for each instance, with the makespan by the project's own judge.

    Raises:
        ValueError: an unknown test set or cell, no cells, a wrong number of instances, or tours that do not solve their
            instance; the message names the cell and the instance.
    """
    test_set = test_sets.find(submission.test_set)
    cells = test_set.cells
    if not submission.cells:
        raise ValueError(f"no cells; choose from {sorted(cells)}")
    rows = []
    for label, result in submission.cells.items():
        if label not in cells:
            raise ValueError(f"test set {submission.test_set!r} has no cell {label!r}; choose from {sorted(cells)}")
        rows += _judge_cell(submission, test_set, cells[label], result)
    return rows


def _judge_cell(submission: Submission, test_set: TestSet, cell: AnyCell, result: CellResult) -> list[Row]:
    if result.tours is None:
        raise ValueError(f"{cell.label} needs tours")
    if len(result.tours) != cell.count:
        raise ValueError(f"{cell.label} has {cell.count} instances, got the tours of {len(result.tours)}")
    rows = []
    for number, (instance, tours) in enumerate(zip(cell.instances(test_set.seed), result.tours, strict=True)):
        try:
            check_tours(instance, tours)
        except ValueError as error:
            raise ValueError(f"{cell.label}, instance {number}: {error}") from error
        rows.append(
            Row(
                table=test_set.table,
                cell=cell.label,
                instance=number,
                name=instance.name,
                method=submission.method,
                budget=None,
                seed=test_set.seed,
                status="ok",
                error=None,
                makespan=makespan(instance, tours),
                bound=None,
                length=None,
                rounded_length=None,
                seconds=0.0 if result.seconds is None else result.seconds,
                cpu_seconds=None,
                tours=tours,
                versions={},
                machine={"processor": submission.machine},
            )
        )
    return rows


def with_label(rows: list[Row], label: str) -> list[Row]:
    """The rows under another method's name, so that two submissions of one method stay apart."""
    return [replace(row, method=label) for row in rows]
