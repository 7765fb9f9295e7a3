"""Solvers for the tests of ``run``, by the names "misbehaving:function". All but one behave during the warm-up."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.solvers import Answer, NoTours, Unavailable

FOLDER = "MISBEHAVING_FOLDER"  # environment variable: folder to which ``hangs`` writes the numbers of its processes
SLEEP = [sys.executable, "-c", "import time; time.sleep(600)"]
LEAVE_AN_ORPHAN = f"""
import subprocess
print(subprocess.Popen({SLEEP}, start_new_session=True, stdout=subprocess.DEVNULL).pid)
"""
calls = 0


def deals(instance, seconds, seed):
    """Valid tours: the cities are dealt out like cards."""
    tours = [[0] for _ in range(instance.n_agents)]
    for city in range(1, instance.n_nodes):
        tours[city % instance.n_agents].append(city)
    return [[*tour, 0] for tour in tours]


def proves(instance, seconds, seed):
    return Answer(deals(instance, seconds, seed), bound=0.5)


def hangs(instance, seconds, seed):
    """Hang with children, two of them in sessions of their own, and ignore polite signals; not if "behave" exists."""
    folder = Path(os.environ[FOLDER])
    if instance.name in ("warm-up", "8x2-0", "8x2-1") or (folder / "behave").exists():
        return deals(instance, seconds, seed)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    child = subprocess.Popen(SLEEP)
    outsider = subprocess.Popen(SLEEP, start_new_session=True)
    orphan = int(subprocess.run([sys.executable, "-c", LEAVE_AN_ORPHAN], stdout=subprocess.PIPE).stdout)
    (folder / f"{instance.name}.tmp").write_text(f"{os.getpid()} {child.pid} {outsider.pid} {orphan}")
    (folder / f"{instance.name}.tmp").rename(folder / f"{instance.name}.pids")
    while True:
        time.sleep(600)


def hangs_in_the_warm_up(instance, seconds, seed):
    while True:
        time.sleep(600)


def crashes(instance, seconds, seed):
    if instance.name != "warm-up":
        os.kill(os.getpid(), signal.SIGSEGV)
    return deals(instance, seconds, seed)


def leaves(instance, seconds, seed):
    if instance.name != "warm-up":
        print("no more memory", file=sys.stderr, flush=True)
        os._exit(3)
    return deals(instance, seconds, seed)


def exits(instance, seconds, seed):
    sys.exit("enough")


def raises(instance, seconds, seed):
    raise RuntimeError("out of ideas")


def forgets_a_city(instance, seconds, seed):
    tours = deals(instance, seconds, seed)
    tours[0].remove(2)
    return tours


def halves(instance, seconds, seed):
    return [[float(node) for node in tour] for tour in deals(instance, seconds, seed)]


def returns_nothing(instance, seconds, seed):
    return None


def has_no_licence(instance, seconds, seed):
    raise Unavailable("no licence for Solver 9")


def lacks_a_package(instance, seconds, seed):
    import a_package_that_nobody_has  # noqa: F401


def finds_nothing(instance, seconds, seed):
    raise NoTours("no tours in 1 s")


def counts(instance, seconds, seed):
    """Report the number of calls in this process, and the arguments."""
    global calls
    calls += 1
    raise RuntimeError(json.dumps([calls, instance.name, seconds, seed]))


def looks_around(instance, seconds, seed):
    """Report what this process may use."""
    names = [name for name in os.environ if name.endswith("_THREADS")]
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    report = {
        "threads": {name: os.environ[name] for name in names},
        "cores": cores,
        "leads": os.getpid() == os.getpgid(0),
    }
    raise RuntimeError(json.dumps(report))
