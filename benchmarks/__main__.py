"""``python -m benchmarks COMMAND``; ``--help`` lists the commands, ``COMMAND --help`` their options."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import tyro

from benchmarks.solvers import Unavailable
from dan_policy.arguments import check_docstrings, check_working_directory, deferred, one_line_errors, open_streams
from mtsp_env.reading import printable

# Only the module of the chosen command is imported: some need packages that others do without
COMMANDS = {
    "run": "benchmarks.harness.run:run",
    "report": "benchmarks.reports.report:report",
    "best": "benchmarks.best_known:main",
    "reference-gaps": "benchmarks.studies.reference_gaps:main",
    "optima": "benchmarks.studies.optima:main",
    "libraries": "benchmarks.studies.libraries:main",
    "speed": "benchmarks.studies.speed:main",
    "leaderboard": "benchmarks.leaderboard.board:leaderboard",
    "submit": "benchmarks.leaderboard.submit:submit",
    "memory": "benchmarks.studies.memory:main",
    "sweep-clip": "benchmarks.studies.sweeps:sweep_clip",
    "sweep-view": "benchmarks.studies.sweeps:sweep_view",
    "sweep-confidence": "benchmarks.studies.sweeps:sweep_confidence",
    "sweep-search": "benchmarks.studies.sweeps:sweep_search",
    "ablations": "benchmarks.studies.ablations:main",
    "worlds": "benchmarks.studies.worlds:main",
    "curves": "benchmarks.studies.curves:main",
}


def load(name: str) -> Callable[..., Any]:
    """The function of a command."""
    module, _, function = COMMANDS[name].partition(":")
    try:
        return getattr(import_module(module), function)
    except TypeError:
        check_docstrings()
        raise


def main(argv: list[str] | None = None) -> int:
    """Run a command and print what it returns; exit code 2 and one line on bad input, 130 on Ctrl-C."""
    open_streams()
    argv = sys.argv[1:] if argv is None else argv
    try:
        check_working_directory()
        with one_line_errors("benchmarks"):
            if argv and argv[0] in COMMANDS:
                prog = f"python -m benchmarks {argv[0]}"
                chosen = tyro.cli(deferred(load(argv[0])), prog=prog, args=argv[1:])
            else:
                commands = {name: deferred(load(name)) for name in COMMANDS}
                chosen = tyro.extras.subcommand_cli_from_dict(commands, prog="python -m benchmarks", args=argv)
        result = chosen()
        if result is not None:
            print(result)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output, such as `head`, has closed it
        return 1
    except (ValueError, OSError, ImportError, Unavailable) as error:
        return _refuse(str(error))
    except MemoryError as error:
        return _refuse(f"out of memory: {error}")
    except KeyboardInterrupt:
        print("benchmarks: interrupted; the same command resumes", file=sys.stderr)
        return 130
    return 0


def _refuse(message: str) -> int:
    print(f"benchmarks: error: {printable(' '.join(message.split()))}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
