"""One run of LKH in a process of its own, for ``lkh3``. It ends when its parent does.

It is started by its path, so that it imports neither this package nor NumPy. Arguments: the parent's process number,
the time at which to end (``time.monotonic``, a clock that all processes share), and the path of LKH, or nothing to use
the LKH inside ``elkai``. The working directory holds ``parameters`` and ``problem``; tours are written there.
"""

import os
import signal
import sys
import time
from pathlib import Path

PR_SET_PDEATHSIG = 1  # <sys/prctl.h>
LEAST_SECONDS = 0.05  # that LKH gets even if this process was slow to start


def die_with(parent: int) -> None:
    """On Linux, let the system kill this process, and a program that replaces it, when ``parent`` ends."""
    if sys.platform != "linux":
        return
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # the parent has ended already
        sys.exit(1)


def main(parent: int, end: float, program: str = "") -> None:
    die_with(parent)
    parameters = Path("parameters").read_text()
    if not program:
        from elkai import _elkai
    parameters += f"TOTAL_TIME_LIMIT = {max(end - time.monotonic(), LEAST_SECONDS):.3f}\n"
    if program:
        Path("parameters").write_text(f"{parameters}PROBLEM_FILE = problem\n")
        os.execv(program, [program, "parameters"])
    nodes = _elkai.solve_problem(f"{parameters}PROBLEM_FILE = :stdin:\n", Path("problem").read_text())
    if nodes:  # if its first bound is the optimum (one agent), LKH does not search and writes no file
        Path("last.tour").write_text("\n".join(["TOUR_SECTION", *map(str, nodes), "-1", "EOF", ""]))


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules have the names of packages
    main(int(sys.argv[1]), float(sys.argv[2]), *sys.argv[3:])
