"""Ctrl-C (SIGINT), SIGTERM and a closed terminal (SIGHUP): a command ends with exit code 130, 143 or 129, and a run
saves first.

This module imports nothing heavy, so that ``python -m train`` can handle signals while it imports the rest.
"""

from __future__ import annotations

import math
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
AT_ONCE = 3.0  # seconds


def exit_on_signals() -> None:
    """From now on, ``ENDING`` signals end the process with one line on stderr and exit code 128 + number.

    They raise SystemExit, so that ``finally`` clauses run. SIGHUP stays ignored if it is, as ``nohup`` has it.
    """

    def end(number: int, _frame: object) -> None:
        with suppress(OSError):  # a terminal that has been closed
            print(f"train: ended by {signal.Signals(number).name}", file=sys.stderr)
        sys.exit(128 + number)

    for number in ENDING:
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, end)


@contextmanager
def postponed(*numbers: int) -> Iterator[list[int]]:
    """Collect signals; after the block, the first is raised again for the handler that was there before.

    A second Ctrl-C does not wait for the end of the block, unless it comes at once: torchrun sends its processes the
    signal that all of them have already got from a terminal or a job scheduler. Signals that are ignored stay so.

    >>> with postponed(signal.SIGINT) as caught:
    ...     while not caught:
    ...         work()
    """
    caught: list[int] = []
    first = math.inf  # time of the first signal

    def collect(number: int, _frame: object) -> None:
        nonlocal first
        caught.append(number)
        first = min(first, time.monotonic())
        if number == signal.SIGINT and time.monotonic() > first + AT_ONCE:
            restore()
            signal.raise_signal(number)

    def restore() -> None:
        for number, handler in old.items():
            signal.signal(number, handler)

    heeded = [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]
    old = {number: signal.signal(number, collect) for number in heeded}
    try:
        yield caught
    finally:
        restore()
    if caught:
        signal.raise_signal(caught[0])
