"""A process that solves one instance after the other for ``crew``: one core, one thread and a process group of its own.

It loads and warms up each solver once, so that a row's seconds hold neither imports, nor compiling, nor weights.
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
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, makespan

READY = "ready"  # sent before the clock starts
WARM_UP = Instance([[0.5, 0.5], [0.1, 0.2], [0.9, 0.1], [0.8, 0.9], [0.2, 0.7], [0.4, 0.1]], n_agents=2, name="warm-up")
WARM_UP_SECONDS = 0.2  # where a solver goes on for as long as it may


def solve(connection: Connection, method: str, instance: Instance, seconds: float, seed: int, known: dict) -> None:
    """Send READY, then the outcome; ``known`` holds the solvers that are loaded and warm."""
    if method not in known:
        try:
            known[method] = solvers.find(method)
        except Exception as error:
            connection.send(READY)
            connection.send(_failed(error) | {"seconds": 0.0})
            return
        with suppress(Exception, SystemExit):  # whatever goes wrong will go wrong again below, where it is told
            known[method](WARM_UP, min(seconds, WARM_UP_SECONDS), 0)
    gc.collect()
    connection.send(READY)
    connection.send(attempt(known[method], instance, seconds, seed))


def attempt(function: solvers.Solve, instance: Instance, seconds: float, seed: int) -> dict[str, Any]:
    """The fields of a ``Row`` that say what a solver did, whatever it does."""
    cpu, start = _cpu_seconds(), time.perf_counter()
    try:
        answer = function(instance, seconds, seed)
        outcome = None
    except (Exception, SystemExit) as error:
        outcome = _failed(error)
    times = {"seconds": time.perf_counter() - start, "cpu_seconds": _cpu_seconds() - cpu}
    return (outcome or judge(instance, answer)) | times


def judge(instance: Instance, answer: Tours | solvers.Answer) -> dict[str, Any]:
    """Status, tours, makespan and bound of a solver's answer, by ``mtsp_env.tours`` alone."""
    tours, bound = answer if isinstance(answer, solvers.Answer) else (answer, None)
    try:
        check_tours(instance, tours)
        tours = [[int(node) for node in tour] for tour in tours]
        bound = None if bound is None else float(bound)
    except Exception as error:  # an answer may be anything
        return {"status": "wrong tours", "error": f"{type(error).__name__}: {error}"[:1000]}
    return {"status": "ok", "tours": tours, "makespan": makespan(instance, tours), "bound": bound}


def _failed(error: BaseException) -> dict[str, Any]:
    if isinstance(error, solvers.Unavailable):
        return {"status": "unavailable", "error": str(error)[:1000]}
    if isinstance(error, ModuleNotFoundError):
        return {"status": "unavailable", "error": f"package {error.name} is missing"}
    if isinstance(error, solvers.NoTours):
        return {"status": "no tours", "error": str(error)[:1000]}
    return {"status": "error", "error": f"{type(error).__name__}: {error}"[:1000]}


def _cpu_seconds() -> float:
    """Of this process and of its children that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _receive(connection: Connection, jobs: SimpleQueue) -> None:
    """Queue what comes in; when whoever sends it is gone, so are we, whatever a solver is doing."""
    with suppress(EOFError, OSError):
        while True:
            jobs.put(connection.recv())
    os.killpg(0, signal.SIGKILL)


def main(descriptor: int, core: int | None) -> None:
    """Solve what comes in on the connection with that file descriptor, on that core; never returns."""
    if core is not None:
        os.sched_setaffinity(0, {core})
    connection, jobs, known = Connection(descriptor), SimpleQueue(), {}
    Thread(target=_receive, args=(connection, jobs), daemon=True).start()
    while True:
        solve(connection, *jobs.get(), known)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else None)
