"""``python -m benchmarks report``: the paper's tables in Markdown, published beside measured numbers, and plots."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from benchmarks import plots
from benchmarks.files import replace_text
from benchmarks.rows import Row
from benchmarks.solvers.exact import PROVED
from benchmarks.stats import Mean, Paired, Results, load, mean
from benchmarks.suite import TsplibCell

PUBLISHED = Path(__file__).with_name("published.json")
FULL_SHARE = 0.9  # of a core, where a solver has one to itself
SHORT = 0.3  # seconds below which the shares say nothing

TITLES = {
    "1": "Table 1: uniform instances, n up to 200",
    "2": "Table 2: uniform instances, n from 500 on",
    "3": "Table 3: TSPLIB",
    "figure4": "Figure 4: planning time at m = 5",
    "smoke": "Smoke test",
}

# Published methods stand before the first of ours that is meant to be the same
COUNTERPARTS = {
    "DAN greedy": "dan-greedy",
    "DAN s.64": "dan-s64",
    "DAN s.256": "dan-s256",
    "OR-Tools": "ortools",
    "OR-Tools (600 s)": "ortools",
    "LKH3": "lkh3",
    "Gurobi": "exact",
    "EA": "ea",
    "SOM": "som",
}


def report(files: Sequence[Path], out: Path | None = None, tsplib: Path | None = None, against: str = "dan-s64") -> str:
    """The tables of the files' rows in Markdown; with a folder ``out``, what was written there instead.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: no files, or as ``stats.load``.
    """
    if not files:
        raise ValueError("name at least one file of results")
    found = load(files, tsplib)
    if out is None:
        return "\n".join(_lines(found, files, against, {}))
    out.mkdir(parents=True, exist_ok=True)
    pictures = {}
    for results in found:
        draw = plots.planning_time if results.table == "figure4" else plots.gaps
        pictures[results.table] = f"{draw.__name__.replace('_', '-')}-{results.table}.png"
        draw(results, out / pictures[results.table])
    replace_text(out / "report.md", "\n".join(_lines(found, files, against, pictures)))
    return "\n".join(str(out / name) for name in ["report.md", *pictures.values()])


def _lines(found: Sequence[Results], files: Sequence[Path], against: str, pictures: dict[str, str]) -> list[str]:
    lines = ["# Results", "", *_origin(found, files)]
    for results in found:
        lines += ["", f"## {TITLES[results.table]}", "", *_table(results, against)]
        if results.table in pictures:
            lines += ["", f"![{TITLES[results.table]}]({pictures[results.table]})"]
    return [*lines, ""]


def _origin(found: Sequence[Results], files: Sequence[Path]) -> list[str]:
    """What was run where."""
    rows = [row for results in found for row in results.every()]
    machines = Counter(
        f"{m.get('processor')}, {m.get('cores')} cores, {m.get('platform')}, Python {m.get('python')}"
        for m in (row.machine for row in rows)
    )
    versions = sorted({f"{name} {version}" for row in rows for name, version in row.versions.items()})
    seeds = sorted({row.seed for row in rows})
    return [
        f"From {', '.join(file.name for file in files)}: {len(rows)} rows, test set seed {', '.join(map(str, seeds))}. "
        "Every solver has one thread; ± is the standard error of the mean; superscripts lead to the notes that end a "
        "table. *Published* numbers are those of the papers: other instances of the same kind, another machine.",
        "",
        *(f"- {machine}: {count} rows" for machine, count in machines.most_common()),
        f"- {', '.join(versions)}",
        *_starved(rows),
    ]


def _starved(rows: Sequence[Row]) -> list[str]:
    """Whether solvers had their cores to themselves: they wait for nothing else, so wall and CPU time should agree."""
    timed = [row for row in rows if row.ok and row.cpu_seconds is not None and row.seconds > SHORT]
    starved = sum(row.cpu_seconds < FULL_SHARE * row.seconds for row in timed)
    if not starved:
        return []
    return [f"- {starved} of {len(timed)} solves had less than {FULL_SHARE:.0%} of a core: the machine was not quiet"]


def _table(results: Results, against: str) -> list[str]:
    """Every table of one of the paper's, with its notes."""
    notes = Notes(results)
    tsplib = any(isinstance(cell, TsplibCell) for cell in results.cells)
    lines = []
    if tsplib:
        rounded = _measured(results, notes, lambda row: row.rounded_length, ".0f")
        exact = _measured(results, notes, lambda row: row.length, ".1f")
        lines += ["### Longest tour, every leg rounded as TSPLIB does (so are the published ones)", ""]
        lines += _grid(results, _beside(results, rounded, "cost"))
        lines += ["", "### Longest tour, not rounded", "", *_grid(results, exact)]
    else:
        costs = _measured(results, notes, lambda row: row.makespan, ".3f")
        lines += ["### Makespan", "", *_grid(results, _beside(results, costs, "cost", ".2f"))]
    lines += ["", "### Gap to the best known tours of the same instances, %", "", *_gaps(results, notes)]
    seconds = _measured(results, notes, lambda row: row.seconds, ".3g", error=False)
    lines += ["", "### Seconds", "", *_grid(results, _beside(results, seconds, "seconds"))]
    if against in results.labels:
        lines += ["", f"### Against {against}, instance by instance", "", *_against(results, against)]
    else:
        lines += ["", f"There are no rows of {against} to compare the others with."]
    if any(row.bound is not None for row in results.every()):
        lines += ["", "### Proved", "", *_proved(results)]
    return lines + notes.lines()


class Notes:
    """Why a cell has no number, or one of fewer instances than the others: said once, below the table."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.texts: list[str] = []

    def mark(self, label: str, cell: str) -> str:
        """A superscript, or nothing where every instance has right tours."""
        rows, wanted = self.results.rows[label].get(cell, {}), self.results.instances(cell)
        failed = Counter((row.status, row.error) for row in rows.values() if not row.ok)
        said = [f"{count} × {status}: {_one_line(error)}" for (status, error), count in failed.most_common(3)]
        if len(failed) > 3:
            said.append(f"{sum(failed.values()) - sum(n for _, n in failed.most_common(3))} more failed")
        if len(rows) < len(wanted):
            said.append(f"{len(wanted) - len(rows)} not run")
        if not said:
            return ""
        text = f"of {len(wanted)}: {'; '.join(said)}"
        if text not in self.texts:
            self.texts.append(text)
        return f"<sup>{self.texts.index(text) + 1}</sup>"

    def lines(self) -> list[str]:
        """The notes, and what else must be said of the table."""
        more = []
        if any(isinstance(cell, TsplibCell) and cell.paper_name for cell in self.results.cells):
            more.append(
                "The paper prints gtsp150's costs under the name kroa150: from the first node of TSPLIB's kroA150 the "
                "trip to the farthest city and back alone is 5395."
            )
        if self.results.unkept:
            total = sum(len(known) for known in self.results.best.values())
            more.append(
                f"For {self.results.unkept} of {total} instances the best known tours are those of these rows alone: "
                "none are kept, or the TSPLIB files to judge them by were not given."
            )
        return ["", *(f"{i}. {text}" for i, text in enumerate(self.texts, 1))] * bool(self.texts) + [
            line for text in more for line in ("", text)
        ]


def _one_line(text: str | None) -> str:
    line = " ".join((text or "").split()).replace("|", "/")
    return line if len(line) <= 160 else f"{line[:157]}..."


def _grid(results: Results, body: Iterable[tuple[str, Sequence[str]]], *more: str) -> list[str]:
    """A Markdown table: a column for each cell, and ``more``."""
    heads = [f"{cell.heading} ({len(results.instances(cell.label))})" for cell in results.cells]
    what = "file, m" if any(isinstance(cell, TsplibCell) for cell in results.cells) else "n, m"
    lines = [f"| {what} (instances) | {' | '.join([*heads, *more])} |", "|---" * (len(heads) + len(more) + 1) + "|"]
    return lines + [f"| {name} | {' | '.join(columns)} |" for name, columns in body]


def _measured(
    results: Results, notes: Notes, value: Callable[[Row], float], style: str, error: bool = True
) -> list[tuple[str, list[str]]]:
    """A line for each method: the mean of its right tours in each cell."""
    body = []
    for label in results.labels:
        columns = []
        for cell in results.cells:
            found = mean([value(row) for row in results.right(label, cell.label).values()])
            columns.append(_number(found, style, error) + notes.mark(label, cell.label))
        body.append((label, columns))
    return body


def _number(found: Mean | None, style: str, error: bool = True) -> str:
    if found is None:
        return "-"
    text = format(found.mean, style)
    return f"{text} ± {format(found.error, style)}" if error and found.error is not None else text


def _beside(
    results: Results, body: list[tuple[str, list[str]]], field: str, style: str = "g"
) -> list[tuple[str, list[str]]]:
    """``body`` with the published methods before their counterparts, those without one first."""
    waiting: dict[str | None, list[tuple[str, list[str]]]] = {}
    for name, columns in _published(results, field, style).items():
        counterpart = COUNTERPARTS.get(name.partition(",")[0])
        waiting.setdefault(counterpart if counterpart in results.methods() else None, []).append((f"*{name}*", columns))
    lines = waiting.pop(None, [])
    measured = dict(body)
    for method, labels in results.methods().items():
        lines += waiting.pop(method, []) + [(label, measured[label]) for label in labels]
    return lines


def _published(results: Results, field: str, style: str) -> dict[str, list[str]]:
    """Name -> what the papers print for the cells; methods without a number are left out."""
    data = json.loads(PUBLISHED.read_text(encoding="utf-8"))
    table = data.get(f"table{results.table}")
    if table is None:
        return {}
    sources = [(table, "published")]
    if results.table == "1":
        sources.append((data["later"], "Kim et al. 2022"))
    found = {}
    for source, who in sources:
        for name, numbers in source.items():
            if isinstance(numbers, dict) and field in numbers:
                by_cell = {tuple(c): number for c, number in zip(table["cells"], numbers[field], strict=True)}
                columns = [by_cell.get(tuple(cell.printed)) for cell in results.cells]
                if any(number is not None for number in columns):
                    found[f"{name}, {who}"] = ["" if number is None else format(number, style) for number in columns]
    return found


def _gaps(results: Results, notes: Notes) -> list[str]:
    """Per cent, per cell and over all instances together."""
    body = []
    for label in results.labels:
        by_cell = [[100 * gap for gap in results.gaps(label, cell.label).values()] for cell in results.cells]
        columns = [
            _number(mean(gaps), ".2f") + notes.mark(label, cell.label)
            for gaps, cell in zip(by_cell, results.cells, strict=True)
        ]
        everything = [gap for gaps in by_cell for gap in gaps]
        body.append((label, [*columns, f"{_number(mean(everything), '.2f')} ({len(everything)})"]))
    total = sum(len(results.instances(cell.label)) for cell in results.cells)
    return _grid(results, body, f"all ({total})")


def _against(results: Results, other: str) -> list[str]:
    """Wins/ties/losses of each method and the test; in words, whom ``other`` loses to."""
    body, better, worse = [], [], []
    for label in results.labels:
        if label == other:
            continue
        pairs = [results.paired(label, other, [cell.label]) for cell in results.cells]
        together = results.paired(label, other, [cell.label for cell in results.cells])
        common = [pair.difference for pair in pairs if pair is not None]
        smaller, larger = sum(difference < 0 for difference in common), sum(difference > 0 for difference in common)
        if smaller and not larger:
            better.append(label)
        if larger and not smaller:
            worse.append(label)
        body.append((label, [*map(_paired, [*pairs, together]), f"{smaller} of {len(common)} cells"]))
    words = [
        f"Wins/ties/losses of the method against {other}, and p of a two-sided Wilcoxon signed-rank test on the gaps; "
        "last, in how many cells the method's mean gap on the same instances is the smaller one.",
        "",
        f"By the mean gap, in every cell that is not a tie, **{other} loses to** {', '.join(better) or 'none'}; "
        f"it beats {', '.join(worse) or 'none'}.",
    ]
    return [*words, "", *_grid(results, body, "all", "smaller mean gap")]


def _paired(pair: Paired | None) -> str:
    if pair is None:
        return "-"
    p = "p < 0.001" if pair.p < 0.001 else f"p = {pair.p:.2g}"
    return f"{pair.wins}/{pair.ties}/{pair.losses}, {p}"


def _proved(results: Results) -> list[str]:
    """Of the solvers that say a bound: how many optima they prove, and how far apart makespan and bound stay."""
    body = []
    for label in results.labels:
        columns = []
        for cell in results.cells:
            bounded = [row for row in results.right(label, cell.label).values() if row.bound is not None]
            gaps = [max(1 - row.bound / row.makespan, 0.0) for row in bounded if row.makespan > 0]
            proved = sum(gap <= PROVED for gap in gaps)
            apart = _number(mean([100 * gap for gap in gaps]), ".2f")
            columns.append(f"{proved} of {len(gaps)}, {apart} %" if gaps else "-")
        if any(column != "-" for column in columns):
            body.append((label, columns))
    return ["Optima proved, and the mean distance of the bound from the makespan.", "", *_grid(results, body)]
