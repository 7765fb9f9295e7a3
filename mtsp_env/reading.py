"""Reading files, and making what they say fit to be printed."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from mtsp_env.machine import check_memory

BYTES_PER_BYTE = 8  # that a file takes in memory as Python objects, at least


def read_file(path: str | os.PathLike) -> bytes:
    """The content of a regular file.

    Raises:
        OSError: the file cannot be read.
        ValueError: a directory, a device or a pipe, which may never end, or a file that does not fit into the memory.
    """
    path = Path(path)
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise ValueError(f"{path}: a directory, not a file")
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path}: not a regular file; a device or a pipe cannot be read")
    check_memory(f"{path}: the size in bytes", status.st_size, BYTES_PER_BYTE)
    return path.read_bytes()


def printable(text: str) -> str:
    """``text`` with U+FFFD for every character that is not printable, such as an escape or half of a surrogate pair."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)
