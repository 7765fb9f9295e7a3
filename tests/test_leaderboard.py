"""The leaderboard shows what the judge finds in a submission, and nothing of a submission that breaks a rule."""

import gzip
import json
from dataclasses import asdict

import pytest
from made_up import one_agent_does_it_all, row

from benchmarks import best_known, suite
from benchmarks.__main__ import main
from benchmarks.harness.world_rows import Row
from benchmarks.leaderboard import board, submission, test_sets, worlds
from benchmarks.leaderboard.board import leaderboard
from benchmarks.studies.worlds import Cell
from mtsp_env import check_log, makespan
from mtsp_env.instance import batch
from mtsp_env.log import write_log

CELL = suite.cells("smoke")[0]
INSTANCES = CELL.instances(suite.SEED)
HALVES = [[[0, 1, 2, 3, 0], [0, 4, 5, 6, 7, 0]]] * 3


@pytest.fixture(autouse=True)
def tiny(tmp_path, monkeypatch):
    """A leaderboard with one small test set and no results, in a folder of its own."""
    for module in (board, test_sets):
        monkeypatch.setattr(module, "TEST_SETS", {"tiny": test_sets.TestSet("smoke", "Tiny", "Three instances.", ())})
    monkeypatch.setattr(board, "SUBMISSIONS", tmp_path / "submissions")
    monkeypatch.setattr(worlds.measured, "__defaults__", (tmp_path / "no rows",))
    for function in (best_known.merge_rows, board.collect):
        monkeypatch.setattr(function, "__defaults__", (None, tmp_path / "best"))
    return tmp_path


def entry(tours=HALVES, **more):
    about = {"method": "Halves", "by": "A. Person", "test_set": "tiny", "knows": "map", "machine": "a slow one"}
    return about | {"cells": {"8x2": {"seconds": 0.5, "tours": tours}}} | more


def write(path, data):
    text = json.dumps(data).encode()
    path.write_bytes(gzip.compress(text) if path.suffix == ".gz" else text)
    return path


def lines_of(page, name):
    return [line for line in page.splitlines() if line.startswith(f"| {name}")]


@pytest.mark.parametrize("name", ["mine.json", "mine.json.gz"])
def test_makespans_are_those_of_the_judge(tmp_path, name):
    rows = submission.judge(submission.read(write(tmp_path / name, entry())))
    assert [row.makespan for row in rows] == [makespan(i, t) for i, t in zip(INSTANCES, HALVES, strict=True)]


def test_an_added_submission_stands_on_the_page_and_improves_the_best_known_tours(tmp_path):
    poor = [one_agent_does_it_all(instance) for instance in INSTANCES]
    out = tmp_path / "page.md"
    leaderboard((write(tmp_path / "one.json", entry(poor, method="One does it all")),), add=True, out=out)
    (line,) = lines_of(out.read_text(), "One does it all")
    assert "**0.00 ± 0.00**" in line  # nothing better is known

    leaderboard((write(tmp_path / "halves.json", entry(link="https://example.org")),), add=True, out=out)
    (halves,), (one,) = lines_of(out.read_text(), "[Halves](https://example.org)"), lines_of(out.read_text(), "One")
    kept = best_known.read(CELL, suite.SEED, tmp_path / "best")
    best = [min(makespan(i, p), makespan(i, h)) for i, p, h in zip(INSTANCES, poor, HALVES, strict=True)]
    assert [makespan(INSTANCES[k], kept[k]) for k in range(3)] == best
    gap = sum(100 * (makespan(i, t) / b - 1) for i, t, b in zip(INSTANCES, poor, best, strict=True)) / 3
    assert f"| {gap:.2f} ±" in one
    assert out.read_text().index(halves) < out.read_text().index(one)


def test_judging_alone_writes_nothing(tmp_path, tiny):
    file = write(tmp_path / "mine.json", entry())
    assert "Halves by A. Person" in leaderboard((file,))
    assert list(tmp_path.iterdir()) == [file]


OUTSIDE = [[[0, 1, 2, 3, 0], [0, 4, 5, 6, 9, 0]]] * 3
MISSING = [*HALVES[:2], [[0, 1, 2, 3, 0], [0, 4, 5, 6, 0]]]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (entry(MISSING), "8x2, instance 2: city 7 missing"),
        (entry(OUTSIDE), "8x2, instance 0"),
        (entry(HALVES[:2]), "8x2 has 3 instances, got the tours of 2"),
        (entry(cells={}), "no cells"),
        (entry(cells={"9x2": {"seconds": 1, "tours": HALVES}}), "test set 'tiny' has no cell '9x2'"),
        (entry(test_set="huge"), "unknown test set 'huge'; choose from ['tiny', 'worlds']"),
        (entry(knows="the future"), "Invalid enum value 'the future'"),
        (entry(method="a | b"), "$.method"),
        (entry(by=""), "$.by"),
        (entry(link="javascript:alert(1)"), "$.link"),
        (entry(color="red"), "unknown field `color`"),
        (entry(cells={"8x2": {"seconds": -1, "tours": HALVES}}), "$.cells[...].seconds"),
        (entry(cells={"8x2": {"seconds": 1, "tours": [[[0, 1.5, 0]]]}}), "$.cells[...].tours"),
        ({}, "missing required field"),
        ([], "Expected `object`"),
    ],
)
def test_a_bad_submission_is_one_line_and_changes_nothing(tmp_path, capsys, data, message):
    good, bad = write(tmp_path / "good.json", entry()), write(tmp_path / "bad.json", data)
    assert main(["leaderboard", str(good), str(bad), "--add", "--out", str(tmp_path / "page.md")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert str(bad) in line
    assert sorted(tmp_path.iterdir()) == [bad, good]


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[" * 10**5, b"{"])
def test_a_damaged_file_is_named(tmp_path, content):
    for file in (tmp_path / "bad.json", tmp_path / "bad.json.gz"):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.json"):
            submission.read(file)


def test_two_submissions_of_one_name_are_refused(tmp_path):
    leaderboard((write(tmp_path / "first.json", entry()),), add=True, out=tmp_path / "page.md")
    submission.write(tmp_path / "submissions" / "second.json", submission.read(tmp_path / "first.json"))
    with pytest.raises(ValueError, match=r"two submissions of Halves by A\. Person"):
        leaderboard(out=tmp_path / "page.md")


def test_measured_methods_need_an_entry(monkeypatch, tmp_path):
    rows = [row(INSTANCES[0], one_agent_does_it_all(INSTANCES[0]), 0, method="unheard-of")]
    monkeypatch.setattr(board, "read_judged", lambda files: rows)
    with pytest.raises(ValueError, match=r"methods\.toml: no entry for 'unheard-of'"):
        leaderboard(out=tmp_path / "page.md")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "knows"),
    [
        (["--policy", "default"], "observation"),
        (["--policy", "default", "--samples", "2"], "map"),
        (["--solver", "nearest", "--seconds", "1"], "map"),
    ],
)
def test_what_submit_writes_is_judged_without_complaint(tmp_path, options, knows):
    out = tmp_path / "mine.json"
    assert main(["submit", *options, "--method", "M", "--by", "B", "--test-set", "tiny", "--out", str(out)]) == 0
    written = submission.read(out)
    assert (written.knows, list(written.cells)) == (knows, ["8x2"])
    assert len(submission.judge(written)) == 3


def test_submit_needs_one_way_to_plan(tmp_path, capsys):
    about = ["--method", "M", "--by", "B", "--out", str(tmp_path / "mine.json")]
    for options in ([], ["--policy", "default", "--solver", "nearest"], ["--solver", "nearest"]):
        assert main(["submit", *options, *about]) == 2
        assert "--policy" in (error := capsys.readouterr().err) or "--seconds" in error
    in_worlds = [*about, "--test-set", "worlds"]
    for options in (["--solver", "nearest", "--seconds", "1"], ["--policy", "default", "--samples", "4"]):
        assert main(["submit", *options, *in_worlds]) == 2
        assert "the test set worlds takes greedy games" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.fixture
def few_worlds(monkeypatch, tmp_path):
    """Two games of one cell, and the baseline's rows of them."""
    cell = Cell("everything", 8, 2)
    monkeypatch.setattr(worlds, "COUNT", 2)
    monkeypatch.setattr(worlds, "cells", lambda: {"everything 8x2": cell})
    monkeypatch.setattr(worlds.measured, "__defaults__", (tmp_path / "rows",))
    rows = [Row("everything", "8x2", k, "replanner-50", 2.0, False, 9, None, None, None, {}) for k in range(2)]
    (tmp_path / "rows").mkdir()
    (tmp_path / "rows" / "rows.jsonl").write_text("".join(f"{json.dumps(asdict(row))}\n" for row in rows))
    return cell


@pytest.mark.slow
def test_games_in_worlds_are_played_again(tmp_path, few_worlds):
    out, page = tmp_path / "mine.json", tmp_path / "page.md"
    about = ["--method", "M", "--by", "B", "--test-set", "worlds", "--out", str(out)]
    assert main(["submit", "--policy", "default", *about]) == 0
    played = submission.read(out)
    costs = [row.makespan for row in worlds.judge_submission(played)]
    for number, (decisions, cost) in enumerate(zip(played.cells["everything 8x2"].decisions, costs, strict=True)):
        instance, game_rules = few_worlds.instance(number), few_worlds.rules
        log = write_log(batch([instance]), game_rules, decisions, close=True)
        assert cost == check_log(instance, log, game_rules.speed)
    leaderboard((out,), add=True, out=page)
    (line,) = lines_of(page.read_text(), "M | B | observation")
    assert f"{sum(50 * (cost - 2) for cost in costs) / 2:.1f} ±" in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda games: games.pop(), "everything 8x2 has 2 instances, got the decisions of 1"),
        (lambda games: games[1].clear(), "everything 8x2, instance 1: expected 1 to 200 nodes from 0 to 7"),
        (lambda games: games[1].append(8), "everything 8x2, instance 1: expected 1 to 200 nodes from 0 to 7"),
        (lambda games: games[0].__delitem__(slice(4, None)), "instance 0: the game is not over after 4 decisions"),
        (lambda games: games[0].append(0), r"instance 0: the game is over after \d+ decisions"),
        (lambda games: games[0].insert(1, games[0][0]), r"instance 0: decision 1: agent 1 may not go to node \d"),
        (lambda games: games.__setitem__(0, [0] * 200), r"instance 0: decision 0: agent 0 may not go to node 0"),
    ],
)
def test_games_that_break_a_rule_are_refused(tmp_path, few_worlds, change, message):
    out = tmp_path / "mine.json"
    main(["submit", "--policy", "default", "--method", "M", "--by", "B", "--test-set", "worlds", "--out", str(out)])
    played = submission.read(out)
    change(played.cells["everything 8x2"].decisions)
    with pytest.raises(ValueError, match=message):
        worlds.judge_submission(played)


@pytest.mark.slow
def test_the_page_is_up_to_date(monkeypatch):
    monkeypatch.undo()
    assert board.PAGE.read_text(encoding="utf-8") == board.page(), "run: python -m benchmarks leaderboard"
