"""``python -m benchmarks {run,report,best,aims,speed,clip,view,ablations,curves}``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from benchmarks.suite import SEED

app = tyro.extras.SubcommandApp()


@app.command
def run(
    table: str,
    out: Path,
    methods: tuple[str, ...] = ("nearest", "dan-greedy", "dan-s64", "reference"),
    instances: int | None = None,
    seed: int = SEED,
    seconds: tuple[float, ...] = (1.0,),
    limit: float = 600.0,
    grace: float = 10.0,
    warm_up: float = 300.0,
    workers: int = 1,
    tsplib: Path | None = None,
    cells: tuple[str, ...] = (),
    retry_failed: bool = False,
) -> None:
    """Solve a table's instances with every method, a row of JSON each; rows that are there are not run again.

    Args:
        table: 1, 2, 3, figure4 or smoke.
        out: file of JSON lines to append to.
        methods: names of solvers or groups (dan, all), one by one or joined by commas; package.module:function for one
            of your own.
        instances: of each cell; none: as many as the table says.
        seed: of the instances; best known tours are kept for 7.
        seconds: budgets for solvers that go on for as long as they may, a row for each.
        limit: seconds for the other solvers.
        grace: seconds beyond its budget or limit after which a solver is killed.
        warm_up: seconds to load a solver and solve a tiny instance, which is not counted.
        workers: processes, each with one thread on a core of its own.
        tsplib: folder with the files of table 3.
        cells: labels such as 50x5 or eil51x5; none: all cells of the table.
        retry_failed: run the failed rows of the file again; the newer row counts.
    """
    from benchmarks import run as module
    from benchmarks.crew import Limits

    limits = Limits(limit, grace, warm_up)
    rows = module.run(
        table, methods, out, instances, seed, seconds, limits, workers, tsplib, cells, retry_failed=retry_failed
    )
    print(f"{out}: {len(rows)} new rows, {sum(not row.ok for row in rows)} of them failed")


@app.command
def report(
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path | None = None,
    tsplib: Path | None = None,
    against: str = "dan-s64",
) -> None:
    """Tables in Markdown from results, published numbers beside measured ones, and plots.

    Args:
        files: of ``run``, plain or gzipped.
        out: folder for report.md and the plots; none: the tables are printed.
        tsplib: folder with the files of table 3, to judge its tours and to read the best known ones.
        against: the method that the others are compared with, instance by instance.
    """
    from benchmarks import report as module

    print(module.report(list(files), out, tsplib, against))


@app.command
def best(
    search: float | None = None,
    check: bool = False,
    merge: tuple[Path, ...] = (),
    table: str | None = None,
    instances: int | None = None,
    seed: int = SEED,
    workers: int = 1,
    tsplib: Path | None = None,
) -> None:
    """Best known tours: take better ones from results, look for better ones, verify what is kept; in this order.

    Args:
        search: seconds of the reference solver for each instance, of a table or of all that are kept.
        check: verify the kept tours.
        merge: files of results.
        table: 1, 2, 3, figure4 or smoke; none: every cell that tours are kept of.
        instances: of each cell of the table; none: as many as the table says.
        seed: of the table's instances.
        workers: threads of the search.
        tsplib: folder with the files of table 3.
    """
    from benchmarks import best as module
    from benchmarks import rows, suite

    if search is None and not check and not merge:
        raise ValueError("say what to do: --merge FILES, --search SECONDS or --check")
    for file in merge:
        print("\n".join(module.merge_rows(rows.read(file), tsplib)))

    def chosen() -> list[tuple[suite.AnyCell, int]]:
        if table is None:
            return module.kept_cells(tsplib)
        return [(cell, seed) for cell in suite.cells(table, tsplib, instances)]

    if search is not None:
        for cell, its_seed in chosen():
            print(module.search(cell, its_seed, search, workers))
    if check:
        for cell, its_seed in chosen():
            print(module.check(cell, its_seed))


@app.command
def aims(
    instances: int = 50,
    cells: tuple[str, ...] = (),
    best_seconds: float | None = None,
    sample: int = 0,
    sample_seconds: float = 600.0,
    workers: int = 1,
    seed: int = SEED,
    out: Path | None = None,
) -> None:
    """The reference solver's mean gap within milliseconds to seconds, against what is aimed at.

    Args:
        instances: in each cell, at least 2.
        cells: labels of aims, such as 50x5; none: all.
        best_seconds: of a long run on each instance first, where it had none as long; none: no long runs.
        sample: so many instances of each cell that are not proved optimal are run for far longer (0 or at least 2), to
            tell what that takes off the best known tours; runs that were done before are not done again.
        sample_seconds: of these far longer runs.
        workers: long runs side by side.
        seed: of the instances.
        out: file for the table; none: benchmarks/results/aims.md.
    """
    from benchmarks import aims as module

    given = {"cells": cells} if cells else {}
    given |= {"out": out} if out else {}
    given |= {"best_seconds": best_seconds, "sample": sample, "sample_seconds": sample_seconds}
    module.main(instances, workers=workers, seed=seed, **given)


@app.command
def speed(
    device: str = "cpu",
    seconds: float = 3.0,
    train: bool = False,
    solve: bool = False,
    precision: Literal["float32", "bfloat16"] = "float32",
) -> None:
    """Decisions and instances per second of environments, networks and trainer on this machine.

    Args:
        device: cpu or cuda.
        seconds: of measuring, for each row.
        train: rollouts, imitation and REINFORCE at n = 20, 50, 100 and 200 instead, with their share of the FLOP rate.
        solve: time and memory of plans with the shipped model on the CPU instead.
        precision: of `train`.
    """
    if solve:
        from benchmarks import speed_solve

        speed_solve.main()
        return
    if train:
        from benchmarks import speed_train

        speed_train.main(device, seconds, precision)
        return
    from benchmarks import speed as module

    module.main(device, seconds)


@app.command
def clip(
    sizes: tuple[str, ...] = (),
    instances: int = 6,
    samples: int = 64,
    policy: str = "default",
    augment: bool = False,
    out: Path | None = None,
) -> None:
    """Makespans of samples over C, how surely they are drawn, on instances of no test: results/clip.md.

    Args:
        sizes: such as 50x5; none: five from 50x5 to 200x10.
        instances: of each size, at least 2.
        samples: of each plan.
        policy: a shipped model or a file of weights.
        augment: see the instances in the square's eight symmetries.
        out: file for the table; none: benchmarks/results/clip.md.
    """
    from benchmarks import scan

    given = {"sizes": sizes} if sizes else {}
    given |= {"out": out} if out else {}
    scan.clip(instances=instances, samples=samples, policy=policy, augment=augment, **given)


@app.command
def view(
    sizes: tuple[str, ...] = (),
    instances: int = 8,
    samples: int | None = None,
    policy: str = "default",
    out: Path | None = None,
) -> None:
    """Makespans and times over how many cities agents see, on instances of no test: results/view.md.

    Args:
        sizes: such as 500x10; none: four from 200x10 to 1000x10.
        instances: of each size, at least 2.
        samples: of each plan; none: greedy plans.
        policy: a shipped model or a file of weights.
        out: file for the table; none: benchmarks/results/view.md.
    """
    from benchmarks import scan

    given = {"sizes": sizes} if sizes else {}
    given |= {"out": out} if out else {}
    scan.view(instances=instances, samples=samples, policy=policy, **given)


@app.command
def ablations(minutes: float = 15.0, folder: Path = Path("runs/ablations"), seed: int = 0) -> None:
    """Variants of DAN and of its training, each trained for the same time on one thread: results/ablations.md.

    Args:
        minutes: of each variant.
        folder: of the runs; variants that have a verdict there are not trained again.
        seed: of the training.
    """
    from benchmarks import ablations as module

    module.main(minutes, folder, seed)


@app.command
def curves(minutes: float = 30.0, folder: Path = Path("runs/curves")) -> None:
    """REINFORCE from scratch beside imitation, n = 20, m = 3: results/curves.csv and curves.png.

    Args:
        minutes: of each.
        folder: of the runs, which are resumed.
    """
    from benchmarks import curves as module

    module.main(minutes, folder)


def main(argv: list[str] | None = None) -> int:
    """Exit code 2 and one line on bad input, 130 on Ctrl-C."""
    try:
        app.cli(prog="python -m benchmarks", args=argv)
    except (ValueError, OSError) as error:
        print(f"benchmarks: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("benchmarks: interrupted; the same command goes on where it stopped", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
