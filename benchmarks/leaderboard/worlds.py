"""The test set "worlds": games in worlds that change, submitted as decisions and replayed by the rules."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from benchmarks.harness.world_rows import Row, parse_lines
from benchmarks.leaderboard.submission import CellResult, Submission
from benchmarks.leaderboard.test_sets import WORLDS
from benchmarks.policies.in_worlds import BASELINE, find_method
from benchmarks.reports.markdown import markdown_table
from benchmarks.reports.statistics import mean
from benchmarks.reports.worlds import Games, collect, relative_gaps
from benchmarks.studies.worlds import RESULTS, Cell, judge, play_together
from dan_policy.games import Choose
from mtsp_env import SCENARIOS
from mtsp_env.instance import batch
from mtsp_env.reading import read_file

COUNT = 100  # instances of each scenario and size
SIZES = ((50, 5), (100, 10))

TITLE = "Worlds that change"
TEXT = (
    "Cities that appear, agents that break down, roads that delay, teams that differ: 100 instances of each scenario "
    "and size, drawn by [worlds.py](../benchmarks/studies/worlds.py). Gaps are to the central `Replanner` with 50 ms "
    "for each event, on the same instances; a negative one is better. *Knows* is `observation`, what one agent sees "
    "when it decides, or `global`, everything that is known to anybody at that time."
)


def cells() -> dict[str, Cell]:
    """The cells by label, such as "everything 50x5"."""
    every = [Cell(scenario, n, m) for n, m in SIZES for scenario in SCENARIOS]
    return {f"{cell.scenario} {cell.size}": cell for cell in every}


def judge_submission(submission: Submission) -> list[Row]:
    """A row for each game, with the makespan by the project's own judge.

    Raises:
        ValueError: an unknown cell, a wrong number of games, or decisions that break a rule; the message names the cell
            and the instance.
    """
    known = cells()
    if not submission.cells:
        raise ValueError(f"no cells; choose from {sorted(known)}")
    rows = []
    for label, result in submission.cells.items():
        if label not in known:
            raise ValueError(f"test set {WORLDS!r} has no cell {label!r}; choose from {sorted(known)}")
        if result.decisions is None:
            raise ValueError(f"{label} needs decisions: the nodes that were picked in each game, in turn")
        if len(result.decisions) != COUNT:
            raise ValueError(f"{label} has {COUNT} instances, got the decisions of {len(result.decisions)}")
        for number, decisions in enumerate(result.decisions):
            rows.append(_judge_game(submission, known[label], label, number, decisions, result.seconds))
    return rows


def _judge_game(
    submission: Submission, cell: Cell, label: str, number: int, decisions: list[int], seconds: float
) -> Row:
    limit = cell.rules.max_decisions
    try:
        if not (decisions and len(decisions) <= limit and all(0 <= node < cell.n_nodes for node in decisions)):
            raise ValueError(f"expected 1 to {limit} nodes from 0 to {cell.n_nodes - 1}")
        makespan, truncated = judge(cell.instance(number), cell.rules, decisions)
    except ValueError as error:
        raise ValueError(f"{label}, instance {number}: {error}") from error
    return Row(
        scenario=cell.scenario,
        size=cell.size,
        instance=number,
        method=submission.method,
        makespan=makespan,
        truncated=truncated,
        decisions=len(decisions),
        seconds=seconds,
        searches=None,
        iterations=None,
        machine={"processor": submission.machine},
    )


def play_cells(choose: Choose, labels: Iterable[str]) -> dict[str, CellResult]:
    """The games of a network, greedy, as they are submitted. Their seconds are not measured: the games are batched."""
    known, results = cells(), {}
    for label in labels:
        cell = known[label]
        decisions = play_together(batch([cell.instance(k) for k in range(COUNT)]), cell.rules, choose)
        results[label] = CellResult(seconds=None, decisions=decisions)
    return results


def measured(folder: Path = RESULTS) -> list[Row]:
    """This project's own rows; none if there is no file."""
    file = folder / "rows.jsonl"
    return list(parse_lines(file, read_file(file))) if file.exists() else []


def table(rows: list[Row], submissions: dict[str, Submission]) -> str:
    """A line for each method, and a column for each scenario and size.

    ``submissions`` are those among ``rows``, by method.
    """
    games = collect(rows)
    known = cells()
    heads = ["method", "by", "knows", *(f"{cell.scenario} {cell.n_nodes}, {cell.n_agents}" for cell in known.values())]
    lines = []
    for name in sorted(games, key=lambda name: _place(games, name)):
        entry = submissions.get(name)
        if entry is not None:
            about = [f"[{entry.method}]({entry.link})" if entry.link else entry.method, entry.by, entry.knows]
        else:
            needs = find_method(name).needs
            about = [find_method(name).title, "mtsp-env", "observation" if needs.startswith("local") else "global"]
        lines.append([*about, *(_gap(games, name, cell) for cell in known.values())])
    return markdown_table(heads, lines)


def _place(games: Games, name: str) -> tuple[int, float]:
    """Methods with the most cells first, then by the mean of their gaps."""
    means = [relative_gaps(games, name, cell.size, cell.scenario).tolist() for cell in cells().values()]
    means = [sum(gaps) / len(gaps) for gaps in means if gaps]
    return -len(means), sum(means) / len(means) if means else 0.0


def _gap(games: Games, name: str, cell: Cell) -> str:
    gap = mean(relative_gaps(games, name, cell.size, cell.scenario))
    if gap is None:
        return "–"
    if name == BASELINE:
        return "0"
    text = f"{gap.mean:.1f}" + ("" if gap.error is None else f" ± {gap.error:.1f}")
    return text if gap.count == COUNT else f"{text} ({gap.count})"
