"""Trees of processes: what a solver starts is killed with it, even if it has left the solver's process group."""

from __future__ import annotations

import sys
from contextlib import suppress

import psutil

PR_SET_CHILD_SUBREAPER = 36  # <sys/prctl.h>


def adopt_orphans() -> None:
    """On Linux, become the parent of every descendant whose own parent ends, so that ``kill_descendants`` finds it."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)


def kill_descendants(pid: int) -> None:
    """Kill the children of a process, their children, and so on, in whatever process group they are."""
    with suppress(psutil.NoSuchProcess):
        root, killed = psutil.Process(pid), set()
        while fresh := set(root.children(recursive=True)) - killed:  # again: some may have started others meanwhile
            for process in fresh:
                with suppress(psutil.NoSuchProcess):
                    process.kill()
            killed |= fresh
