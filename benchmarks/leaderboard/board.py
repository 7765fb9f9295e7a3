"""``python -m benchmarks leaderboard``: judges submissions, and writes the page that ranks them."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import best_known, suite
from benchmarks.files import write_text
from benchmarks.harness.judge import read_judged
from benchmarks.harness.rows import Row
from benchmarks.leaderboard import submission, worlds
from benchmarks.leaderboard.submission import Submission
from benchmarks.leaderboard.test_sets import TEST_SETS, WORLDS
from benchmarks.reports.markdown import markdown_table
from benchmarks.reports.statistics import Mean, Results, collect, mean
from benchmarks.reports.tables import published_gaps

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

HERE = Path(__file__).parent
SUBMISSIONS = HERE / "submissions"
RESULTS = HERE.parent / "results"
PAGE = HERE.parents[1] / "docs" / "leaderboard.md"

TIMED = "100x10"  # the size whose seconds are shown


@dataclass(frozen=True)
class About:
    """What the board says about a method, beside its numbers."""

    name: str
    by: str
    knows: str
    link: str = ""

    @property
    def linked(self) -> str:
        """The name, as a link if there is an address."""
        return f"[{self.name}]({self.link})" if self.link else self.name


def leaderboard(submissions: tuple[Path, ...] = (), /, add: bool = False, out: Path = PAGE) -> str:
    """Judge submissions and print their gaps; without any, or with --add, write the page of the leaderboard.

    Args:
        submissions: files to judge, JSON, gzipped if their names end in ".gz".
        add: if all of them are valid, copy them into benchmarks/leaderboard/submissions/ and keep their better tours as
            best known ones.
        out: the page.

    Returns:
        A table for each submission, and the name of the page if it was written.

    Raises:
        OSError: a file cannot be read or written.
        ValueError: a file is not a submission, or its tours do not solve their instances; the message names the file.
    """
    if add and not submissions:
        raise ValueError("--add needs at least one submission")
    judged = {path: judge_file(path) for path in submissions}
    text = [f"{path}: {_summary(entry, rows)}" for path, (entry, rows) in judged.items()]
    if add:
        for path, (entry, rows) in judged.items():
            submission.write(SUBMISSIONS / f"{path.name.removesuffix('.gz').removesuffix('.json')}.json.gz", entry)
            text += [] if entry.test_set == WORLDS else best_known.merge_rows(rows)
    if add or not submissions:
        write_text(out, page())
        text.append(str(out))
    return "\n\n".join(text)


def judge_file(path: Path) -> tuple[Submission, list]:
    """Read and judge a submission: its rows. Raises OSError or ValueError, whose message names the file."""
    entry = submission.read(path)
    try:
        return entry, (worlds.judge_submission if entry.test_set == WORLDS else submission.judge)(entry)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _summary(entry: Submission, rows: Sequence[Row]) -> str:
    """The gaps of one submission, as a table."""
    if entry.test_set == WORLDS:
        table = worlds.table([*worlds.measured(), *rows], {entry.method: entry})
        return f"{entry.method} by {entry.by}, test set {entry.test_set}\n\n{table}"
    (results,) = collect(rows)
    (label,) = results.labels
    lines = [
        [
            cell.heading,
            _gap(_percent(results, label, cell.label), cell.count),
            f"{_mean_makespan(rows, cell.label):.4f}",
        ]
        for cell in results.cells
    ]
    table = markdown_table(["n, m", "gap to the best known tours, %", "mean makespan"], lines)
    return f"{entry.method} by {entry.by}, test set {entry.test_set}\n\n{table}"


def _mean_makespan(rows: Iterable[Row], cell: str) -> float:
    return mean([row.makespan for row in rows if row.cell == cell]).mean


def page() -> str:
    """The page: an introduction, and a table for each test set.

    Raises:
        OSError: a file cannot be read.
        ValueError: a damaged or wrong file, rows of a method that methods.toml does not have, or two submissions of one
            name.
    """
    judged = [judge_file(path) for path in sorted(SUBMISSIONS.glob("*.json*"))]
    sections = [_text("introduction.md")]
    for name, test_set in TEST_SETS.items():
        files = [RESULTS / file for file in test_set.files]
        rows = [row for row in read_judged(files) if row.table == test_set.table]
        about = _about_measured(rows)
        for entry, theirs in judged:
            if entry.test_set == name:
                label = f"{entry.method} by {entry.by}"
                if label in about:
                    raise ValueError(f"two submissions of {label}, test set {name}: give them different names")
                about[label] = About(entry.method, entry.by, entry.knows, entry.link)
                rows += submission.with_label(theirs, label)
        for results in collect(rows):  # one, or none if the test set has no rows
            sections.append(f"## {test_set.title}\n\n{test_set.text}\n\n{_table(results, about)}")
    games, entries = worlds.measured(), {}
    for entry, theirs in judged:
        if entry.test_set == WORLDS:
            if entry.method in entries:
                raise ValueError(f"two submissions of {entry.method}, test set worlds: give them different names")
            entries[entry.method] = entry
            games += theirs
    if games:
        sections.append(f"## {worlds.TITLE}\n\n{worlds.TEXT}\n\n{worlds.table(games, entries)}")
    return "\n\n".join([*sections, _text("submit.md")]) + "\n"


def _text(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8").rstrip()


def _about_measured(rows: Iterable[Row]) -> dict[str, About]:
    """What is said about each label of the project's own rows."""
    file = HERE / "methods.toml"
    methods = tomllib.loads(file.read_text(encoding="utf-8"))
    about = {}
    for row in rows:
        if row.method not in methods:
            raise ValueError(f"{file}: no entry for {row.method!r}, of which there are rows; there are {list(methods)}")
        method = methods[row.method]
        budget = "" if row.budget is None else f", {row.budget:g} s"
        about[row.label] = About(method["name"] + budget, "mtsp-env", method["knows"])
    return about


def _table(results: Results, about: dict[str, About]) -> str:
    """Methods with the most sizes come first, and among those with equally many the one with the smallest mean gap."""
    gaps = {label: [_percent(results, label, cell.label) for cell in results.cells] for label in results.labels}
    best = [min(gap.mean for gap in column if gap is not None) for column in zip(*gaps.values(), strict=True)]

    def place(label: str) -> tuple[int, float]:
        means = [gap.mean for gap in gaps[label] if gap is not None]
        return -len(means), sum(means) / len(means) if means else 0.0

    lines = [
        [
            about[label].linked,
            about[label].by,
            about[label].knows,
            *(_gap(gap, c.count, low) for gap, c, low in zip(gaps[label], results.cells, best, strict=True)),
            _seconds(results, label),
        ]
        for label in sorted(results.labels, key=place)
        if any(gaps[label])
    ]
    published = [
        [
            name.replace(", published", ""),
            "published",
            "map",
            *(text or "–" for text in columns[: len(results.cells)]),
            "–",
        ]
        for name, columns in published_gaps(results)
    ]
    heads = ["method", "by", "knows", *(cell.heading for cell in results.cells), f"seconds, {_heading(TIMED)}"]
    return markdown_table(heads, [*lines, *published])


def _percent(results: Results, label: str, cell: str) -> Mean | None:
    return mean([100 * gap for gap in results.gaps(label, cell).values()])


def _gap(gap: Mean | None, count: int, best: float | None = None) -> str:
    """The gap with its error, and in brackets the number of instances if some are missing; bold if it is the best."""
    if gap is None:
        return "–"
    text = f"{gap.mean:.2f}" + ("" if gap.error is None else f" ± {gap.error:.2f}")
    text = f"**{text}**" if best is not None and gap.mean <= best + 0.005 else text
    return text if gap.count == count else f"{text} ({gap.count})"


def _seconds(results: Results, label: str) -> str:
    average = mean([row.seconds for row in results.solved(label, TIMED).values()])
    return "–" if average is None else f"{average.mean:.2g}"


def _heading(label: str) -> str:
    return next(cell.heading for cell in suite.cells("1") if cell.label == label)
