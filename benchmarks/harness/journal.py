"""A growing file of rows, so that an interrupted run can be resumed."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.harness.rows import parse_lines
from mtsp_env.writing import lock


class Journal:
    """A file of rows, open for appending; ``rows`` holds those that it had when it was opened.

    A last line that was cut off when its writer was killed is dropped. A lock on the file allows one writer at a time.

    Args:
        path: the file.
        parse: reads its lines, ``(path, data) -> rows``, and raises ValueError on a damaged one. Rows are dataclasses.

    Raises:
        OSError: the file cannot be written.
        ValueError: a damaged line before the last, a gzipped file, a device or pipe, or another writer.
    """

    def __init__(self, path: Path, parse: Callable[[Path, bytes], Iterator[Any]] = parse_lines) -> None:
        if path.exists() and not path.is_file():
            raise ValueError(f"{path}: rows are appended to regular files only")
        if path.suffix == ".gz":
            raise ValueError(f"{path}: rows are appended to plain files only; gzip it when it is complete")
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = open(path, "a+b")  # noqa: SIM115 (closed by __exit__)
        try:
            lock(self._file)
            self._file.seek(0)
            whole_lines = self._file.read().rpartition(b"\n")[0]
            self._file.truncate(len(whole_lines) + 1 if whole_lines else 0)
            self.rows = list(parse(path, whole_lines))
        except BlockingIOError:
            self._file.close()
            raise ValueError(f"{path}: another run is writing to it") from None
        except BaseException:
            self._file.close()
            raise

    def append(self, row: Any) -> None:
        """Append a row; it is on the disk when this returns."""
        self._file.write(json.dumps(asdict(row), separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
