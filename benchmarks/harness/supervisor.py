"""Runs jobs in worker processes, each with one thread on a core of its own.

A worker that takes too long is killed with all its children; one that crashes is replaced. The job's outcome says so.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from multiprocessing.connection import Pipe, wait
from typing import Any

from benchmarks.harness.jobs import Job, Limits
from benchmarks.harness.processes import kill_descendants
from benchmarks.harness.worker import READY

LONGEST_WAIT = 3600.0  # seconds; operating systems cannot wait for any time
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


def run_jobs(jobs: Sequence[Job], limits: Limits, cores: Sequence[int]) -> Iterator[tuple[Job, dict[str, Any]]]:
    """Yield each job with its outcome as it ends; one worker per core. Closing the iterator kills the workers."""
    waiting, workers = deque(jobs), [WorkerProcess(core, limits) for core in cores]
    try:
        while True:
            for worker in workers:
                if worker.job is None and waiting:
                    worker.begin(waiting.popleft())
            busy = [worker for worker in workers if worker.job is not None]
            if not busy:
                return
            deadline = min(worker.deadline for worker in busy)
            left = min(max(deadline - time.monotonic(), 0.0), LONGEST_WAIT)
            wait([worker.connection for worker in busy], timeout=left)
            for worker in busy:
                job, outcome = worker.job, worker.poll()
                if outcome is not None:
                    yield job, outcome
    finally:
        for worker in workers:
            worker.kill()


class WorkerProcess:
    """The supervisor's side of a worker: starts the process if needed, kills it with all its children.

    Attributes:
        job: the job that it is working on, or None.
        deadline: time (``time.monotonic``) after which it is killed.
    """

    def __init__(self, core: int, limits: Limits) -> None:
        self.core, self.limits = core, limits
        self.process: subprocess.Popen | None = None
        self.job: Job | None = None

    def begin(self, job: Job) -> None:
        """Send a job to the process."""
        if self.process is None:
            self._start()
        self.job, self.began = job, None
        self.deadline = time.monotonic() + self.limits.warm_up
        seconds = self.limits.limit if job.budget is None else job.budget
        with suppress(OSError):  # ``poll`` notices a dead process
            self.connection.send((job.method, job.instance, seconds, job.seed + job.number))

    def poll(self) -> dict[str, Any] | None:
        """The outcome of the job, or None while it runs. A worker past its deadline is killed."""
        try:
            while self.connection.poll():
                message = self.connection.recv()
                if message != READY:
                    self.job = None
                    return message
                self.began = time.monotonic()
                self.deadline = self.began + self.limits.seconds(self.job) + self.limits.grace
        except (EOFError, OSError):
            return self._fail("crash", self._last_words())
        if time.monotonic() < self.deadline:
            return None
        if self.began is None:
            return self._fail("timeout", f"killed: not ready after {self.limits.warm_up:g} s")
        limit = self.limits.seconds(self.job)
        return self._fail("timeout", f"killed {self.limits.grace:g} s after its limit of {limit:g} s")

    def kill(self) -> None:
        """Kill the process and all its descendants."""
        if self.process is not None:
            with suppress(ProcessLookupError, PermissionError):  # macOS refuses if only zombies are left
                os.kill(self.process.pid, signal.SIGSTOP)  # it starts no more processes
                kill_descendants(self.process.pid)
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.connection.close()
            self.errors.close()
        self.process = self.job = None

    def _start(self) -> None:
        self.connection, theirs = Pipe()
        self.errors = tempfile.TemporaryFile()  # noqa: SIM115 (closed by kill)
        path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)  # workers import what this process can
        core = [str(self.core)] if hasattr(os, "sched_setaffinity") else []
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.harness.worker", str(theirs.fileno()), *core],
                env={**os.environ, **ONE_THREAD, "PYTHONPATH": path},
                pass_fds=[theirs.fileno()],
                start_new_session=True,  # a process group to kill; Ctrl-C reaches the supervisor alone
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self.errors,
            )

    def _fail(self, status: str, error: str) -> dict[str, Any]:
        """Kill the process; returns the outcome of its job."""
        began = time.monotonic() if self.began is None else self.began
        outcome = {"status": status, "error": error, "seconds": time.monotonic() - began}
        self.kill()
        return outcome

    def _last_words(self) -> str:
        """How the process ended, and the last line of its standard error."""
        try:
            code = self.process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            return "closed its connection"
        reason = f"exit code {code}" if code >= 0 else f"killed by {signal.Signals(-code).name}"
        self.errors.seek(0)
        lines = self.errors.read().decode(errors="replace").strip().splitlines()
        return f"{reason}: {lines[-1][:500]}" if lines else reason
