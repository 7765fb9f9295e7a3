"""The table of the reference solver's aims: gaps by hand, long runs that are never done twice."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from mtsp_env import Instance, lower_bound, makespan
from mtsp_env.instance import Tours

pytest.importorskip("numba", reason="needs the extra reference")
from benchmarks import aims, best
from benchmarks.aims import Aim, Measured
from mtsp_env.reference import improve

TINY = (Aim(8, 2, 0.001, 0.5), Aim(6, 3, 0.002, 0.1))
BAD = [[0, *range(1, 8), 0], [0, 0]]  # all cities to one agent, as they are numbered


@pytest.fixture(autouse=True)
def tiny(monkeypatch) -> None:
    monkeypatch.setattr(aims, "AIMS", TINY)


@pytest.fixture
def places(tmp_path: Path) -> dict[str, Path]:
    """Where everything is written."""
    return {"out": tmp_path / "results" / "aims.md", "folder": tmp_path / "best"}


class Fake:
    """Stands where ``improve`` does: notes its calls, and gives one agent everything; the first ``until`` times."""

    def __init__(self, until: int = 10**9):
        self.calls: list[tuple[str, float]] = []
        self.until = until

    def __call__(self, instance: Instance, seconds: float, seed: int) -> Tours:
        if len(self.calls) == self.until:
            raise KeyboardInterrupt
        self.calls.append((instance.name, seconds))
        return [[0, *range(1, instance.n_nodes), 0], *[[0, 0] for _ in range(instance.n_agents - 1)]]


def by_iterations(instance: Instance, seconds: float, seed: int) -> Tours:
    """Stands where ``improve`` does, for as many iterations on a busy machine as on an idle one."""
    return improve(instance, iterations=1000, seed=seed)


def table(out: Path) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in out.read_text().splitlines() if line.startswith("| ")][1:]


def test_aims_are_those_of_the_reference_solver_and_are_met_where_the_gap_is_small(monkeypatch, places, capsys) -> None:
    monkeypatch.setattr(aims, "improve", by_iterations)
    aims.main(instances=2, best_seconds=0.01, cells=("8x2", "6x3"), **places)
    text, rows = places["out"].read_text(), table(places["out"])
    assert capsys.readouterr().out.splitlines()[-4:] == [line for line in text.splitlines() if line.startswith("|")]
    assert re.search(r"2 uniform instances of each size, seed 7; one thread on .*Python \d", text)
    assert [row[:2] for row in rows] == [["8, 2", "50 % in 1 ms"], ["6, 3", "10 % in 2 ms"]]
    assert [row[2:4] + row[6:7] for row in rows] == [["0.00 ± 0.00", "yes", "0.01"]] * 2  # so small that all is optimal
    assert not list(places["out"].parent.glob(".*"))


def test_gaps_are_to_the_best_known_tours(monkeypatch, places) -> None:
    cell = TINY[0].cell(3)
    instances = cell.instances(7)
    known = [[0, *range(1, 5), 0], [0, *range(5, 8), 0]]
    best.merge(cell, 7, {0: known, 1: known}, places["folder"])
    monkeypatch.setattr(aims, "improve", Fake())
    found = aims.measure(TINY[0], cell, 7, places["out"], places["folder"])
    gaps = [makespan(x, BAD) / makespan(x, known) - 1.0 for x in instances[:2]]
    assert found.gap == pytest.approx([*gaps, 0.0])
    assert best.read(cell, 7, places["folder"]) == {0: known, 1: known, 2: BAD}  # what is measured is kept, too
    assert found.searched.tolist() == [0.0] * 3
    assert found.proved.tolist() == [False] * 3
    assert (found.wall > 0).all() and (found.cpu >= 0).all()


@pytest.mark.parametrize(("gap", "met"), [(0.009, True), (0.010, True), (0.011, False)])
def test_a_larger_mean_gap_is_not_met(gap: float, met: bool) -> None:
    three = np.ones(3)
    found = Measured(Aim(50, 5, 0.005, 0.01), gap * np.array([0.5, 1.0, 1.5]), three, 0.5 * three, three, three > 0, {})
    assert found.met == met
    row = aims.markdown([found]).splitlines()[-1]
    error = 100 * gap * 0.5 / 3**0.5
    assert row == (
        f"| 50, 5 | 1 % in 5 ms | {100 * gap:.2f} ± {error:.2f} | {'yes' if met else 'no'} "
        "| 1,000 (1,000) | 500 | 1 | 3 of 3 |"
    )


def test_long_runs_go_on_where_they_were_stopped(monkeypatch, places) -> None:
    def run(fake: Fake, seconds: float) -> list[tuple[str, float]]:
        monkeypatch.setattr(aims, "improve", fake)
        aims.search(TINY[0].cell(4), 7, seconds, 1, spent, places["folder"])
        return fake.calls

    spent = places["out"].with_suffix(".json")
    with pytest.raises(KeyboardInterrupt):
        run(Fake(until=2), 5.0)
    assert set(best.read(TINY[0].cell(4), 7, places["folder"])) == {0, 1}
    assert json.loads(spent.read_text()) == {"8x2-seed7": [5.0, 5.0, 0.0, 0.0]}
    assert run(Fake(), 5.0) == [("8x2-2", 5.0), ("8x2-3", 5.0)]
    assert run(Fake(), 5.0) == run(Fake(), 3.0) == []
    assert run(Fake(), 6.0) == [(f"8x2-{i}", 6.0) for i in range(4)]
    aims.search(TINY[0].cell(2), 7, 7.0, 1, spent, places["folder"])  # fewer instances: the others' runs are not lost
    assert json.loads(spent.read_text()) == {"8x2-seed7": [7.0, 7.0, 6.0, 6.0]}


def test_nothing_makes_the_best_known_tours_worse(monkeypatch, places) -> None:
    cell, folder = TINY[0].cell(2), places["folder"]
    monkeypatch.setattr(aims, "improve", by_iterations)
    aims.main(instances=2, cells=("8x2",), best_seconds=0.02, **places)
    before = best.read(cell, 7, folder)
    monkeypatch.setattr(aims, "improve", Fake())
    aims.main(instances=2, cells=("8x2",), best_seconds=1.0, **places)
    assert best.read(cell, 7, folder) == before
    assert table(places["out"])[0][3] == "no"


def test_samples_tell_what_far_longer_runs_take_off_the_best_known_tours(monkeypatch, places) -> None:
    cell, folder, sampled = TINY[1].cell(20), places["folder"], places["out"].with_name("aims-sample.json")
    instances = cell.instances(7)
    optimal = [improve(instance, iterations=1000) for instance in instances]
    proved = [makespan(x, tours) <= lower_bound(x) + 1e-9 for x, tours in zip(instances, optimal, strict=True)]
    assert 0 < sum(proved) < 17  # at least four are not
    known, better = [[0, *range(1, 6), 0], [0, 0], [0, 0]], [[0, 1, 2, 0], [0, 3, 4, 0], [0, 5, 0]]
    best.merge(cell, 7, {i: optimal[i] if proved[i] else known for i in range(20)}, folder)
    calls = []

    def found(instance: Instance, seconds: float, seed: int) -> Tours:
        if len(calls) == 3:
            raise KeyboardInterrupt
        calls.append((int(instance.name.rpartition("-")[2]), seconds, seed))
        return better if len(calls) < 3 else known

    def run(count: int) -> dict[str, float]:
        aims.search_sample(cell, 7, 600.0, count, 1, sampled, folder)
        return json.loads(sampled.read_text())["6x3-seed7-600s"]

    monkeypatch.setattr(aims, "improve", found)
    two = run(2)
    for i in map(int, two):
        gain = 1.0 - makespan(instances[i], better) / makespan(instances[i], known)
        assert gain > 0.1 and two[str(i)] == pytest.approx(gain)
        assert best.read(cell, 7, folder)[i] == better
    assert run(2) == two and len(calls) == 2  # none is run twice
    with pytest.raises(KeyboardInterrupt):
        run(20)
    three = json.loads(sampled.read_text())["6x3-seed7-600s"]
    assert two.items() <= three.items() and three[str(calls[2][0])] == 0.0  # nothing found is nothing gained
    assert calls == [(i, 600.0, 7 + i) for i, *_ in calls] and len({i for i, *_ in calls}) == 3
    assert not any(proved[i] for i, *_ in calls)
    monkeypatch.setattr(aims, "improve", Fake())
    assert aims.measure(TINY[1], cell, 7, places["out"], folder).shorter == {int(i): g for i, g in three.items()}
    assert aims.measure(TINY[1], cell, 7, places["out"], folder, 60.0).shorter == {}


def test_what_samples_show_is_added_for_the_instances_that_are_neither_proved_nor_sampled() -> None:
    one, proved = np.ones(5), np.array([True, False, False, False, False])
    gap = np.array([0.0, 0.004, 0.01, 0.006, 0.0])
    found = Measured(Aim(50, 5, 0.005, 0.01), gap, one, one, one, proved, {1: 0.01, 2: 0.03})
    gap, error = found.gap_of_sample
    assert gap == pytest.approx(0.004 + 2 / 5 * 0.02)
    assert error == pytest.approx(np.hypot(0.0019, 2 / 5 * 0.01), abs=1e-5)
    row = aims.sample_markdown(
        [found, *(dataclasses.replace(found, shorter=few) for few in ({}, {1: 0.01}))], 600.0
    ).splitlines()[4:]
    assert row == [f"| 50, 5 | 2 | 2.000 ± 1.000 | 1.20 ± {100 * error:.2f} | no |"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"instances": 1}, "instances must be a whole number of at least 2, got 1"),
        ({"workers": 0}, "workers must be a whole number of at least 1, got 0"),
        ({"sample": 1}, "sample must be 0 or at least 2, got 1"),
        ({"sample": -2}, "sample must be a whole number of at least 0, got -2"),
        ({"sample": 2, "sample_seconds": 0.0}, "sample_seconds must be a finite number of seconds above 0, got 0.0"),
        ({"best_seconds": 0.0}, "best_seconds must be a finite number of seconds above 0, got 0.0"),
        ({"cells": ("8x2", "9x9")}, r"unknown cell '9x9'; choose from \['8x2', '6x3'\]"),
    ],
)
def test_bad_arguments_are_named_before_anything_runs(monkeypatch, places, arguments: dict, message: str) -> None:
    fake = Fake()
    monkeypatch.setattr(aims, "improve", fake)
    with pytest.raises(ValueError, match=message):
        aims.main(**{"instances": 2, "cells": ("8x2",), **places, **arguments})
    assert fake.calls == [] and not places["out"].exists()
