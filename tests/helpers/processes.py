"""Watching other processes."""

from __future__ import annotations

import time
from collections.abc import Callable

import psutil


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits for its parent does not."""
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def children(pid: int) -> list[int]:
    """The numbers of a process's children."""
    return [child.pid for child in psutil.Process(pid).children()]


def wait_until(condition: Callable[[], object], seconds: float = 300.0) -> None:
    """Return as soon as the condition holds; an AssertionError if it does not within this time."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, f"still false after {seconds} s"
        time.sleep(0.02)
