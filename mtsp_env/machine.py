"""What this process may use of the machine: its cores and its memory."""

from __future__ import annotations

import os
from pathlib import Path

import psutil

ALWAYS_FITS = 2**27  # bytes; anything smaller is not compared with the free memory, which takes 0.1 ms to read
CGROUP_LIMITS = (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"))


def usable_cores() -> list[int]:
    """Numbers of the cores that this process may run on; on systems that do not say, all of them."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def available_memory() -> int:
    """Bytes that this process can still allocate without swapping, within the limit of its container if it has one."""
    available = psutil.virtual_memory().available
    for file in CGROUP_LIMITS:
        try:
            limit = int(file.read_text())
        except (OSError, ValueError):  # no such control group, or the word "max"
            continue
        available = min(available, limit - psutil.Process().memory_info().rss)
    return max(available, 0)


def check_memory(name: str, value: int, bytes_each: float) -> None:
    """Raise ValueError if ``value`` things of ``bytes_each`` bytes do not fit into the free memory.

    The message names ``name``, ``value`` and the largest value that fits.
    """
    needed = value * bytes_each
    if needed <= ALWAYS_FITS:
        return
    available = available_memory()
    if needed > available:
        raise ValueError(
            f"{name} {value} needs about {needed / 2**30:.3g} GiB of memory, of which {available / 2**30:.3g} GiB are "
            f"free; at most {int(available // bytes_each)} fits"
        )
