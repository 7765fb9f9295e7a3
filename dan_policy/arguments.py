"""Command lines read by tyro: kinds of arguments, and errors of one line.

tyro draws a box around an error and exits with 2; the commands of this project print one line instead.
"""

from __future__ import annotations

import functools
import io
import itertools
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import Any, NoReturn

try:
    import tyro
except ImportError as missing:
    sys.exit(f'mtsp: error: the command needs tyro ({missing}): pip install "mtsp-env[dan]"')
from tyro.conf import Positional, arg
from tyro.constructors import PrimitiveConstructorSpec

from mtsp_env.reading import printable

__all__ = [
    "SECONDS",
    "Positional",
    "arg",
    "check_docstrings",
    "check_working_directory",
    "default",
    "deferred",
    "one_line_errors",
    "open_streams",
    "parse",
    "refuse",
    "whole",
]

Command = Callable[..., Any]


def parse(commands: Sequence[Command], description: str, argv: Sequence[str]) -> Callable[[], None]:
    """The command that ``argv`` names, bound to its arguments.

    Exits with 0 after ``--help``, and with 2 and one line on stderr if the command line is bad.
    """
    app = tyro.extras.SubcommandApp()
    for command in commands:
        summary = (command.__doc__ or "").partition("\n")[0] if argv in ([], ["-h"], ["--help"]) else None
        app.command(name=command.__name__, help=summary)(deferred(command))
    with one_line_errors("mtsp"):
        return app.cli(prog="mtsp", description=description, args=argv, config=(tyro.conf.FlagCreatePairsOff,))


@contextmanager
def one_line_errors(program: str) -> Iterator[None]:
    """A context in which tyro's errors exit with 2 and one line on stderr, ``PROGRAM: error: ...``.

    It is for parsing alone: stderr is caught.
    """
    report = io.StringIO()
    try:
        with redirect_stderr(report):
            yield
    except SystemExit as end:
        if end.code in (None, 0):
            raise
        refuse(_without_box(report.getvalue()), program)


def open_streams() -> None:
    """Let what is printed vanish if the process was started without a standard output or error (``>&-``).

    The next files that such a process opens would take the places of its standard streams, and everything that prints
    there, such as a library in C, would write into them: /dev/null takes the places. Where only some letters can be
    printed, such as ASCII, a question mark takes the place of the others.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the smallest number that is free
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 (open until the process ends)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")


def check_docstrings() -> None:
    """Raise ImportError under ``python -OO``, which drops docstrings: TorchRL cannot be imported then."""
    if sys.flags.optimize > 1:
        raise ImportError("TorchRL cannot be imported without docstrings: run Python without -OO")


def check_working_directory() -> None:
    """Raise FileNotFoundError if the working directory has been removed: MKL would end the process there."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise FileNotFoundError("the working directory is gone: change to one that exists") from None


def refuse(message: str, program: str = "mtsp") -> NoReturn:
    """Exit with 2 and ``message`` as one line on stderr."""
    sys.stderr.write(f"{program}: error: {printable(' '.join(message.split()))}\n")
    sys.exit(2)


def whole(minimum: int, metavar: str, maximum: int = 2**63 - 1) -> Any:
    """An annotation for a whole number from ``minimum`` to ``maximum``."""
    expected = f"a whole number of at least {minimum}"
    if maximum < 2**63 - 1:
        expected = f"a whole number from {minimum} to {maximum}"
    return _number(int, lambda value: minimum <= value <= maximum, expected, metavar)


def default(text: str) -> Any:
    """An annotation for what the help says about an argument's default."""
    return arg(help_behavior_hint=f"(default: {text})")


def _number(convert: Callable[[str], float], valid: Callable[[float], bool], expected: str, metavar: str) -> Any:
    def read(arguments: list[str]) -> float:
        try:
            value = convert(arguments[0])
        except ValueError:
            value = math.nan
        if not valid(value):
            raise ValueError(f"must be {expected}, got {arguments[0]!r}")
        return value

    return PrimitiveConstructorSpec(1, metavar, read, lambda value: True, lambda value: [str(value)])


SECONDS = _number(
    float, lambda value: math.isfinite(value) and value > 0, "a finite number of seconds above 0", "SECONDS"
)
"""An annotation for a time."""


def deferred(command: Command) -> Callable[..., Callable[[], Any]]:
    """tyro calls what it parses: this binds the arguments, so that the command runs after parsing."""

    @functools.wraps(command)
    def bind(*arguments: Any, **options: Any) -> Callable[[], Any]:
        return functools.partial(command, *arguments, **options)

    return bind


def _without_box(report: str) -> str:
    """The message inside the box that tyro draws: the lines between its title and its first ruler.

    Where only ASCII can be printed, there is no box, and another ruler below the title.
    """

    def is_ruler(line: str) -> bool:
        return len(line) > 1 and not line.strip("─-")

    lines = [line.strip("│╭╮╰╯ ") for line in report.splitlines()[1:]]
    return " ".join(itertools.takewhile(lambda line: not is_ruler(line), itertools.dropwhile(is_ruler, lines)))
