"""Every outcome of a solver becomes a row; rows on disk are complete and are not measured again."""

import json
import math
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.processes import alive, wait_until
from misbehaving import FOLDER

from benchmarks import solvers, suite
from benchmarks.__main__ import main
from benchmarks.harness import rows
from benchmarks.harness.jobs import Limits, make_jobs
from benchmarks.harness.journal import Journal
from benchmarks.harness.run import run
from benchmarks.harness.supervisor import ONE_THREAD
from mtsp_env import check_tours, makespan, read_tsplib

ROOT = Path(__file__).parents[1]
QUICK = {"limit": 0.3, "grace": 0.3}


def measure(tmp_path, *methods, **options):
    """Rows of the smoke test by method; one instance, unless the options say more."""
    options = {"instances": 1, "seconds": (0.2,)} | QUICK | options
    run("smoke", tmp_path / "rows.jsonl", tuple(f"misbehaving:{method}" for method in methods), **options)
    return {row.method.removeprefix("misbehaving:"): row for row in rows.read(tmp_path / "rows.jsonl")}


@pytest.mark.slow
def test_a_run_from_end_to_end(tmp_path, capsys):
    out = tmp_path / "new" / "rows.jsonl"
    command = ["run", "--table", "smoke", "--methods", "reference,misbehaving:proves", "--out", str(out)]
    command += ["--seconds", "0.02", "0.05"]
    assert main(command) == 0
    assert "12 new rows, 0 of them failed" in capsys.readouterr().out
    instances = suite.cells("smoke")[0].instances(suite.SEED)
    results = rows.read(out)
    for row in results:
        check_tours(instances[row.instance], row.tours)
        assert row.makespan == makespan(instances[row.instance], row.tours)
        assert (row.table, row.cell, row.seed, row.status, row.error) == ("smoke", "8x2", 7, "ok", None)
        assert row.name == instances[row.instance].name
        assert row.seconds > 0 and row.cpu_seconds >= 0
        assert row.bound == (0.5 if row.method == "misbehaving:proves" else None)
        assert {"processor", "cores", "platform", "python"} == row.machine.keys()
        assert {"numpy", "mtsp-env"} <= row.versions.keys()
        assert ("numba" in row.versions) == (row.method == "reference")
    methods = ("reference", "misbehaving:proves")
    assert {(row.instance, row.method, row.budget) for row in results} == {
        (i, method, budget) for i in range(3) for method in methods for budget in (0.02, 0.05)
    }
    reference = [row for row in results if row.method == "reference"]
    assert all(row.budget <= row.seconds for row in reference)

    before = out.read_bytes()
    assert main(command) == 0
    assert "0 new rows" in capsys.readouterr().out
    assert out.read_bytes() == before
    assert main([*command, "--methods", "reference", "--seconds", "0.03", "--instances", "1"]) == 0
    assert "1 new rows" in capsys.readouterr().out
    assert out.read_bytes().startswith(before)


def test_methods_without_a_budget_are_run_once(tmp_path, monkeypatch):
    monkeypatch.setitem(solvers.SOLVERS, "once", solvers.Solver("misbehaving:deals", anytime=False))
    jobs = make_jobs(suite.cells("smoke", count=1), "smoke", ["once", "reference"], 7, [1, 10, 1.0])
    assert [(job.method, job.budget) for job in jobs] == [("once", None), ("reference", 1.0), ("reference", 10.0)]
    jobs.append(replace(jobs[-1], method="dan-improve"))  # which improves its first tours for 10 s
    assert [Limits(limit=60.0).seconds(job) for job in jobs] == [60.0, 1.0, 10.0, 70.0]


@pytest.mark.slow
def test_every_kind_of_failure_is_a_row(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    kinds = {
        "crashes": ("crash", "killed by SIGSEGV"),
        "leaves": ("crash", "exit code 3: no more memory"),
        "exits": ("error", "SystemExit: enough"),
        "raises": ("error", "RuntimeError: out of ideas"),
        "forgets_a_city": ("wrong tours", "ValueError: city 2 missing from the tours"),
        "halves": ("wrong tours", "ValueError: tour 0 must be a list of at least 2 node numbers"),
        "returns_nothing": ("wrong tours", "TypeError"),
        "has_no_licence": ("unavailable", "no licence for Solver 9"),
        "lacks_a_package": ("unavailable", "package a_package_that_nobody_has is missing"),
        "finds_nothing": ("no tours", "no tours in 1 s"),
    }
    results = measure(tmp_path, *kinds, "deals")
    for method, (status, error) in kinds.items():
        row = results[method]
        assert (row.status, row.tours, row.makespan) == (status, None, None), method
        assert row.error.startswith(error)
    assert results["deals"].ok  # it runs last


@pytest.mark.slow
def test_what_hangs_is_killed_with_its_children(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    row = measure(tmp_path, "hangs", instances=3, seconds=(2.0,))["hangs"]  # the third instance's
    assert (row.status, row.instance) == ("timeout", 2)
    assert row.error == "killed 0.3 s after its limit of 2 s"
    assert 2.3 <= row.seconds < 2.0 * 1.2 + 0.3 + 0.5
    pids = [int(pid) for pid in (tmp_path / "8x2-2.pids").read_text().split()]
    assert len(pids) == 4  # two of them have left the process group
    wait_until(lambda: not any(alive(pid) for pid in pids))


@pytest.mark.slow
def test_a_hanging_warm_up_is_killed_too(tmp_path):
    row = measure(tmp_path, "hangs_in_the_warm_up", warm_up=1.0)["hangs_in_the_warm_up"]
    assert (row.status, row.error) == ("timeout", "killed: not ready after 1 s")


@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGINT])
@pytest.mark.slow
def test_a_killed_run_loses_only_the_running_row(tmp_path, signal_number):
    out = tmp_path / "rows.jsonl"
    command = [sys.executable, "-m", "benchmarks", "run", "--table", "smoke", "--out", str(out)]
    command += ["--methods", "misbehaving:hangs", "--seconds", "600"]
    env = os.environ | {FOLDER: str(tmp_path), "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    running = subprocess.Popen(
        command,
        cwd=ROOT,
        env=env,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # in the background it may be ignored
    )
    wait_until((tmp_path / "8x2-2.pids").exists)
    running.send_signal(signal_number)
    stderr = running.communicate(timeout=30)[1]
    assert running.returncode == (130 if signal_number == signal.SIGINT else -signal.SIGKILL)
    assert signal_number == signal.SIGKILL or b"interrupted" in stderr
    pids = [int(pid) for pid in (tmp_path / "8x2-2.pids").read_text().split()]
    wait_until(lambda: not any(alive(pid) for pid in pids))

    whole = out.read_bytes()
    assert [row.instance for row in rows.read(out)] == [0, 1]
    out.write_bytes(whole + whole.splitlines()[0][:100])  # as if it had been killed while writing
    (tmp_path / "behave").touch()
    assert subprocess.run(command, cwd=ROOT, env=env, capture_output=True).returncode == 0
    assert out.read_bytes().startswith(whole)
    assert [(row.instance, row.status) for row in rows.read(out)] == [(0, "ok"), (1, "ok"), (2, "ok")]


@pytest.mark.slow
def test_failed_rows_are_run_again_only_on_demand(tmp_path, monkeypatch):
    monkeypatch.setenv(FOLDER, str(tmp_path))
    measure(tmp_path, "raises", "deals")
    assert len(rows.read(tmp_path / "rows.jsonl")) == 2
    measure(tmp_path, "raises", "deals")
    assert len(rows.read(tmp_path / "rows.jsonl")) == 2
    measure(tmp_path, "raises", "deals", retry_failed=True)
    again = rows.read(tmp_path / "rows.jsonl")
    assert [row.method for row in again] == ["misbehaving:raises", "misbehaving:deals", "misbehaving:raises"]


@pytest.mark.slow
def test_a_solver_is_warmed_up_once_and_gets_its_own_seed(tmp_path):
    measure(tmp_path, "counts", instances=3, seconds=(0.1,), seed=40)
    results = rows.read(tmp_path / "rows.jsonl")
    reports = [json.loads(row.error.partition(": ")[2]) for row in results]
    assert reports == [[2, "8x2-0", 0.1, 40], [3, "8x2-1", 0.1, 41], [4, "8x2-2", 0.1, 42]]  # the first was the warm-up


@pytest.mark.slow
def test_a_worker_has_one_thread_and_one_core(tmp_path):
    report = json.loads(measure(tmp_path, "looks_around")["looks_around"].error.partition(": ")[2])
    assert set(ONE_THREAD.values()) == {"1"} and ONE_THREAD.items() <= report["threads"].items()
    assert report["leads"]
    assert report["cores"] is None or len(report["cores"]) == 1


@pytest.mark.slow
def test_workers_share_the_rows(tmp_path):
    workers = min(2, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count())
    measure(tmp_path, "deals", "raises", instances=3, workers=workers)
    results = rows.read(tmp_path / "rows.jsonl")
    assert len({row.key for row in results}) == len(results) == 6


@pytest.mark.slow
def test_a_journal_drops_a_torn_line_names_a_damaged_one_and_has_one_writer(tmp_path):
    path = tmp_path / "rows.jsonl"
    row = measure(tmp_path, "deals")["deals"]
    line = path.read_bytes()
    for torn in (b"", line[:-1], line[:-5], b"{", b"\x00\x00"):
        path.write_bytes(line + torn)
        with Journal(path) as journal:
            assert journal.rows == [row]
            with pytest.raises(ValueError, match="another run is writing to it"):
                Journal(path)
            journal.append(replace(row, instance=1))
        assert [r.instance for r in rows.read(path)] == [0, 1]
    path.write_bytes(line[:-9])  # nothing but a torn line
    with Journal(path) as journal:
        assert journal.rows == []
    assert path.read_bytes() == b""
    path.write_bytes(line + b"{}\n" + line)
    with pytest.raises(ValueError, match=r"rows\.jsonl:2: damaged line: expected an object with the fields"):
        Journal(path)
    assert path.read_bytes() == line + b"{}\n" + line


@pytest.mark.slow
def test_other_weights_are_not_mixed_in(tmp_path):
    row = measure(tmp_path, "deals")["deals"]
    ours = solvers.look_up("dan-greedy").versions()["weights"]
    assert len(ours) == 12
    path = tmp_path / "rows.jsonl"
    with Journal(path) as journal:
        journal.append(replace(row, method="dan-greedy", budget=None, versions={"weights": "0123456789ab"}))
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"rows of dan-greedy with weights 0123456789ab, now they are {ours}"):
        run("smoke", path, ("dan",))
    assert path.read_bytes() == before


@pytest.mark.slow
def test_table_3_is_measured_rounded_and_not(tmp_path):
    folder = tmp_path / "tsplib"
    folder.mkdir()
    corners = [(0, 0), (1, 1), (2, 0), (4, 2)] + [(4, 2)] * 47  # legs of 1.41, 1.41, 2.83, 0, ..., and home 4.47
    lines = [f"{i} {x} {y}" for i, (x, y) in enumerate(corners, start=1)]
    head = ["NAME: eil51", "TYPE: TSP", "DIMENSION: 51", "EDGE_WEIGHT_TYPE: EUC_2D", "NODE_COORD_SECTION"]
    (folder / "eil51.tsp").write_text("\n".join([*head, *lines, "EOF"]))
    one = [[0, *range(1, 51), 0]] + [[0, 0]] * 4
    assert suite.rounded_length(read_tsplib(folder / "eil51.tsp", 5), one) == 1 + 1 + 3 + 4
    assert suite.rounded_length(read_tsplib(folder / "eil51.tsp", 5), [[0, 2, 0]]) == 4

    run("3", tmp_path / "rows.jsonl", ("misbehaving:deals",), seconds=(0.1,), tsplib=folder)
    five, ten = rows.read(tmp_path / "rows.jsonl")
    assert (five.cell, ten.cell) == ("eil51x5", "eil51x10")
    # one of five agents has cities 1, 6, ...: to (1, 1), on to (4, 2) and home; another one goes by way of (2, 0)
    assert five.rounded_length == max(1 + 3 + 4, 2 + 3 + 4, 4 + 0 + 4)
    assert five.length == pytest.approx(2 + math.sqrt(8) + math.sqrt(20))
    assert five.makespan == pytest.approx(five.length / 4)

    with pytest.raises(ValueError, match="unknown cell 'eil76x5'; choose from"):
        run("3", tmp_path / "rows.jsonl", ("nearest",), tsplib=folder, cells=("eil76x5",))
    (folder / "eil51.tsp").rename(folder / "eil76.tsp")
    with pytest.raises(ValueError, match=r"eil76\.tsp: 76 nodes expected, got 51"):
        run("3", tmp_path / "rows.jsonl", ("nearest",), tsplib=folder)
    with pytest.raises(ValueError, match=r"none of eil51\.tsp, "):
        run("3", tmp_path / "rows.jsonl", ("nearest",), tsplib=tmp_path)
    with pytest.raises(ValueError, match="name its folder with --tsplib DIR"):
        run("3", tmp_path / "rows.jsonl", ("nearest",))


@pytest.mark.slow
def test_times_may_be_longer_than_a_machine_can_wait(tmp_path):
    times = {"limit": 1e30, "grace": 1e30, "warm_up": 1e30, "seconds": (1e30,)}
    assert measure(tmp_path, "deals", **times)["deals"].ok


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--methods", "magic"], "unknown solver 'magic'; choose from ["),
        (["--methods", ","], "name at least one solver"),
        (["--methods", "misbehaving:behaves"], "no solver at 'misbehaving:behaves'"),
        (["--methods", "no_such_module:solve"], "no solver at 'no_such_module:solve'"),
        (["--table", "4"], "unknown table '4'; choose from ["),
        (["--instances", "0"], "instances must be a whole number of at least 1, got 0"),
        (["--table", "3", "--instances", "2"], "table 3 has 1 instance in each cell, got instances = 2"),
        (["--cells", "9x9"], "unknown cell '9x9'; choose from ['8x2']"),
        (["--seconds", "0"], "seconds must be a finite number of seconds above 0, got 0.0"),
        (["--seed=-1"], "seed must be a whole number of at least 0, got -1"),
        (["--grace", "nan"], "grace must be a finite number of seconds above 0, got nan"),
        (["--workers", "0"], "workers must be a whole number of at least 1, got 0"),
        (["--workers", "100000"], "the number of cores, got 100000"),
        (["--out", "rows.jsonl.gz"], "rows.jsonl.gz: rows are appended to plain files only"),
        (["--out", "/dev/null"], "/dev/null: rows are appended to regular files only"),
    ],
)
def test_bad_input_is_one_line_and_changes_nothing(tmp_path, monkeypatch, capsys, options, message):
    monkeypatch.chdir(tmp_path)
    command = ["run", "--table", "smoke", "--methods", "misbehaving:deals", "--out", "rows.jsonl", *options]
    assert main(command) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and message in lines[0]
    assert not any(tmp_path.iterdir())
