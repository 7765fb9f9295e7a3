"""LKH-3 (Helsgaun 2017, An extension of the Lin-Kernighan-Helsgaun TSP solver for constrained TSP and VRP problems).

The program ``LKH`` is used if it is on the PATH, otherwise the LKH 3.0.8 inside the package ``elkai``. Settings that
differ from LKH's defaults:

- ``SPECIAL``: the moves and kicks that LKH-3 has for such problems. Without it, three of four instances of n = 50 have
  no tours after 1 s.
- One run with as many trials as its time allows. It ends early if the longest tour is the farthest out-and-back trip
  (``OPTIMUM``), which is a lower bound. The default, runs of n trials that are crossed with each other, was not better.
- ``MTSP_MIN_SIZE = 0``: agents may stay at home. The default, 1, has the same optimum, because an idle agent can take
  over a city at no cost; the measured difference was none.
- ``INITIAL_TOUR_ALGORITHM = MTSP`` (Soylu 2015) and ``INITIAL_PERIOD = 100`` (of the ascent; default n / 2): the first
  tours come earlier, at n = 1000 after 1.3 s instead of 2.9 s; the last ones are as good, within the noise of 8
  instances of n = 100 and 200.
- Lengths are whole millionths of the unit square's side, because LKH's lengths are integers. LKH's makespan differs
  from the true one by about 1e-6 of its value.

LKH measures CPU time, and does not check it during its preparation (0.4 s at n = 1000). Hence it runs in a process of
its own, which is killed shortly after its time, and the improved tours of each trial are read from a file. If the first
trial does not end in time, there are no tours.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.solvers import NoTours, Unavailable
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import makespan

UNIT = 1_000_000  # LKH's lengths per side of the unit square
GRACE_SHARE, GRACE_SECONDS = 0.1, 0.2  # LKH is killed after this share of its time plus these seconds beyond it
UNLIMITED_TRIALS = 10**9  # time is the only limit
N_SEEDS = 2**31 - 1  # LKH's seeds are 1 to this; 0 means the clock
CHILD = Path(__file__).with_name("_lkh_child.py")


def solve(instance: Instance, seconds: float, seed: int, trials: int = UNLIMITED_TRIALS) -> Tours:
    """Tours by LKH-3 on one thread, within ``seconds`` and after at most ``trials`` trials.

    If LKH finishes its trials in time, the tours depend on the arguments alone.

    Raises:
        Unavailable: neither the program LKH nor the package elkai is installed.
        NoTours: the first trial was not done in time.
        RuntimeError: LKH failed; the message ends with the last line of its standard error.
    """
    end = time.monotonic() + seconds
    program = _program()
    if instance.n_nodes == 2:  # LKH needs at least 3
        return [[0, 1, 0], *([0, 0] for _ in range(instance.n_agents - 1))]
    with tempfile.TemporaryDirectory(prefix="lkh3-") as folder:
        Path(folder, "parameters").write_text(_parameters(instance, seed, trials))
        Path(folder, "problem").write_text(_problem(instance))
        _run(program, folder, end, GRACE_SHARE * seconds + GRACE_SECONDS)
        texts = [file.read_text() for file in Path(folder).glob("*.tour")]
    candidates = [_read(text, instance) for text in texts if text.endswith("EOF\n")]  # a kill can leave half a file
    if not candidates:
        raise NoTours(f"LKH's first trial was not done in {seconds:g} s")
    return min(candidates, key=lambda tours: makespan(instance, tours))


def _program() -> str:
    """The path of LKH; empty for the one inside elkai."""
    program = shutil.which("LKH")
    if program is None and find_spec("elkai") is None:
        raise Unavailable("neither the program LKH nor the package elkai is installed")
    return os.path.abspath(program) if program else ""


def _grid(instance: Instance) -> np.ndarray:
    return np.rint(instance.nodes * UNIT).astype(np.int64)  # (n, 2)


def _parameters(instance: Instance, seed: int, trials: int) -> str:
    n_agents = min(instance.n_agents, instance.n_nodes - 1)  # LKH accepts at most as many agents as cities
    grid = _grid(instance)
    farthest = math.floor(np.hypot(*(grid - grid[0]).T).max() + 0.5)  # rounded as in TSPLIB's EUC_2D
    settings = {
        "SALESMEN": n_agents,
        "MTSP_OBJECTIVE": "MINMAX",
        "MTSP_MIN_SIZE": 0,
        "INITIAL_PERIOD": 100,
        "RUNS": 1,
        "MAX_TRIALS": trials,
        "SEED": seed % N_SEEDS + 1,
        "TRACE_LEVEL": 0,
        "OUTPUT_TOUR_FILE": "$.tour",  # $ is the tour's cost, so that no file is overwritten
    }
    if n_agents > 1:  # LKH hangs on MTSP with one agent, and its optimum is rarely that trip
        settings |= {"INITIAL_TOUR_ALGORITHM": "MTSP", "OPTIMUM": 2 * farthest}
    return "SPECIAL\n" + "".join(f"{name} = {value}\n" for name, value in settings.items())


def _problem(instance: Instance) -> str:
    nodes = "".join(f"{number} {x} {y}\n" for number, (x, y) in enumerate(_grid(instance), start=1))
    return f"TYPE : TSP\nDIMENSION : {instance.n_nodes}\nEDGE_WEIGHT_TYPE : EUC_2D\nNODE_COORD_SECTION\n{nodes}EOF\n"


def _run(program: str, folder: str, end: float, grace: float) -> None:
    """Run LKH in ``folder``; kill it ``grace`` seconds after ``end``."""
    command = [sys.executable, str(CHILD), str(os.getpid()), repr(end), *([program] if program else [])]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=max(end + grace - time.monotonic(), 0.0),
            check=False,
        )
    except subprocess.TimeoutExpired:
        return
    if done.returncode:
        lines = done.stderr.decode(errors="replace").strip().splitlines() or ["no message"]
        raise RuntimeError(f"LKH ended with code {done.returncode}: {lines[-1]}")


def _read(text: str, instance: Instance) -> Tours:
    """The tours in a TSPLIB tour file, in which node 1 and the nodes beyond n are the depot."""
    numbers = [int(word) - 1 for word in text.partition("TOUR_SECTION")[2].split()[:-2]]  # without -1 and EOF
    nodes = [number if number < instance.n_nodes else 0 for number in numbers]
    start = nodes.index(0)
    tours: Tours = []
    for node in nodes[start:] + nodes[:start]:
        if node == 0:
            tours.append([0])
        else:
            tours[-1].append(node)
    idle = [[0]] * (instance.n_agents - len(tours))
    return [[*tour, 0] for tour in tours + idle]
