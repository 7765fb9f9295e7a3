"""The tables of one of the paper's tables: costs, gaps, seconds, comparisons and proofs, a column for each cell."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

from benchmarks.harness.rows import Row
from benchmarks.reports.markdown import markdown_table
from benchmarks.reports.statistics import Bound, Comparison, Mean, Results, mean
from benchmarks.solvers.exact import PROVED
from benchmarks.suite import TsplibCell

PUBLISHED = Path(__file__).with_name("published.json")

# Published methods stand before the first of our methods that corresponds to them
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
    "Park et al. (ScheduleNet)": "schedulenet-greedy",
    "Hu et al.": "hu-greedy",
}

BOUND = "*bound: to the farthest city and back*"

Line = tuple[str, list[str]]
"""A line of a table: its first cell and a cell for each column."""


def section(results: Results, against: str) -> list[str]:
    """All tables of the results and their notes, as lines of Markdown."""
    notes = Notes(results)
    lines = []
    if any(isinstance(cell, TsplibCell) for cell in results.cells):
        rounded = _means(results, notes, lambda row: row.rounded_length, ".0f")
        exact = _means(results, notes, lambda row: row.length, ".1f")
        lines += ["### Longest tour, every leg rounded as TSPLIB does (so are the published ones)", ""]
        rounded = [*_with_published(results, rounded, "cost"), _bounds(results, lambda b: b.rounded_length, ".0f")]
        exact.append(_bounds(results, lambda bound: bound.length, ".1f"))
        lines += [_table(results, rounded)]
        lines += ["", "### Longest tour, not rounded", "", _table(results, exact)]
    else:
        costs = _means(results, notes, lambda row: row.makespan, ".3f")
        costs = _with_published(results, costs, "cost", ".4f" if results.table == "seed3333" else ".2f")
        costs.append(_bounds(results, lambda bound: bound.makespan, ".3f"))
        lines += ["### Makespan", "", _table(results, costs)]
    lines += ["", "### Gap to the best known tours of the same instances, %", "", _gaps(results, notes)]
    seconds = _means(results, notes, lambda row: row.seconds, ".3g", error=False)
    lines += ["", "### Seconds", "", _table(results, _with_published(results, seconds, "seconds"))]
    if against in results.labels:
        lines += ["", f"### Against {against}, instance by instance", "", *_comparisons(results, against)]
    else:
        lines += ["", f"There are no rows of {against} to compare the others with."]
    if any(row.bound is not None for row in results.all_rows()):
        lines += ["", "### Proved", "", *_proofs(results)]
    return lines + notes.lines()


class Notes:
    """Numbered notes that say why a cell has no number, or a mean over fewer instances than the others."""

    def __init__(self, results: Results) -> None:
        self.results = results
        self.texts: list[str] = []

    def mark(self, label: str, cell: str) -> str:
        """A superscript, or nothing if every instance has valid tours."""
        rows, expected = self.results.rows[label].get(cell, {}), self.results.instances(cell)
        failures = Counter((row.status, row.error) for row in rows.values() if not row.ok)
        parts = [f"{count} × {status}: {_one_line(error)}" for (status, error), count in failures.most_common(3)]
        if len(failures) > 3:
            parts.append(f"{sum(failures.values()) - sum(n for _, n in failures.most_common(3))} more failed")
        if len(rows) < len(expected):
            parts.append(f"{len(expected) - len(rows)} not run")
        if not parts:
            return ""
        text = f"of {len(expected)}: {'; '.join(parts)}"
        if text not in self.texts:
            self.texts.append(text)
        return f"<sup>{self.texts.index(text) + 1}</sup>"

    def lines(self) -> list[str]:
        """The notes, and remarks on the whole table."""
        remarks = []
        if any(isinstance(cell, TsplibCell) and cell.paper_name for cell in self.results.cells):
            remarks.append(
                "The paper prints the costs of gtsp150 under the name kroa150: in TSPLIB's kroA150, with its first "
                "node as the depot, the trip to the farthest city and back is 5395 long."
            )
        if self.results.unkept:
            total = sum(len(best) for best in self.results.best.values())
            remarks.append(
                f"For {self.results.unkept} of {total} instances the best known tours are those of these rows: "
                "no others are kept, or the TSPLIB files to check them were not given."
            )
        if self.results.table == "seed3333":
            remarks.append(
                "Published means are of all 100 instances of the public test set. Their gaps are to the mean of the "
                "best known makespans of the same instances, in the cells in which all 100 have best known tours."
            )
        numbered = ["", *(f"{i}. {text}" for i, text in enumerate(self.texts, 1))] if self.texts else []
        return numbered + [line for text in remarks for line in ("", text)]


def _one_line(text: str | None) -> str:
    line = " ".join((text or "").split()).replace("|", "/")
    return line if len(line) <= 160 else f"{line[:157]}..."


def _table(results: Results, lines: Iterable[Line], *more_heads: str) -> str:
    """A Markdown table with a column for each cell, and more columns if there are more heads."""
    heads = [f"{cell.heading} ({len(results.instances(cell.label))})" for cell in results.cells]
    first = "file, m" if any(isinstance(cell, TsplibCell) for cell in results.cells) else "n, m"
    return markdown_table([f"{first} (instances)", *heads, *more_heads], [[name, *columns] for name, columns in lines])


def _means(results: Results, notes: Notes, value: Callable[[Row], float], style: str, error: bool = True) -> list[Line]:
    """A line for each method: the mean of ``value`` over the instances that it solved in each cell."""
    lines = []
    for label in results.labels:
        columns = []
        for cell in results.cells:
            average = mean([value(row) for row in results.solved(label, cell.label).values()])
            columns.append(_number(average, style, error) + notes.mark(label, cell.label))
        lines.append((label, columns))
    return lines


def _bounds(results: Results, value: Callable[[Bound], float], style: str) -> Line:
    """The mean of ``value`` of the lower bounds of each cell's instances."""
    means = [mean([value(bound) for bound in results.bounds.get(cell.label, {}).values()]) for cell in results.cells]
    return BOUND, [_number(average, style) for average in means]


def _number(average: Mean | None, style: str, error: bool = True) -> str:
    if average is None:
        return "-"
    text = format(average.mean, style)
    return f"{text} ± {format(average.error, style)}" if error and average.error is not None else text


def _with_published(results: Results, measured: list[Line], field: str, style: str = "g") -> list[Line]:
    """``measured`` with the published methods before their counterparts; those without one come first."""
    published: dict[str | None, list[Line]] = {}
    for name, columns in _published(results, field, style).items():
        counterpart = COUNTERPARTS.get(name.partition(",")[0])
        key = counterpart if counterpart in results.methods() else None
        published.setdefault(key, []).append((f"*{name}*", columns))
    lines = published.pop(None, [])
    by_label = dict(measured)
    for method, labels in results.methods().items():
        lines += published.pop(method, []) + [(label, by_label[label]) for label in labels]
    return lines


def _published(results: Results, field: str, style: str) -> dict[str, list[str]]:
    """The published numbers for the cells by method; methods without a number are left out."""
    data = json.loads(PUBLISHED.read_text(encoding="utf-8"))
    table = data.get(f"table{results.table}")
    if table is None:
        return {}
    sources = [(table, "published")]
    if results.table == "1":
        sources.append((data["later"], "Kim et al. 2022"))
    lines = {}
    for source, author in sources:
        for name, numbers in source.items():
            if isinstance(numbers, dict) and field in numbers:
                by_cell = {tuple(c): number for c, number in zip(table["cells"], numbers[field], strict=True)}
                columns = [by_cell.get(tuple(cell.printed)) for cell in results.cells]
                if any(number is not None for number in columns):
                    lines[f"{name}, {author}"] = ["" if number is None else format(number, style) for number in columns]
    return lines


def _gaps(results: Results, notes: Notes) -> str:
    """Gaps in per cent, for each cell and over all instances."""
    lines = []
    for label in results.labels:
        by_cell = [[100 * gap for gap in results.gaps(label, cell.label).values()] for cell in results.cells]
        columns = [
            _number(mean(gaps), ".2f") + notes.mark(label, cell.label)
            for gaps, cell in zip(by_cell, results.cells, strict=True)
        ]
        all_gaps = [gap for gaps in by_cell for gap in gaps]
        lines.append((label, [*columns, f"{_number(mean(all_gaps), '.2f')} ({len(all_gaps)})"]))
    lines = [*published_gaps(results), *lines, _bound_gaps(results)]
    total = sum(len(results.instances(cell.label)) for cell in results.cells)
    return _table(results, lines, f"all ({total})")


def _bound_gaps(results: Results) -> Line:
    """The lower bounds' distance below the best known makespans, as negative gaps in per cent."""
    by_cell = []
    for cell in results.cells:
        bounds, best = results.bounds.get(cell.label, {}), results.best.get(cell.label, {})
        by_cell.append([100 * (bounds[key].makespan / best[key] - 1) for key in bounds.keys() & best.keys()])
    every = [gap for gaps in by_cell for gap in gaps]
    columns = [_number(mean(gaps), ".2f") for gaps in by_cell]
    return BOUND, [*columns, f"{_number(mean(every), '.2f')} ({len(every)})"]


def published_gaps(results: Results) -> list[Line]:
    """For the public test set: published means against the mean best known makespan of the same 100 instances."""
    lines = []
    for name, columns in _published(results, "cost", ".8g").items() if results.public_best else ():
        gaps = [
            f"{round(100 * (float(text) / results.public_best[cell.label] - 1), 2) + 0.0:.2f}"  # never -0.00
            if text and cell.label in results.public_best
            else ""
            for text, cell in zip(columns, results.cells, strict=True)
        ]
        if any(gaps):
            lines.append((f"*{name}*", [*gaps, ""]))
    return lines


def _comparisons(results: Results, other: str) -> list[str]:
    """Each method compared with ``other``: wins/ties/losses and the test, and in words which methods beat it."""
    lines, better, worse = [], [], []
    for label in results.labels:
        if label == other:
            continue
        by_cell = [results.compare(label, other, [cell.label]) for cell in results.cells]
        overall = results.compare(label, other, [cell.label for cell in results.cells])
        differences = [comparison.difference for comparison in by_cell if comparison is not None]
        smaller = sum(difference < 0 for difference in differences)
        larger = sum(difference > 0 for difference in differences)
        if smaller and not larger:
            better.append(label)
        if larger and not smaller:
            worse.append(label)
        lines.append((label, [*map(_comparison, [*by_cell, overall]), f"{smaller} of {len(differences)} cells"]))
    return [
        f"Wins/ties/losses of the method against {other}, and p of a two-sided Wilcoxon signed-rank test on the gaps. "
        "The last column counts the cells in which the method has the smaller mean gap on the same instances.",
        "",
        f"By the mean gap, in every cell that is not a tie, **{other} loses to** {', '.join(better) or 'none'}; "
        f"it beats {', '.join(worse) or 'none'}.",
        "",
        _table(results, lines, "all", "smaller mean gap"),
    ]


def _comparison(comparison: Comparison | None) -> str:
    if comparison is None:
        return "-"
    p = "p < 0.001" if comparison.p < 0.001 else f"p = {comparison.p:.2g}"
    return f"{comparison.wins}/{comparison.ties}/{comparison.losses}, {p}"


def _proofs(results: Results) -> list[str]:
    """For solvers that give bounds: the number of proved optima, and the mean distance from bound to makespan."""
    lines = []
    for label in results.labels:
        columns = []
        for cell in results.cells:
            bounded = [row for row in results.solved(label, cell.label).values() if row.bound is not None]
            gaps = [max(1 - row.bound / row.makespan, 0.0) for row in bounded if row.makespan > 0]
            proved = sum(gap <= PROVED for gap in gaps)
            distance = _number(mean([100 * gap for gap in gaps]), ".2f")
            columns.append(f"{proved} of {len(gaps)}, {distance} %" if gaps else "-")
        if any(column != "-" for column in columns):
            lines.append((label, columns))
    return [
        "Number of proved optima, and the mean distance of the bound from the makespan.",
        "",
        _table(results, lines),
    ]
