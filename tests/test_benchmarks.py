"""Test sets never change, best known tours only improve, solvers are loaded by name, speed is measured."""

import json
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from made_up import one_agent_does_it_all, row
from misbehaving import deals

from benchmarks import best_known, solvers, suite
from benchmarks.__main__ import COMMANDS, load, main
from benchmarks.harness.journal import Journal
from benchmarks.studies import speed, speed_peers, speed_solve, speed_train, timing
from benchmarks.suite import SEED, TABLES, Cell, TsplibCell
from dan_policy import DAN, DANConfig
from mtsp_env import check_tours, lower_bound, makespan

ROOT = Path(__file__).parents[1]
CELL = Cell(8, 2, 3)


# Test sets


def test_instances_depend_on_seed_and_size_alone():
    few, many = CELL.instances(7), Cell(8, 2, 5).instances(7)
    assert few == many[:3]
    assert not np.array_equal(few[0].nodes, CELL.instances(8)[0].nodes)
    assert few[0].nodes[0].tolist() == [0.07684116792504614, 0.6839723787313347]  # must never change


def test_the_tables_are_the_papers():
    published = json.loads((ROOT / "benchmarks" / "reports" / "published.json").read_text(encoding="utf-8"))
    for number in "123":
        table = published[f"table{number}"]
        assert [cell.printed for cell in TABLES[number]] == table["cells"]
        for name, numbers in table.items():
            if isinstance(numbers, dict):
                assert all(len(values) == len(table["cells"]) for values in numbers.values()), name
    assert all(cell.count >= 20 for cell in TABLES["1"])
    assert (TABLES["figure4"][0].n_nodes, TABLES["figure4"][-1].n_nodes) == (20, 1000)
    assert {cell.n_agents for cell in TABLES["figure4"]} == {5}
    kinds = {(type(cell), cell.label) for cells in TABLES.values() for cell in cells}
    assert len({cell.file(7) for cells in TABLES.values() for cell in cells}) == len(kinds)
    assert suite.find_cell("3", "gtsp150x20") == TsplibCell("gtsp150", 150, 20, paper_name="kroa150")
    with pytest.raises(ValueError, match=r"unknown table 'none'; choose from \["):
        suite.cells("none")
    with pytest.raises(ValueError, match=r"table 2 has no cell '50x5'; choose from \["):
        suite.find_cell("2", "50x5")


def test_the_public_test_set_is_numpys_and_leaves_its_global_generator_alone():
    for cell in TABLES["seed3333"]:
        np.random.seed(3333)  # noqa: NPY002 (the definition of the test set)
        expected = np.random.uniform(size=(100, cell.n_nodes, 2))[: cell.count]  # noqa: NPY002
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        instances = cell.instances(3333)
        assert np.array_equal(np.stack([instance.nodes for instance in instances]), expected), cell.label
        assert {instance.n_agents for instance in instances} == {cell.n_agents}
        assert np.array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_the_public_test_set_has_one_seed_and_100_instances():
    assert suite.seed_of("seed3333") == 3333 and suite.seed_of("1") == 7 and suite.seed_of("1", 5) == 5
    with pytest.raises(ValueError, match="the seed of table seed3333 is 3333, got 7"):
        suite.seed_of("seed3333", 7)
    with pytest.raises(ValueError, match="the seed of the public test set is 3333, got 7"):
        TABLES["seed3333"][0].instances(7)
    with pytest.raises(ValueError, match="instances must be at most 100 in the public test set, got 101"):
        suite.cells("seed3333", count=101)


def test_the_public_test_set_has_the_published_cells():
    expected = [(50, 5), (50, 7), (50, 10), (100, 5), (100, 7), (100, 10), (200, 10), (200, 15), (200, 20)]
    expected += [(500, 10), (1000, 10), (500, 30), (1000, 50)]
    cells = TABLES["seed3333"]
    assert [(cell.n_nodes, cell.n_agents) for cell in cells] == expected
    published = json.loads((ROOT / "benchmarks" / "reports" / "published.json").read_text(encoding="utf-8"))
    table = published["tableseed3333"]
    assert all(len(m["cost"]) == len(table["cells"]) for m in table.values() if isinstance(m, dict))
    dpn = dict(zip(map(tuple, table["cells"]), table["DPN"]["cost"], strict=True))
    assert dpn[100, 5] == 2.2693 and dpn[200, 20] == 1.963 and dpn[500, 30] == 2.0074 and dpn[1000, 50] is None


# Best known tours


def test_best_known_tours_only_ever_improve(tmp_path):
    instances = Cell(8, 2, 5).instances(1)
    poor, good = one_agent_does_it_all(instances[0]), [[0, 1, 2, 3, 0], [0, 4, 5, 6, 7, 0]]  # halves of the poor one
    assert best_known.merge(CELL, 1, {0: poor, 2: good}, tmp_path) == 2
    assert best_known.read(CELL, 1, tmp_path) == {0: poor, 2: good}
    assert best_known.merge(CELL, 1, {0: good, 1: poor, 2: poor, 4: poor}, tmp_path) == 3
    assert best_known.read(CELL, 1, tmp_path) == {0: good, 1: poor, 2: good}
    assert best_known.read(replace(CELL, count=9), 1, tmp_path) == {0: good, 1: poor, 2: good, 4: poor}
    written = (tmp_path / CELL.file(1)).read_bytes()
    assert best_known.merge(CELL, 1, {0: poor, 2: good}, tmp_path) == 0
    assert (tmp_path / CELL.file(1)).read_bytes() == written
    assert len(list(tmp_path.iterdir())) == 1
    assert best_known.read(CELL, 2, tmp_path) == {}


def test_processes_that_keep_tours_at_the_same_time_wait_for_one_another(tmp_path):
    """Each takes the tours of one instance; none is lost."""
    cell = Cell(8, 2, 12)
    with ThreadPoolExecutor(12) as pool:  # a lock belongs to an open file, so that it also keeps threads apart
        tours = [one_agent_does_it_all(instance) for instance in cell.instances(1)]
        assert list(pool.map(lambda i: best_known.merge(cell, 1, {i: tours[i]}, tmp_path), range(12))) == [1] * 12
    assert best_known.read(cell, 1, tmp_path) == dict(enumerate(tours))


def test_wrong_tours_are_neither_kept_nor_read(tmp_path):
    with pytest.raises(ValueError, match="missing"):
        best_known.merge(CELL, 1, {0: [[0, 1, 0], [0, 0]]}, tmp_path)
    assert not list(tmp_path.iterdir())
    for text, message in [
        (json.dumps([None, [[0, 1, 0], [0, 0]]]), "instance 1: cities 2, 3, 4, 5, 6, ... missing"),
        ("[", "not JSON"),
        ("{}", "expected a list"),
    ]:
        (tmp_path / CELL.file(1)).write_text(text)
        with pytest.raises(ValueError, match=message):
            best_known.read(CELL, 1, tmp_path)
        with pytest.raises(ValueError, match=message):
            best_known.merge(CELL, 1, {0: one_agent_does_it_all(CELL.instances(1)[0])}, tmp_path)


def test_results_give_their_better_tours(tmp_path):
    instances = CELL.instances(7)
    best_known.merge(CELL, 7, {0: deals(instances[0], 1, 0)}, tmp_path)
    good = [row(i, deals(i, 1, 0), k) for k, i in enumerate(instances)]
    results = [*good, *(row(i, one_agent_does_it_all(i), k) for k, i in enumerate(instances))]
    failed = replace(results[0], status="error", tours=None, makespan=None)
    assert best_known.merge_rows([failed, *results], folder=tmp_path) == ["8x2: 2 of 3 improved"]
    assert best_known.read(CELL, 7, tmp_path) == {k: deals(i, 1, 0) for k, i in enumerate(instances)}
    assert best_known.merge_rows(results, folder=tmp_path) == ["8x2: 0 of 3 improved"]
    assert best_known.merge_rows([], folder=tmp_path) == []


@pytest.mark.slow
def test_the_search_improves_and_the_check_counts_what_is_proved(tmp_path):
    instances = CELL.instances(7)
    best_known.merge(CELL, 7, {k: one_agent_does_it_all(i) for k, i in enumerate(instances)}, tmp_path)
    assert best_known.search_cell(CELL, 7, 0.02, workers=2, folder=tmp_path) == "8x2: 3 of 3 improved"
    costs = [
        makespan(i, tours) for i, tours in zip(instances, best_known.read(CELL, 7, tmp_path).values(), strict=True)
    ]
    proved = sum(cost <= lower_bound(i) + 1e-9 for cost, i in zip(costs, instances, strict=True))
    line = f"8x2: 3 of 3 instances, mean {sum(costs) / 3:.4f}, {proved} at the lower bound"
    assert best_known.verify(CELL, 7, tmp_path) == line
    assert best_known.kept_cells(folder=tmp_path) == [(CELL, 7)]
    assert best_known.verify(CELL, 8, tmp_path) == "8x2: 0 of 3 instances, 0 at the lower bound"


@pytest.mark.slow
def test_the_kept_best_known_tours_solve_their_instances():
    kept = best_known.kept_cells()
    assert {cell.label for cell, seed in kept if seed == SEED} >= {"50x5", "100x10"}
    assert {cell.label for cell, seed in kept if seed == 3333} == {cell.label for cell in TABLES["seed3333"]}
    for cell, seed in kept:
        for instance, tours in zip(cell.instances(seed), best_known.read(cell, seed).values(), strict=True):
            assert makespan(instance, tours) >= lower_bound(instance) - 1e-9


def test_the_command_takes_better_tours_and_verifies(tmp_path, monkeypatch, capsys):
    for name in ("read", "merge_rows", "verify", "kept_cells"):
        function = getattr(best_known, name)
        monkeypatch.setattr(function, "__defaults__", (*function.__defaults__[:-1], tmp_path))
    instance = CELL.instances(7)[0]
    with Journal(tmp_path / "rows.jsonl") as journal:
        journal.append(row(instance, deals(instance, 1, 0), 0))
    assert main(["best", "--merge", str(tmp_path / "rows.jsonl"), "--check"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "8x2: 1 of 1 improved" and lines[1].startswith("8x2: 1 of 1 instances, mean ")
    assert main(["best", "--check", "--table", "smoke"]) == 0
    assert capsys.readouterr().out.startswith("8x2: 1 of 3 instances")
    (tmp_path / CELL.file(7)).write_text("[[[0, 1, 0], [0, 0]]]")
    assert main(["best", "--check"]) == 2
    assert f"{CELL.file(7)}: instance 0: cities 2, 3" in capsys.readouterr().err
    assert main(["best", "--check", "--cells", "8x2"]) == 2
    assert "name the table of the cells ['8x2'] with --table" in capsys.readouterr().err
    assert main(["best", "--check", "--table", "smoke", "--cells", "9x2"]) == 2
    assert "unknown cell '9x2'; choose from ['8x2']" in capsys.readouterr().err
    assert main(["best"]) == 2
    assert "choose at least one of --merge FILES, --search SECONDS and --check" in capsys.readouterr().err


# Solvers


@pytest.mark.parametrize(
    "name",
    [
        *("random", "nearest", "dan-greedy", "dan-greedy-x8", "dan-s64-x8", "dan-improve", "reference"),
        *("joint-greedy", "joint-greedy-x8", "joint-s64", "joint-s64-x8", "joint-r16"),
        *("schedulenet-greedy", "schedulenet-s64"),
    ],
)
@pytest.mark.slow
def test_our_solvers_solve_tiny_instances_and_repeat_themselves(name):
    for instance in [*CELL.instances(0), *Cell(3, 5, 1).instances(0)]:
        tours = solvers.find(name)(instance, 0.05, 0)
        check_tours(instance, tours)
        again = solvers.find(name)(instance, 0.05, 0)
        assert makespan(instance, again) == pytest.approx(makespan(instance, tours))


@pytest.mark.slow
def test_naming_solvers_loads_none_and_each_has_a_file():
    code = "import sys; import benchmarks.harness.worker, benchmarks.harness.run; print(sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    heavy = {"torch", "numba", "ortools", "elkai", "highspy", "scipy", "matplotlib"}
    assert not heavy & {name.strip("'") for name in done.stdout.strip("[]\n").split(", ")}
    missing = {s.target for s in solvers.SOLVERS.values() if find_spec(s.target.partition(":")[0]) is None}
    assert not missing


def test_rows_name_the_weights_behind_every_network():
    """Solvers with the same weights have the same hash, and a team's weights are part of that of its solver."""
    hashes = {name: solver.versions().get("weights") for name, solver in solvers.SOLVERS.items()}
    assert hashes["dan-greedy"] == hashes["dan-s64"] and hashes["joint-greedy"] == hashes["joint-s64"]
    assert hashes["schedulenet-greedy"] == hashes["schedulenet-s64"] and hashes["hu-greedy"] == hashes["hu-s64"]
    different = {hashes[f"{name}-greedy"] for name in ("dan", "joint", "dan-paper", "schedulenet", "hu")}
    assert len(different) == 5 and None not in different
    assert hashes["nearest"] is hashes["reference"] is None


def test_solvers_are_loaded_by_name(tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("import a_package_that_nobody_has")
    monkeypatch.syspath_prepend(tmp_path)
    assert solvers.find("misbehaving:deals") is deals
    assert solvers.look_up("joint-s64").options == {"samples": 64}
    assert solvers.look_up("joint-s64-x8").options == {"samples": 64, "augment": True}
    dan = ["dan-greedy", "dan-greedy-x8", "dan-s64", "dan-s64-x8", "dan-s256", "dan-improve"]
    assert solvers.expand(["nearest, dan", "dan-s64"]) == ["nearest", *dan]
    assert solvers.expand(["all"]) == list(solvers.SOLVERS)
    assert solvers.expand(["joint"]) == ["joint-greedy", "joint-greedy-x8", "joint-s64", "joint-s64-x8", "joint-r16"]
    with pytest.raises(ValueError, match="unknown solver 'magic'; choose from"):
        solvers.find("magic")
    with pytest.raises(ValueError, match="no solver at 'misbehaving:magic'"):
        solvers.find("misbehaving:magic")
    with pytest.raises(solvers.Unavailable, match="package a_package_that_nobody_has is missing"):
        solvers.find("needy:solve")


# Speed


def test_speed_is_work_over_time(monkeypatch):
    clock = iter([0.0, 1.0, 2.0, 4.0])
    monkeypatch.setattr(timing.time, "perf_counter", lambda: next(clock))
    assert timing.per_second(lambda: 6, seconds=3.0) == 6 * 2 / 4  # the second ends after 4 s


@pytest.mark.slow
def test_solving_is_timed_and_its_memory_is_measured(monkeypatch):
    monkeypatch.setattr(
        speed_solve.torch, "set_num_threads", lambda threads: None
    )  # leave this process's threads alone
    before = speed_solve.peak_memory()
    cost = speed_solve.measure(speed_solve.Case(30, 2, "greedy"), "dan", threads=1, repeats=2)
    assert cost.first > 0 and cost.later > 0
    assert 10 * 2**20 < before <= cost.memory_before <= cost.memory == speed_solve.peak_memory() < 100 * 2**30


@pytest.mark.slow
def test_every_speed_is_measured():
    small = DAN(DANConfig(embed_dim=8, feedforward_dim=8, n_heads=1, city_layers=1))
    rate, flops = speed.greedy_instances(small, "cpu", 0.01)
    assert rate > 0 and flops > 50 * 50 * 2 * 8 * 8  # at least one 8 x 8 product for each node and decision
    assert speed.aec_decisions(5, 2, 0.01) > 0
    assert speed.batched_decisions(3, "cpu", 0.01) > 0
    assert timing.matmul_rate("cpu") > 0
    assert "torch" in timing.machine_title()
    with pytest.raises(ValueError, match="no device 'tpu' here"):
        speed.main(device="tpu")


@pytest.mark.slow
def test_the_speed_of_training_counts_what_is_done():
    """FLOP per decision depend on the network alone: a decision that is learnt from takes one forward pass and
    a backward pass of twice the cost; REINFORCE also plays it."""
    size = {"n_nodes": (6, 6), "n_agents": (2, 2), "nodes_per_agent": 1, "device": "cpu", "precision": "float32"}
    tiny = {**size, "network": DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2), "validation_instances": 2}
    _, played, forward = speed_train.rollouts(tiny, 8, 0.01)
    _, learnt, both = speed_train.reinforcement(tiny, 8, 0.01)
    assert 3.5 < (both / learnt) / (forward / played) < 4.5
    instances, decisions, flops = speed_train.imitation(tiny, 16, 0.01)
    assert instances > 0 and decisions / instances == pytest.approx(6 - 1 + 2)
    assert 2.5 < (flops / decisions) / (forward / played) < 3.5
    assert speed_train.teaching(6, 2, 0.01) > 0


@pytest.mark.slow
def test_peers_are_measured_in_turns_and_compared(monkeypatch, tmp_path):
    """A peer whose steps take 100 s each is slower than ours."""
    calls = []

    def measure_rl4co(python, batch, seconds):
        calls.append(batch)
        return {"rl4co": "0.7.0"}, speed_peers.Timings([[100.0, 100.0]], [[200.0, 200.0]], [batch])

    monkeypatch.setattr(speed_peers, "measure_rl4co", measure_rl4co)
    monkeypatch.setattr(speed_peers, "BATCHES", (2, 3))
    threads = torch.get_num_threads()
    table = speed_peers.speed_table(0.0, 2, Path(sys.executable), compiled=False)
    assert calls == [2, 3, 2, 3] and torch.get_num_threads() == threads
    columns = [list(column.cells) for column in table.columns]
    assert columns[0] == ["RL4CO MTSPEnv", "BatchedMTSP"] * 2 and columns[1] == ["2", "2", "3", "3"]
    assert columns[2][::2] == ["100000.000"] * 2 and columns[4] == ["1.00", "0.00"] * 2
    assert all(float(ratio) > 10 for ratio in columns[8][1::2])


def test_interrupted_steps_do_not_count():
    episodes = [[1.0, 9.0, 3.0], [9.0, 2.0, 9.0]]
    assert speed_peers.best(episodes) == 2.0 and speed_peers.typical(episodes) == 6.0
    timings = speed_peers.Timings(episodes, episodes, [12, 12])
    timings.extend(speed_peers.Timings([], [[1.0, 1.0, 1.0]], [12]))
    assert timings.decisions_per_second == 4.0


def test_a_missing_peer_is_an_error_with_instructions(tmp_path, capsys):
    assert main(["speed", "--peers", "--peer-python", str(tmp_path / "python")]) == 2
    assert f"{tmp_path / 'python'} does not exist" in (error := capsys.readouterr().err)
    assert "peers/README.md" in error and error.count("\n") == 1
    (tmp_path / "python").write_text("#!/bin/sh\necho no module named rl4co >&2\nexit 1\n")
    (tmp_path / "python").chmod(0o755)
    with pytest.raises(OSError, match="no module named rl4co"):
        speed_peers.measure_rl4co(tmp_path / "python", 2, 0.1)


# Commands


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_says_what_it_does_and_explains_its_options(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        main([name, "--help"])
    assert stopped.value.code == 0
    text = " ".join(capsys.readouterr().out.split())
    assert f"usage: python -m benchmarks {name}" in text
    assert load(name).__doc__.split("\n")[0][:40] in text
    options = re.findall(r" --([a-z][a-z-]*[a-z])", text)
    documented = re.findall(r"^        (\w+): ", load(name).__doc__, flags=re.MULTILINE)
    assert {option.removeprefix("no-").replace("-", "_") for option in options} <= {*documented, "help"}
