"""One run of LKH in a process of its own, for ``lkh3``. It ends when its parent does.

Started by its path, so that it loads neither this package nor NumPy; arguments: the parent's process number, the time
to end at (of ``time.monotonic``, which all processes share), and the program, or nothing for the one inside ``elkai``.
The folder it is started in holds ``parameters`` and ``problem``; tours are left there.
"""

import os
import signal
import sys
import time
from pathlib import Path

PR_SET_PDEATHSIG = 1  # <sys/prctl.h>
LEAST_SECONDS = 0.05  # for LKH, where it was slow to start


def die_with(parent: int) -> None:
    """Be killed when ``parent`` ends, whatever ended it, where the system is Linux; what is executed next, too."""
    if sys.platform != "linux":
        return
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:  # it was faster
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
    if nodes:  # where its first bound is the optimum (one agent), LKH searches nothing and writes no file
        Path("last.tour").write_text("\n".join(["TOUR_SECTION", *map(str, nodes), "-1", "EOF", ""]))


if __name__ == "__main__":
    del sys.path[0]  # this folder, whose modules bear the names of the packages that they use
    main(int(sys.argv[1]), float(sys.argv[2]), *sys.argv[3:])
