"""``python -m benchmarks COMMAND``; ``--help`` lists the commands, ``COMMAND --help`` their options."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any

import tyro

# Only the module of the chosen command is imported: some need packages that others do without
COMMANDS = {
    "run": "benchmarks.harness.run:run",
    "report": "benchmarks.reports.report:report",
    "best": "benchmarks.best_known:main",
    "reference-gaps": "benchmarks.studies.reference_gaps:main",
    "optima": "benchmarks.studies.optima:main",
    "libraries": "benchmarks.studies.libraries:main",
    "speed": "benchmarks.studies.speed:main",
    "memory": "benchmarks.studies.memory:main",
    "sweep-clip": "benchmarks.studies.sweeps:sweep_clip",
    "sweep-view": "benchmarks.studies.sweeps:sweep_view",
    "ablations": "benchmarks.studies.ablations:main",
    "curves": "benchmarks.studies.curves:main",
}


def load(name: str) -> Callable[..., Any]:
    """The function of a command."""
    module, _, function = COMMANDS[name].partition(":")
    return getattr(import_module(module), function)


def main(argv: list[str] | None = None) -> int:
    """Run a command and print what it returns; exit code 2 and one line on bad input, 130 on Ctrl-C."""
    argv = sys.argv[1:] if argv is None else argv
    try:
        if argv and argv[0] in COMMANDS:
            prog = f"python -m benchmarks {argv[0]}"
            result = tyro.cli(load(argv[0]), prog=prog, args=argv[1:])
        else:
            commands = {name: load(name) for name in COMMANDS}
            result = tyro.extras.subcommand_cli_from_dict(commands, prog="python -m benchmarks", args=argv)
    except (ValueError, OSError) as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("benchmarks: interrupted; the same command resumes", file=sys.stderr)
        return 130
    if result is not None:
        print(result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
