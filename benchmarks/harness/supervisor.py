"""Worker processes seen from outside: each has one thread on a core of its own, and is killed where it takes too long.

One that hangs is killed with all its children, one that crashes is replaced; both outcomes say so.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Pipe, wait
from typing import TYPE_CHECKING, Any

from benchmarks import solvers
from benchmarks.worker import READY

if TYPE_CHECKING:
    from benchmarks.run import Job

ONE_THREAD = {
    name: "1"
    for name in (
        "OMP_NUM_THREADS",
        "MKL_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "NUMBA_NUM_THREADS",
    )
}


@dataclass(frozen=True)
class Limits:
    """What a solver gets, in seconds.

    Attributes:
        limit: for those that take no budget, and for the tours that a budget then polishes.
        grace: beyond its budget or limit, before it is killed.
        warm_up: to load a solver and to solve a tiny instance, which is not counted, before it is killed.
    """

    limit: float = 600.0
    grace: float = 10.0
    warm_up: float = 300.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            check_seconds(name, value)

    def of(self, job: Job) -> float:
        """Seconds that a job may take, without grace."""
        if job.budget is None:
            return self.limit
        return job.budget + (self.limit if solvers.look_up(job.method).polishes else 0.0)


def outcomes(jobs: Sequence[Job], limits: Limits, cores: Sequence[int | None]) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Each job with what became of it, as they end; a worker for each core. Closing this ends them."""
    waiting, crew = deque(jobs), [Worker(core, limits) for core in cores]
    try:
        while True:
            for worker in crew:
                if worker.job is None and waiting:
                    worker.begin(waiting.popleft())
            busy = [worker for worker in crew if worker.job is not None]
            if not busy:
                return
            until = min(worker.deadline for worker in busy)
            wait([worker.connection for worker in busy], timeout=max(until - time.monotonic(), 0.0))
            for worker in busy:
                job, outcome = worker.job, worker.look()
                if outcome is not None:
                    yield job, outcome
    finally:
        for worker in crew:
            worker.kill()


class Worker:
    """A worker process seen from here: started when it is needed, killed with all its children, started again."""

    def __init__(self, core: int | None, limits: Limits) -> None:
        self.core, self.limits = core, limits
        self.process: subprocess.Popen | None = None
        self.job: Job | None = None

    def begin(self, job: Job) -> None:
        """Send it a job."""
        if self.process is None:
            self._start()
        self.job, self.began = job, None
        self.deadline = time.monotonic() + self.limits.warm_up
        seconds = self.limits.limit if job.budget is None else job.budget
        with suppress(OSError):  # a dead one is found by ``look``
            self.connection.send((job.method, job.instance, seconds, job.seed + job.number))

    def look(self) -> dict[str, Any] | None:
        """What became of the job; None while it runs. A worker past its deadline is killed."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message != READY:
                    self.job = None
                    return message
                self.began = time.monotonic()
                self.deadline = self.began + self.limits.of(self.job) + self.limits.grace
        except (EOFError, OSError):
            return self._end("crash", self._last_words())
        if time.monotonic() < self.deadline:
            return None
        if self.began is None:
            return self._end("timeout", f"killed: not ready after {self.limits.warm_up:g} s")
        return self._end("timeout", f"killed {self.limits.grace:g} s after its limit of {self.limits.of(self.job):g} s")

    def kill(self) -> None:
        """End the process and whatever it has started."""
        if self.process is not None:
            with suppress(ProcessLookupError, PermissionError):  # macOS refuses where only zombies are left
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.connection.close()
            self.errors.close()
        self.process = self.job = None

    def _start(self) -> None:
        self.connection, theirs = Pipe()
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed by kill)
        core = [] if self.core is None else [str(self.core)]
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)  # so that a worker finds what we find
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.worker", str(theirs.fileno()), *core],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a group of its own to kill; Ctrl-C is for us alone
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self.errors,
            )

    def _end(self, status: str, error: str) -> dict[str, Any]:
        began = time.monotonic() if self.began is None else self.began
        outcome = {"status": status, "error": error, "seconds": time.monotonic() - began}
        self.kill()
        return outcome

    def _last_words(self) -> str:
        """How the process ended, and the last line that it wrote to its standard error."""
        try:
            code = self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            return "closed its connection"
        how = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").strip().splitlines()
        return f"{how}: {lines[-1][:500]}" if lines else how


def usable_cores() -> list[int | None]:
    """Their numbers; Nones where the system does not say, and processes cannot be bound."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return [None] * (os.cpu_count() or 1)


def check_seconds(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a finite number of seconds above 0, got {value!r}")
