"""Test sets stay what they are, best known tours only improve, tables judge by the judge."""

import json

import numpy as np
import pytest

from benchmarks import best, solvers, speed, table
from benchmarks.__main__ import main
from benchmarks.suite import SEED, SETS, Cell, cells
from dan_policy import DAN, DANConfig
from mtsp_env import check_tours, lower_bound, makespan

CELL = Cell(8, 2, 3)


def one_agent_does_it_all(instance):
    return [[0, *range(1, instance.n_nodes), 0]] + [[0, 0]] * (instance.n_agents - 1)


def test_instances_depend_on_seed_and_size_alone():
    few, many = CELL.instances(7), Cell(8, 2, 5).instances(7)
    assert few == many[:3]
    assert not np.array_equal(few[0].nodes, CELL.instances(8)[0].nodes)
    assert sum(cell.count for cell in SETS["first"]) == 100
    with pytest.raises(ValueError, match=r"unknown set 'none'; choose from \["):
        cells("none")


def test_best_known_tours_only_ever_improve(tmp_path):
    instances = CELL.instances(1)
    poor = [one_agent_does_it_all(i) for i in instances]
    split = [[[0, *range(1, 4), 0], [0, *range(4, 8), 0]] for _ in instances]
    assert best.merge(CELL, 1, poor, tmp_path) == 3
    assert best.merge(CELL, 1, split, tmp_path) == 3  # two agents are never worse than one on the same order
    assert best.merge(CELL, 1, poor, tmp_path) == 0
    assert best.read(CELL, 1, tmp_path) == split
    assert best.costs(CELL, 1, tmp_path) == [makespan(i.nodes, t) for i, t in zip(instances, split, strict=True)]
    assert len(list(tmp_path.iterdir())) == 1


def test_wrong_tours_are_neither_kept_nor_read(tmp_path):
    with pytest.raises(ValueError, match="missing"):
        best.merge(CELL, 1, [[[0, 1, 0], [0, 0]]] * 3, tmp_path)
    assert not list(tmp_path.iterdir())
    best.path(CELL, 1, tmp_path).write_text(json.dumps([[[0, 1, 0], [0, 0]]] * 3))
    with pytest.raises(ValueError, match="missing"):
        best.read(CELL, 1, tmp_path)
    best.path(CELL, 1, tmp_path).write_text("[]")
    with pytest.raises(ValueError, match="tours of 0 instances, 3 needed"):
        best.read(CELL, 1, tmp_path)


@pytest.mark.parametrize("name", [name for name in SETS if name != "smoke"])
def test_the_kept_best_known_tours_solve_their_instances(name):
    for cell in cells(name):
        for cost, instance in zip(best.costs(cell, SEED), cell.instances(SEED), strict=True):
            assert cost >= lower_bound(instance) - 1e-9


@pytest.mark.parametrize("name", sorted(solvers.SOLVERS))
def test_every_solver_solves_tiny_instances(name):
    for instance in [*CELL.instances(0), *Cell(3, 5, 1).instances(0)]:
        tours = solvers.find(name)(instance, 0.1, 0)
        check_tours(instance, tours)
        again = solvers.find(name)(instance, 0.1, 0)
        assert makespan(instance.nodes, again) == pytest.approx(makespan(instance.nodes, tours))
    with pytest.raises(ValueError, match="unknown solver 'magic'; choose from"):
        solvers.find("magic")


def test_a_gap_table_is_measured_by_the_judge(tmp_path, monkeypatch):
    monkeypatch.setattr(best, "FOLDER", tmp_path)
    known = [[[0, *range(1, 4), 0], [0, *range(4, 8), 0]] for _ in range(3)]
    best.merge(CELL, 5, known, tmp_path)
    monkeypatch.setattr(best, "costs", lambda cell, seed: [2.0, 4.0, 8.0])
    monkeypatch.setitem(solvers.SOLVERS, "fixed", lambda instance, seconds, seed: one_agent_does_it_all(instance))
    found = table.gaps("smoke", ["fixed"], 5)
    costs = np.array([makespan(i.nodes, one_agent_does_it_all(i)) for i in CELL.instances(5)])
    gap = costs / [2.0, 4.0, 8.0] - 1
    assert np.allclose(found["fixed"]["8x2"][:, 0], gap)
    error = gap.std(ddof=1) / np.sqrt(3)
    assert f"| fixed | {100 * gap.mean():.1f} ± {100 * error:.1f} |" in table.markdown("smoke", found)
    table.plot("smoke", found, tmp_path / "gaps.png")
    assert (tmp_path / "gaps.png").read_bytes().startswith(b"\x89PNG")


def test_speed_is_work_over_time(monkeypatch):
    clock = iter([0.0, 1.0, 2.0, 4.0])
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    assert speed.per_second(lambda: 6, seconds=3.0) == 6 * 2 / 4  # two rounds end before 3 s, after 4 s it looks


def test_every_speed_is_measured():
    small = DAN(DANConfig(embed_dim=8, feedforward_dim=8, n_heads=1, city_layers=1))
    rate, flops = speed.greedy_instances(small, "cpu", 0.01)
    assert rate > 0 and flops > 50 * 50 * 2 * 8 * 8  # at least one 8 x 8 product for each node and decision
    assert speed.aec_decisions(5, 2, 0.01) > 0
    assert speed.batched_decisions(3, "cpu", 0.01) > 0
    assert speed.matmul_rate("cpu") > 0
    assert "torch" in speed.machine()
    with pytest.raises(ValueError, match="no device 'tpu' here"):
        speed.main("tpu")


def test_bad_input_is_one_line(capsys):
    assert main(["gap", "--set", "none"]) == 2
    assert "benchmarks: error: unknown set 'none'" in capsys.readouterr().err
