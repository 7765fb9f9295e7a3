"""Ctrl-C (SIGINT) and SIGTERM: a command ends with exit code 130 or 143, and a run saves first.

This module imports nothing heavy, so that ``python -m train`` can handle signals while it imports the rest.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager


def exit_on_signals() -> None:
    """From now on, SIGINT and SIGTERM end the process with one line on stderr and exit code 130 or 143.

    They raise SystemExit, so that ``finally`` clauses run.
    """

    def end(number: int, _frame: object) -> None:
        print(f"train: ended by {signal.Signals(number).name}", file=sys.stderr)
        sys.exit(128 + number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)


@contextmanager
def postponed(*numbers: int) -> Iterator[list[int]]:
    """Collect signals; after the block, the first is raised again for the handler that was there before.

    A second signal does not wait for the end of the block.

    >>> with postponed(signal.SIGINT) as caught:
    ...     while not caught:
    ...         work()
    """
    caught: list[int] = []

    def collect(number: int, _frame: object) -> None:
        caught.append(number)
        if len(caught) > 1:
            restore()
            signal.raise_signal(number)

    def restore() -> None:
        for number, handler in old.items():
            signal.signal(number, handler)

    old = {number: signal.signal(number, collect) for number in numbers}
    try:
        yield caught
    finally:
        restore()
    if caught:
        signal.raise_signal(caught[0])
