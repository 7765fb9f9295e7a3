"""A queue of plans with deadlines, for the service: a fixed number of threads, a bounded number of requests."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import TypeVar

from mtsp_env.checks import check_count

T = TypeVar("T")
LEAST_SECONDS = 0.005  # a plan that would get less time than this is not begun
MARGIN = 0.2  # share of the time until a deadline that is kept for handing the result over, but at most
GREATEST_MARGIN = 0.05  # seconds
USED = 0.8  # share of a plan's time that the search gets; the rest is for its preparation, which ignores the clock


class Overloaded(Exception):
    """As many requests as the queue holds are waiting or being planned."""


class Late(Exception):
    """The deadline has passed before the plan was ready."""


class PlanQueue:
    """Runs plans on threads in the order in which they came, and shares the time among those that wait.

    A plan is a function of the seconds that it may take. When one begins, the time until the deadlines is shared out:
    it gets the longest time with which, if all others took as long, every waiting plan would still be ready in time.
    So a single plan has all its time, and a hundred at once have a hundredth each instead of being late.

    Args:
        threads: plans that run at the same time, at least 1.
        capacity: plans that wait or run at the same time, at least 1.
    """

    def __init__(self, threads: int, capacity: int):
        check_count("threads", threads, minimum=1)
        check_count("capacity", capacity, minimum=1)
        self.threads, self.capacity = threads, capacity
        self._executor = ThreadPoolExecutor(threads, thread_name_prefix="plan")
        self._lock = Lock()
        self._deadlines: deque[float] = deque()  # when the waiting plans should end, in their order
        self._running = 0

    @property
    def size(self) -> int:
        """How many plans wait or run."""
        with self._lock:
            return len(self._deadlines) + self._running

    async def run(self, plan: Callable[[float], T], deadline: float) -> T:
        """The result of ``plan(seconds)``, at the latest at ``deadline`` (of ``time.monotonic``).

        A plan that is late keeps its place and its thread until it ends, so that the queue never holds more than
        ``capacity``.

        Raises:
            Late: the deadline has passed, or is too near to begin.
            Overloaded: the queue is full.
        """
        left = deadline - time.monotonic()
        with self._lock:
            if len(self._deadlines) + self._running >= self.capacity:
                raise Overloaded
            self._deadlines.append(deadline - min(MARGIN * left, GREATEST_MARGIN))
            future = asyncio.wrap_future(self._executor.submit(self._begin, plan))
        done, _ = await asyncio.wait({future}, timeout=deadline - time.monotonic())
        if not done:
            future.add_done_callback(_ignore)
            raise Late
        return future.result()

    def close(self) -> None:
        """Begin no more plans; those that run go on to their end."""
        self._executor.shutdown(wait=False, cancel_futures=True)

    def _begin(self, plan: Callable[[float], T]) -> T:
        """On a thread: the plan whose turn it is. The executor starts plans in the order of ``_deadlines``."""
        with self._lock:
            seconds = fair_share(self._deadlines, time.monotonic(), self.threads)
            self._deadlines.popleft()
            self._running += 1
        try:
            if seconds is None:
                raise Late
            return plan(USED * seconds)
        finally:
            with self._lock:
                self._running -= 1


def fair_share(deadlines: deque[float], now: float, threads: int) -> float | None:
    """Seconds for the first of the waiting plans; None if its own deadline is too near.

    The largest s such that, if every plan takes s, plan k ends by its deadline: k rounds up to a whole number of rounds
    of ``threads`` plans. Plans that even ``LEAST_SECONDS`` for everybody would not save do not count.
    """
    if deadlines[0] - now < LEAST_SECONDS:
        return None
    share, position = math.inf, 0
    for deadline in deadlines:
        seconds = (deadline - now) / math.ceil((position + 1) / threads)
        if seconds >= LEAST_SECONDS:
            share, position = min(share, seconds), position + 1
    return share


def _ignore(future: asyncio.Future) -> None:
    """Take note of an error that nobody waits for any more, which asyncio would log."""
    if not future.cancelled():
        future.exception()
