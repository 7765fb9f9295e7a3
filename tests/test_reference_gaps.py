"""The reference solver's gaps: by hand, against targets, with long runs that are never repeated."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from mtsp_env import Instance, lower_bound, makespan
from mtsp_env.instance import Tours

pytest.importorskip("numba", reason="needs the extra reference")
from benchmarks import best_known
from benchmarks.studies import reference_gaps
from benchmarks.studies.reference_gaps import Outcome, Target
from mtsp_env.reference import improve

TINY = (Target(8, 2, 0.001, 0.5), Target(6, 3, 0.002, 0.1))
BAD = [[0, *range(1, 8), 0], [0, 0]]  # one agent visits all cities in the order of their numbers


@pytest.fixture(autouse=True)
def tiny(monkeypatch) -> None:
    monkeypatch.setattr(reference_gaps, "TARGETS", TINY)


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """Paths of everything that is written."""
    return {"out": tmp_path / "results" / "gaps.md", "folder": tmp_path / "best"}


class Fake:
    """Replaces ``improve``: records its calls and gives one agent all cities; interrupts after ``until`` calls."""

    def __init__(self, until: int = 10**9):
        self.calls: list[tuple[str, float]] = []
        self.until = until

    def __call__(self, instance: Instance, seconds: float, seed: int) -> Tours:
        if len(self.calls) == self.until:
            raise KeyboardInterrupt
        self.calls.append((instance.name, seconds))
        return [[0, *range(1, instance.n_nodes), 0], *[[0, 0] for _ in range(instance.n_agents - 1)]]


def by_iterations(instance: Instance, seconds: float, seed: int) -> Tours:
    """Replaces ``improve``: the number of iterations does not depend on the machine's load."""
    return improve(instance, iterations=1000, seed=seed)


def table(out: Path) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in out.read_text().splitlines() if line.startswith("| ")][1:]


def test_targets_are_reached_if_the_gap_is_small(monkeypatch, places, capsys) -> None:
    monkeypatch.setattr(reference_gaps, "improve", by_iterations)
    reference_gaps.main(instances=2, best_seconds=0.01, cells=("8x2", "6x3"), **places)
    text, rows = places["out"].read_text(), table(places["out"])
    assert capsys.readouterr().out.splitlines()[-4:] == [line for line in text.splitlines() if line.startswith("|")]
    assert re.search(r"2 uniform instances of each size, seed 7; one thread on .*Python \d", text)
    assert [row[:2] for row in rows] == [["8, 2", "50 % in 1 ms"], ["6, 3", "10 % in 2 ms"]]
    assert [row[2:4] + row[6:7] for row in rows] == [["0.00 ± 0.00", "yes", "0.01"]] * 2  # tiny, so optimal
    assert not list(places["out"].parent.glob(".*"))


def test_gaps_are_to_the_best_known_tours(monkeypatch, places) -> None:
    cell = TINY[0].cell(3)
    instances = cell.instances(7)
    known = [[0, *range(1, 5), 0], [0, *range(5, 8), 0]]
    best_known.merge(cell, 7, {0: known, 1: known}, places["folder"])
    monkeypatch.setattr(reference_gaps, "improve", Fake())
    outcome = reference_gaps.measure(TINY[0], cell, 7, places["out"], places["folder"])
    gaps = [makespan(x, BAD) / makespan(x, known) - 1.0 for x in instances[:2]]
    assert outcome.gap == pytest.approx([*gaps, 0.0])
    assert best_known.read(cell, 7, places["folder"]) == {0: known, 1: known, 2: BAD}  # measured tours are kept too
    assert outcome.long_run.tolist() == [0.0] * 3
    assert outcome.proved.tolist() == [False] * 3
    assert (outcome.wall > 0).all() and (outcome.cpu >= 0).all()


@pytest.mark.parametrize(("gap", "reached"), [(0.009, True), (0.010, True), (0.011, False)])
def test_a_larger_mean_gap_does_not_reach_its_target(gap: float, reached: bool) -> None:
    three = np.ones(3)
    outcome = Outcome(
        Target(50, 5, 0.005, 0.01), gap * np.array([0.5, 1.0, 1.5]), three, 0.5 * three, three, three > 0, {}
    )
    assert outcome.reached == reached
    row = reference_gaps.to_markdown([outcome]).splitlines()[-1]
    error = 100 * gap * 0.5 / 3**0.5
    assert row == (
        f"| 50, 5 | 1 % in 5 ms | {100 * gap:.2f} ± {error:.2f} | {'yes' if reached else 'no'} "
        "| 1,000 (1,000) | 500 | 1 | 3 of 3 |"
    )


def test_long_runs_are_resumed(monkeypatch, places) -> None:
    def run(fake: Fake, seconds: float) -> list[tuple[str, float]]:
        monkeypatch.setattr(reference_gaps, "improve", fake)
        reference_gaps.run_long(TINY[0].cell(4), 7, seconds, 1, spent, places["folder"])
        return fake.calls

    spent = places["out"].with_suffix(".json")
    with pytest.raises(KeyboardInterrupt):
        run(Fake(until=2), 5.0)
    assert set(best_known.read(TINY[0].cell(4), 7, places["folder"])) == {0, 1}
    assert json.loads(spent.read_text()) == {"8x2-seed7": [5.0, 5.0, 0.0, 0.0]}
    assert run(Fake(), 5.0) == [("8x2-2", 5.0), ("8x2-3", 5.0)]
    assert run(Fake(), 5.0) == run(Fake(), 3.0) == []
    assert run(Fake(), 6.0) == [(f"8x2-{i}", 6.0) for i in range(4)]
    reference_gaps.run_long(
        TINY[0].cell(2), 7, 7.0, 1, spent, places["folder"]
    )  # fewer instances: the others' runs are not lost
    assert json.loads(spent.read_text()) == {"8x2-seed7": [7.0, 7.0, 6.0, 6.0]}


def test_nothing_makes_the_best_known_tours_worse(monkeypatch, places) -> None:
    cell, folder = TINY[0].cell(2), places["folder"]
    monkeypatch.setattr(reference_gaps, "improve", by_iterations)
    reference_gaps.main(instances=2, cells=("8x2",), best_seconds=0.02, **places)
    before = best_known.read(cell, 7, folder)
    monkeypatch.setattr(reference_gaps, "improve", Fake())
    reference_gaps.main(instances=2, cells=("8x2",), best_seconds=1.0, **places)
    assert best_known.read(cell, 7, folder) == before
    assert table(places["out"])[0][3] == "no"


def test_a_sample_shows_how_much_far_longer_runs_shorten_best_known_tours(monkeypatch, places) -> None:
    cell, folder, sampled = TINY[1].cell(20), places["folder"], places["out"].with_name("gaps-sample.json")
    instances = cell.instances(7)
    optimal = [improve(instance, iterations=1000) for instance in instances]
    proved = [makespan(x, tours) <= lower_bound(x) + 1e-9 for x, tours in zip(instances, optimal, strict=True)]
    assert 0 < sum(proved) < 17  # at least four are not
    known, better = [[0, *range(1, 6), 0], [0, 0], [0, 0]], [[0, 1, 2, 0], [0, 3, 4, 0], [0, 5, 0]]
    best_known.merge(cell, 7, {i: optimal[i] if proved[i] else known for i in range(20)}, folder)
    calls = []

    def improve_three_times(instance: Instance, seconds: float, seed: int) -> Tours:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append((int(instance.name.rpartition("-")[2]), seconds, seed))
        return better if len(calls) < 3 else known

    def run(count: int) -> dict[str, float]:
        reference_gaps.run_sample(cell, 7, 600.0, count, 1, sampled, folder)
        return json.loads(sampled.read_text())["6x3-seed7-600s"]

    monkeypatch.setattr(reference_gaps, "improve", improve_three_times)
    two = run(2)
    for i in map(int, two):
        gain = 1.0 - makespan(instances[i], better) / makespan(instances[i], known)
        assert gain > 0.1 and two[str(i)] == pytest.approx(gain)
        assert best_known.read(cell, 7, folder)[i] == better
    assert run(2) == two and len(calls) == 2  # none is repeated
    with pytest.raises(KeyboardInterrupt):
        run(20)
    three = json.loads(sampled.read_text())["6x3-seed7-600s"]
    assert two.items() <= three.items() and three[str(calls[2][0])] == 0.0  # no improvement is a reduction of 0
    assert calls == [(i, 600.0, 7 + i) for i, *_ in calls] and len({i for i, *_ in calls}) == 3
    assert not any(proved[i] for i, *_ in calls)
    monkeypatch.setattr(reference_gaps, "improve", Fake())
    assert reference_gaps.measure(TINY[1], cell, 7, places["out"], folder).reduction == {
        int(i): g for i, g in three.items()
    }
    assert reference_gaps.measure(TINY[1], cell, 7, places["out"], folder, 60.0).reduction == {}


def test_the_reduction_of_the_sample_is_added_for_instances_that_are_neither_proved_nor_sampled() -> None:
    one, proved = np.ones(5), np.array([True, False, False, False, False])
    gap = np.array([0.0, 0.004, 0.01, 0.006, 0.0])
    outcome = Outcome(Target(50, 5, 0.005, 0.01), gap, one, one, one, proved, {1: 0.01, 2: 0.03})
    gap, error = outcome.extrapolated_gap
    assert gap == pytest.approx(0.004 + 2 / 5 * 0.02)
    assert error == pytest.approx(np.hypot(0.0019, 2 / 5 * 0.01), abs=1e-5)
    row = reference_gaps.sample_to_markdown(
        [outcome, *(dataclasses.replace(outcome, reduction=few) for few in ({}, {1: 0.01}))], 600.0
    ).splitlines()[4:]
    assert row == [f"| 50, 5 | 2 | 2.000 ± 1.000 | 1.20 ± {100 * error:.2f} | no |"]


def test_a_damaged_list_of_long_runs_is_named(monkeypatch, places) -> None:
    places["out"].parent.mkdir()
    places["out"].with_suffix(".json").write_text("{")
    monkeypatch.setattr(reference_gaps, "improve", Fake())
    with pytest.raises(ValueError, match=r"\.json: not a JSON file"):
        reference_gaps.main(**{"instances": 2, "cells": ("8x2",), "best_seconds": 0.1, **places})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"instances": 1}, "instances must be a whole number of at least 2, got 1"),
        ({"instances": 10**9}, "instances must be at most 10000, got 1000000000"),
        ({"workers": 0}, "workers must be a whole number of at least 1, got 0"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"sample": 1}, "sample must be 0 or at least 2, got 1"),
        ({"sample": -2}, "sample must be a whole number of at least 0, got -2"),
        ({"sample": 2, "sample_seconds": 0.0}, "sample_seconds must be a finite number of seconds above 0, got 0.0"),
        ({"best_seconds": 0.0}, "best_seconds must be a finite number of seconds above 0, got 0.0"),
        ({"cells": ("8x2", "9x9")}, r"unknown cell '9x9'; choose from \['8x2', '6x3'\]"),
    ],
)
def test_bad_arguments_are_named_before_anything_runs(monkeypatch, places, arguments: dict, message: str) -> None:
    fake = Fake()
    monkeypatch.setattr(reference_gaps, "improve", fake)
    with pytest.raises(ValueError, match=message):
        reference_gaps.main(**{"instances": 2, "cells": ("8x2",), **places, **arguments})
    assert fake.calls == [] and not places["out"].exists()
