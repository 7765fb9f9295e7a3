"""A process that solves one instance after the other for the supervisor, with one thread on one core.

It leads a process group. Each solver is loaded and warmed up once, so that measured times include neither imports nor
compilation nor the loading of weights.
"""

from __future__ import annotations

import gc
import os
import resource
import signal
import sys
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Thread
from typing import Any

from benchmarks import solvers
from benchmarks.harness.processes import adopt_orphans, kill_descendants
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, makespan

READY = "ready"  # sent before the clock starts
WARM_UP = Instance([[0.5, 0.5], [0.1, 0.2], [0.9, 0.1], [0.8, 0.9], [0.2, 0.7], [0.4, 0.1]], n_agents=2, name="warm-up")
WARM_UP_SECONDS = 0.2  # for solvers that use all of their budget


def solve(connection: Connection, method: str, instance: Instance, seconds: float, seed: int, loaded: dict) -> None:
    """Send READY, then the outcome. ``loaded`` maps names to the solvers that are loaded and warm."""
    if method not in loaded:
        try:
            loaded[method] = solvers.find(method)
        except Exception as error:
            connection.send(READY)
            connection.send(_failure(error) | {"seconds": 0.0})
            return
        with suppress(Exception, SystemExit):  # an error here will occur again below, where it is reported
            loaded[method](WARM_UP, min(seconds, WARM_UP_SECONDS), 0)
    gc.collect()
    connection.send(READY)
    connection.send(attempt(loaded[method], instance, seconds, seed))


def attempt(solver: solvers.Solve, instance: Instance, seconds: float, seed: int) -> dict[str, Any]:
    """Run a solver, whatever it does; returns the fields of a ``Row`` that describe the outcome."""
    cpu, start = _cpu_seconds(), time.perf_counter()
    failure = None
    try:
        answer = solver(instance, seconds, seed)
    except (Exception, SystemExit) as error:
        failure = _failure(error)
    times = {"seconds": time.perf_counter() - start, "cpu_seconds": _cpu_seconds() - cpu}
    return (failure or judge(instance, answer)) | times


def judge(instance: Instance, answer: Tours | solvers.Answer) -> dict[str, Any]:
    """Status, tours, makespan and bound of a solver's answer, by ``mtsp_env.tours`` alone."""
    tours, bound = answer if isinstance(answer, solvers.Answer) else (answer, None)
    try:
        check_tours(instance, tours)
        tours = [[int(node) for node in tour] for tour in tours]
        bound = None if bound is None else float(bound)
    except Exception as error:  # an answer can be any object
        return {"status": "wrong tours", "error": f"{type(error).__name__}: {error}"[:1000]}
    return {"status": "ok", "tours": tours, "makespan": makespan(instance, tours), "bound": bound}


def _failure(error: BaseException) -> dict[str, Any]:
    if isinstance(error, solvers.Unavailable):
        return {"status": "unavailable", "error": str(error)[:1000]}
    if isinstance(error, ModuleNotFoundError):
        return {"status": "unavailable", "error": f"package {error.name} is missing"}
    if isinstance(error, solvers.NoTours):
        return {"status": "no tours", "error": str(error)[:1000]}
    return {"status": "error", "error": f"{type(error).__name__}: {error}"[:1000]}


def _cpu_seconds() -> float:
    """CPU time of this process and of its children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _receive(connection: Connection, jobs: SimpleQueue) -> None:
    """Queue the jobs that arrive. When the supervisor is gone, end with all descendants, even in a solver."""
    with suppress(EOFError, OSError):
        while True:
            jobs.put(connection.recv())
    kill_descendants(os.getpid())
    os.killpg(0, signal.SIGKILL)


def main(descriptor: int, core: int | None) -> None:
    """Solve the jobs that arrive on the connection with this file descriptor, on this core; never returns."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    adopt_orphans()
    connection, jobs, loaded = Connection(descriptor), SimpleQueue(), {}
    Thread(target=_receive, args=(connection, jobs), daemon=True).start()
    while True:
        solve(connection, *jobs.get(), loaded)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None)
