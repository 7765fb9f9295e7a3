"""``python -m benchmarks report``: the paper's tables, measured and published numbers side by side, and plots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.files import write_text
from benchmarks.harness.rows import Row
from benchmarks.reports import plots, statistics, tables
from benchmarks.reports.statistics import Results

FULL_SHARE = 0.9  # of a core; a solver on a quiet machine has more
SHORT = 0.3  # seconds; the CPU share of shorter solves means little

TITLES = {
    "1": "Table 1: uniform instances, n up to 200",
    "2": "Table 2: uniform instances, n from 500 on",
    "3": "Table 3: TSPLIB",
    "figure4": "Figure 4: planning time at m = 5",
    "seed3333": "The public test set, seed 3333",
    "smoke": "Smoke test",
}


def report(
    files: tuple[Path, ...], /, out: Path | None = None, tsplib: Path | None = None, against: str = "dan-s64"
) -> str:
    """Report results as tables in Markdown, measured and published numbers side by side, and as plots.

    Args:
        files: files of results, plain or gzipped.
        out: folder for report.md and the plots; by default the tables are printed.
        tsplib: folder with the TSPLIB files of table 3, to check its tours and to compare with the best known ones.
        against: method that the others are compared with, instance by instance.

    Returns:
        The tables; with ``out``, the names of the written files.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: no files, or as ``statistics.load``.
    """
    if not files:
        raise ValueError("name at least one file of results")
    all_results = statistics.load(files, tsplib)
    if out is None:
        return "\n".join(_lines(all_results, files, against, {}))
    out.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for results in all_results:
        draw = plots.planning_time if results.table == "figure4" else plots.gaps
        pictures[results.table] = f"{draw.__name__.replace('_', '-')}-{results.table}.png"
        draw(results, out / pictures[results.table])
    write_text(out / "report.md", "\n".join(_lines(all_results, files, against, pictures)))
    return "\n".join(str(out / name) for name in ["report.md", *pictures.values()])


def _lines(all_results: Sequence[Results], files: Sequence[Path], against: str, pictures: dict[str, str]) -> list[str]:
    lines = ["# Results", "", *_origin(all_results, files)]
    for results in all_results:
        title = TITLES.get(results.table, f"Table {results.table}")
        lines += ["", f"## {title}", "", *tables.section(results, against)]
        if results.table in pictures:
            lines += ["", f"![{title}]({pictures[results.table]})"]
    return [*lines, ""]


def _origin(all_results: Sequence[Results], files: Sequence[Path]) -> list[str]:
    """Where the results come from: files, machines and versions."""
    rows = [row for results in all_results for row in results.all_rows()]
    machines = Counter(
        f"{m.get('processor')}, {m.get('cores')} cores, {m.get('platform')}, Python {m.get('python')}"
        for m in (row.machine for row in rows)
    )
    versions = sorted({f"{name} {version}" for row in rows for name, version in row.versions.items()})
    seeds = sorted({row.seed for row in rows})
    return [
        f"From {', '.join(file.name for file in files)}: {len(rows)} rows, test set seed {', '.join(map(str, seeds))}. "
        "Every solver has one thread. ± is the standard error of the mean. Superscripts refer to the notes below a "
        "table. *Published* numbers are those of the papers, measured on other machines and, except for the public "
        "test set, on other instances of the same kind. The *bound* is the trip to the farthest city and back: no "
        "makespan is smaller.",
        "",
        *(f"- {machine}: {count} rows" for machine, count in machines.most_common()),
        f"- {', '.join(versions)}",
        *_busy_machine(rows),
    ]


def _busy_machine(rows: Sequence[Row]) -> list[str]:
    """A line if solvers did not have their cores to themselves: their wall and CPU times should agree."""
    timed = [row for row in rows if row.ok and row.cpu_seconds is not None and row.seconds > SHORT]
    slowed = sum(row.cpu_seconds < FULL_SHARE * row.seconds for row in timed)
    if not slowed:
        return []
    return [f"- {slowed} of {len(timed)} solves had less than {FULL_SHARE:.0%} of a core: the machine was not quiet"]
