"""How all packages write: files are replaced whole, and a lock keeps two processes from writing to the same place."""

from __future__ import annotations

import errno
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

LEFTOVER = ".tmp"  # suffix of what a killed process leaves behind
STANDARD_STREAMS = {"/dev/stdin": 0, "/dev/stdout": 1, "/dev/stderr": 2}
DESCRIPTORS = re.compile(r"/(?:dev|proc/self)/fd/(\d+)")


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Give a temporary path; what is written there becomes the content of ``path`` when the block ends.

    If the block raises an error, or the process dies, an existing file stays as it was. A new file gets the permissions
    that ``open`` would give it, an existing one keeps its own. A symbolic link stays a link: its target is written.

    A pipe or a character device, such as ``/dev/stdout`` or a FIFO, is never replaced: the content is written to it
    when the block ends.

    >>> with atomic_write("tours.json") as temporary:
    ...     temporary.write_text("{}")

    Raises:
        OSError: ``path`` cannot be written, or it is a folder, a socket or a block device.
    """
    stream = _open_stream(Path(path))
    if stream is not None:
        with stream, tempfile.TemporaryDirectory() as folder:
            temporary = Path(folder, "content")
            yield temporary
            with open(temporary, "rb") as content:
                shutil.copyfileobj(content, stream)
        return
    target = Path(os.path.realpath(path))
    old = _writable(target)
    temporary = target.with_name(f".{target.name[:40]}.{secrets.token_hex(4)}{LEFTOVER}")
    os.close(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666))
    try:
        yield temporary
        _flush_to_disk(temporary)
        if old is not None:
            _take_over(old, temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove what writers of files in ``folder`` have left behind when they were killed. No other may be at work."""
    for leftover in folder.glob(f".*{LEFTOVER}"):
        leftover.unlink(missing_ok=True)


def lock(file: IO) -> None:
    """Hold an exclusive lock on an open file until it is closed, at the latest when the process ends. POSIX only.

    Raises:
        BlockingIOError: another process holds it.
        OSError: the file system has no locks.
    """
    import fcntl

    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """A context in which no other process is in such a context for this folder; waits for it. POSIX only.

    Raises:
        OSError: there is no such folder, or its file system has no locks.
    """
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _open_stream(path: Path) -> IO[bytes] | None:
    """``path`` opened for writing if it is a pipe or a character device; None if it is a regular file or missing."""
    descriptor = _descriptor(path)
    if descriptor is not None:  # to open the path again would start at the beginning of a file that a shell has opened
        if descriptor == 1 and sys.stdout is not None:
            sys.stdout.flush()  # what has been printed comes first
        return os.fdopen(os.dup(descriptor), "wb")
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISREG(mode):
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not (stat.S_ISFIFO(mode) or stat.S_ISCHR(mode)):
        raise OSError(errno.EINVAL, "neither a regular file nor a pipe or character device", str(path))
    return open(path, "wb")


def _descriptor(path: Path) -> int | None:
    """The number of this process's open file that a path such as ``/dev/stdout`` or a link to it names, else None."""
    for _ in range(40):  # as many links as Linux follows
        if (name := os.path.abspath(path)) in STANDARD_STREAMS:
            return STANDARD_STREAMS[name]
        if match := DESCRIPTORS.fullmatch(name):
            return int(match[1])
        if not path.is_symlink():
            return None
        path = path.parent / os.readlink(path)
    return None  # a loop, which os.stat reports


def _writable(target: Path) -> os.stat_result | None:
    """What is known of an existing file; None if there is none. A file that may not be written may not be replaced."""
    try:
        old = os.stat(target)
    except FileNotFoundError:
        return None
    open(target, "ab").close()
    return old


def _take_over(old: os.stat_result, path: Path) -> None:
    """Give ``path`` the owner and the permissions of the file that it replaces."""
    with suppress(PermissionError):  # only root gives files away
        if hasattr(os, "chown"):
            os.chown(path, old.st_uid, old.st_gid)
    os.chmod(path, old.st_mode & 0o777)


def _flush_to_disk(path: Path) -> None:
    """Without this, a file that replaces another can be empty after a power failure."""
    with open(path, "r+b") as file:
        os.fsync(file.fileno())
