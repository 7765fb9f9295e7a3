"""What a run prints about its progress: a live bar in a terminal, one line of text per minute anywhere else."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Show = Callable[[int, Mapping[str, float]], None]  # (step, numbers to print)
LINE_EVERY = 60.0  # seconds between two lines if stderr is not a terminal


def progress(total: int, completed: int, silent: bool = False) -> AbstractContextManager[Show]:
    """A context that prints to stderr; call its value after every step.

    Args:
        total: number of steps of the run.
        completed: steps that were taken before.
        silent: print nothing (all processes of a run but the first).
    """
    if silent:
        return nullcontext(lambda step, numbers: None)
    console = Console(stderr=True)
    return _bar(console, total, completed) if console.is_terminal else _lines(total)


@contextmanager
def _bar(console: Console, total: int, completed: int) -> Iterator[Show]:
    columns = (
        BarColumn(20),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[numbers]}"),
    )
    with Progress(*columns, console=console, refresh_per_second=2) as bar:
        task = bar.add_task("", total=total, completed=completed, numbers="")
        yield lambda step, numbers: bar.update(task, completed=step, numbers=_format(numbers))


@contextmanager
def _lines(total: int) -> Iterator[Show]:
    last, due, printed = "", time.monotonic() + LINE_EVERY, True

    def show(step: int, numbers: Mapping[str, float]) -> None:
        nonlocal last, due, printed
        last, printed = f"step {step}/{total}  {_format(numbers)}", False
        if time.monotonic() >= due:
            _print(last)
            due, printed = time.monotonic() + LINE_EVERY, True

    try:
        yield show
    finally:
        if not printed:
            _print(last)


def _print(line: str) -> None:
    """Print to stderr. A run goes on if nobody reads that any more: a pipe or a terminal may be closed."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115 (for whatever else is printed, until the process ends)


def _format(numbers: Mapping[str, float]) -> str:
    return "  ".join(f"{name} {number:.3g}" for name, number in numbers.items())
