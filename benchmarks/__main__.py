"""``python -m benchmarks {speed,gap,best}``."""

from __future__ import annotations

import sys
from pathlib import Path

import tyro

from benchmarks.suite import SEED

app = tyro.extras.SubcommandApp()


@app.command
def speed(device: str = "cpu", seconds: float = 3.0) -> None:
    """Decisions and instances per second of environments, networks and trainer on this machine.

    Args:
        device: cpu or cuda.
        seconds: of measuring, for each row.
    """
    from benchmarks import speed as module

    module.main(device, seconds)


@app.command
def gap(
    set: str = "first",
    methods: tuple[str, ...] = ("random", "nearest", "dan-greedy", "dan-s64", "reference"),
    seconds: float = 0.1,
    seed: int = SEED,
    out: Path | None = None,
    plot: Path | None = None,
) -> None:
    """Gap of methods to the best known tours of a test set, as a Markdown table.

    Args:
        set: name of the test set.
        methods: names of solvers.
        seconds: for each instance, where a solver goes on for as long as it may.
        seed: of the set's instances; best known tours are kept for 7.
        out: file for the table, beside the terminal.
        plot: file for a picture of gap against time.
    """
    from benchmarks import table

    found = table.gaps(set, list(methods), seed, seconds)
    text = table.markdown(set, found)
    print(text)
    if out is not None:
        out.write_text(f"Set {set!r}, seed {seed}; mean gap ± standard error.\n\n{text}\n")
    if plot is not None:
        table.plot(set, found, plot)


@app.command
def best(set: str = "first", seed: int = SEED, search: float | None = None) -> None:
    """Verify the best known tours of a test set, or look for better ones.

    Args:
        set: name of the test set.
        seed: of the set's instances.
        search: seconds of the reference solver for each instance; none: only verify.
    """
    from benchmarks import best as module

    if search is not None:
        module.search(set, seed, search)
    print(module.check(set, seed))


def main(argv: list[str] | None = None) -> int:
    """Exit code 2 and one line on bad input."""
    try:
        app.cli(prog="python -m benchmarks", args=argv)
    except (ValueError, OSError) as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
