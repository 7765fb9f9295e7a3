"""Runs that are killed at random moments and resumed end like runs that were not; a full disk costs no file.

FAULT_ROUNDS sets how often a run is killed: once by default, so that the suite stays short. Releases are tested with
``FAULT_ROUNDS=20 python -m pytest tests/test_faults.py``.
"""

import os
import random
import resource
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.processes import wait_until
from helpers.states import same
from made_up import one_agent_does_it_all, row
from matplotlib.figure import Figure
from tiny import TINY

from benchmarks.files import write_text
from benchmarks.harness import rows
from benchmarks.harness.journal import Journal
from benchmarks.leaderboard import submission
from benchmarks.reports import plots
from dan_policy import DAN, load, save
from mtsp_env import write_instance, write_tours
from mtsp_env.distributions import sample
from mtsp_env.render import animate, save_page, save_picture
from train import checkpoint
from train.__main__ import main
from train.logs import Logs

ROOT = Path(__file__).parent.parent
ROUNDS = int(os.environ.get("FAULT_ROUNDS", "1"))
STEPS_PER_ROUND = 12
SMALL = ["--n-nodes", "6", "8", "--n-agents", "2", "2", "--network.embed-dim", "16", "--network.feedforward-dim", "16",
         "--validation-instances", "4", "--no-tensorboard", "--threads", "1", "--checkpoint-every", "1",
         "--validate-every", "3", "--steps", str(STEPS_PER_ROUND * (ROUNDS + 1))]  # fmt: skip
COMMANDS = {
    "reinforce": ["reinforce", "quick", "--batch-size", "2", "--challenge-instances", "4", "--challenge-every", "5"],
    "imitate": ["imitate", "--nodes-per-agent", "2", "--set-tokens", "100", "--buffer", "4", "--workers", "1"],
}


def start(*arguments, **environment):
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = os.environ | {"PYTHONPATH": paths, "OMP_NUM_THREADS": "1"} | environment
    command = [sys.executable, "-m", *map(str, arguments)]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def kill_at_random(process, lines, rng):
    """Kill a process a moment after ``lines()``, what it has written so far, has grown by some lines."""
    goal = lines() + rng.randint(2, STEPS_PER_ROUND // 3)  # after one line there may be no checkpoint yet
    wait_until(lambda: lines() >= goal or process.poll() is not None, seconds=600)
    moment = time.monotonic() + rng.uniform(0.0, 0.1)
    while time.monotonic() < moment:
        pass
    process.kill()
    errors = process.communicate()[1]
    assert process.returncode == -9, errors


def count_lines(file):
    return file.read_bytes().count(b"\n") if file.exists() else 0


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.slow
def test_a_run_that_is_killed_and_resumed_ends_like_one_that_is_not(tmp_path, command):
    rng = random.Random(command)
    run = [*COMMANDS[command], *SMALL, "--out"]
    assert main([*run, str(tmp_path / "whole")]) == 0
    file = tmp_path / "killed" / "logs" / "scalars" / "grad_norm.csv"
    for _ in range(ROUNDS):
        resumed = ["--resume"] if (tmp_path / "killed" / "checkpoint.pt").exists() else []
        kill_at_random(start("train", *run, tmp_path / "killed", *resumed), lambda: count_lines(file), rng)
    assert main([*run, str(tmp_path / "killed"), "--resume"]) == 0
    assert same(*(dict(load(tmp_path / name / "last.safetensors").state_dict()) for name in ("whole", "killed")))
    one, other = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "killed"))
    for state in (one, other):
        del state["config"], state["progress"]["seconds"]
    assert same(one, other)
    assert not list((tmp_path / "killed").glob(".*.tmp"))
    for name in ("grad_norm", "validation_cost"):  # every step once, with the same numbers
        assert (tmp_path / f"killed/logs/scalars/{name}.csv").read_text() == (
            tmp_path / f"whole/logs/scalars/{name}.csv"
        ).read_text()


@pytest.mark.slow
def test_rows_of_a_killed_benchmark_run_are_complete_and_measured_once(tmp_path):
    rng, out = random.Random(1), tmp_path / "rows.jsonl"
    budgets = [f"{0.1 + number / 1000:g}" for number in range(20 * (ROUNDS + 1))]
    run = [
        "benchmarks",
        "run",
        "--table",
        "smoke",
        "--methods",
        "misbehaving:deals",
        "--out",
        out,
        "--seconds",
        *budgets,
    ]
    kept = b""
    for _ in range(ROUNDS):
        kill_at_random(start(*run), lambda: count_lines(out), rng)
        now = out.read_bytes()
        assert now.startswith(kept)
        kept = now[: now.rfind(b"\n") + 1]
    last = start(*run)
    errors = last.communicate()[1]
    assert last.returncode == 0, errors
    results = rows.read(out)
    assert out.read_bytes().startswith(kept) and all(row.ok for row in results)
    assert len(results) == len({row.key for row in results}) == 3 * len(budgets)


# A full disk: files of this process may not grow beyond 1 KiB, which gives an OSError as a full disk does


@contextmanager
def full_disk():
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


INSTANCE = sample("uniform", np.random.default_rng(0), 1, 500, 2).instance(0, "large")
TOURS = [[0, *range(1, 250), 0], [0, *range(250, 500), 0]]
FEW = sample("uniform", np.random.default_rng(0), 1, 3, 2).instance(0, "small")
SUBMISSION = submission.Submission(
    "mine", "me", "uniform", "map", "a machine", {"500x2": submission.CellResult([TOURS], 1.0)}
)
WRITERS = {
    "a.json": lambda path: write_instance(path, INSTANCE),
    "tours.json": lambda path: write_tours(path, TOURS),
    "tours.png": lambda path: save_picture(path, INSTANCE, TOURS),
    "tours.html": lambda path: save_page(path, INSTANCE, TOURS),
    "tours.gif": lambda path: animate(path, FEW, [[0, 1, 0], [0, 2, 0]], seconds=0.2),
    "tours.mp4": lambda path: animate(path, FEW, [[0, 1, 0], [0, 2, 0]], seconds=0.2),
    "submission.json": lambda path: submission.write(path, SUBMISSION),
    "net.safetensors": lambda path: save(path, DAN(TINY.network)),
    "checkpoint.pt": lambda path: checkpoint.write(path, {"a": torch.arange(1000)}),
    "report.md": lambda path: write_text(path, "x" * 5000),
    "plot.png": lambda path: plots.save(Figure(), path),
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.slow
def test_a_full_disk_leaves_the_old_file(tmp_path, name):
    if name.endswith(".mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")
    path = tmp_path / name
    path.write_bytes(b"old")
    with full_disk(), pytest.raises(OSError, match=r"File too large|ffmpeg failed with exit code"):
        WRITERS[name](path)
    assert path.read_bytes() == b"old"
    assert set(os.listdir(tmp_path)) <= {name, "checkpoint.previous.pt"}
    WRITERS[name](path)
    assert path.stat().st_size > 1024


def test_a_full_disk_loses_only_the_row_that_did_not_fit(tmp_path):
    path = tmp_path / "rows.jsonl"
    few = sample("uniform", np.random.default_rng(0), 1, 8, 2).instance(0)
    one, other = (row(few, one_agent_does_it_all(few), number) for number in (0, 1))
    with Journal(path) as journal:
        journal.append(one)
        with full_disk(), pytest.raises(OSError, match="File too large"):
            while True:
                journal.append(other)
    with Journal(path) as journal:
        assert journal.rows[0] == one and set(map(str, journal.rows[1:])) == {str(other)}
        journal.append(one)
    assert rows.read(path) == [*journal.rows, one]


def test_a_full_disk_loses_only_the_rows_of_the_log_that_did_not_fit(tmp_path):
    logs = Logs(tmp_path, 0, tensorboard=False)
    with full_disk(), pytest.raises(OSError, match="File too large"):
        for step in range(1, 1000):
            logs.write(step, {"cost": 1 / step})
    file = tmp_path / "logs" / "scalars" / "cost.csv"
    Logs(tmp_path, step, tensorboard=False).close()
    assert file.read_text().splitlines() == [f"{number},{1 / number}" for number in range(1, step)]


@pytest.mark.slow
def test_training_on_a_full_disk_ends_with_one_line_and_can_be_resumed(tmp_path, capsys):
    small = ["--n-nodes", "5", "6", "--batch-size", "4", "--network.embed-dim", "16", "--challenge-instances", "4",
             "--validation-instances", "4", "--no-tensorboard", "--checkpoint-every", "1"]  # fmt: skip
    run = ["reinforce", "quick", *small, "--out", str(tmp_path / "run")]
    assert main([*run, "--steps", "1"]) == 0
    before = checkpoint.read(tmp_path / "run" / "checkpoint.pt")
    with full_disk():
        assert main([*run, "--steps", "3", "--resume"]) == 2
    printed = capsys.readouterr().err.splitlines()
    assert printed[-1].startswith("train: error: [Errno 27] File too large")
    assert same(checkpoint.read(tmp_path / "run" / "checkpoint.pt"), before)
    assert main([*run, "--steps", "3", "--resume"]) == 0
    assert main(["reinforce", "quick", *small, "--out", str(tmp_path / "whole"), "--steps", "3"]) == 0
    assert same(*(checkpoint.read(tmp_path / name / "checkpoint.pt")["network"] for name in ("run", "whole")))
