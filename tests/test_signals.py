"""Ctrl-C and SIGTERM end `python -m train` with 130 and 143 at any time; kill -9 leaves no process behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from helpers.processes import alive, children, wait_until

from train import checkpoint
from train.interrupts import postponed

ROOT = Path(__file__).parent.parent
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
SMALL = ["--n-nodes", "6", "7", "--n-agents", "2", "2", "--network.embed-dim", "16", "--validation-instances", "4",
         "--no-tensorboard", "--threads", "1"]  # fmt: skip
REINFORCE = ["reinforce", "quick", "--batch-size", "2", "--challenge-instances", "4", *SMALL]
IMITATE = ["imitate", "--nodes-per-agent", "2", "--set-tokens", "100", "--buffer", "4", *SMALL]


def train(*arguments):
    """A running ``python -m train``."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "train", *map(str, arguments)]
    return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def steps(folder):
    """The number of steps that a run has logged."""
    try:
        return len((folder / "logs" / "scalars" / "grad_norm.csv").read_text().splitlines())
    except FileNotFoundError:
        return 0


@pytest.mark.parametrize("number", CODES)
@pytest.mark.slow
def test_a_signal_while_everything_is_imported_ends_with_one_line(number, tmp_path):
    process = train(*REINFORCE, "--out", tmp_path / "run")
    maps = Path(f"/proc/{process.pid}/maps")
    wait_until(lambda: "libtorch" in maps.read_text())
    process.send_signal(number)
    _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (CODES[number], f"train: ended by {number.name}\n")


@pytest.mark.parametrize("number", CODES)
@pytest.mark.slow
def test_a_signal_during_a_challenge_saves_the_step(number, tmp_path):
    """Every step ends with a challenge on many instances, so that a signal after the first step comes during one."""
    many = ["--challenge-every", "1", "--challenge-instances", "2000", "--checkpoint-every", "1000"]
    process = train(*REINFORCE, *many, "--out", tmp_path)
    wait_until(lambda: steps(tmp_path) >= 1)
    process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == CODES[number]
    assert "Traceback" not in errors and errors.splitlines()[-1] == f"train: ended by {number.name}"
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == steps(tmp_path)


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_reaches_the_label_workers_too_and_the_run_is_saved(tmp_path):
    """A terminal sends SIGINT to the whole process group."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "train", *IMITATE, "--steps", "100000", "--out", str(tmp_path)],
        env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    wait_until(lambda: steps(tmp_path) >= 1)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Traceback" not in errors and errors.splitlines()[-1] == "train: ended by SIGINT"
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == steps(tmp_path)


@pytest.mark.slow
def test_label_workers_end_with_their_killed_parent(tmp_path):
    process = train(*IMITATE, "--steps", 100000, "--workers", 2, "--out", tmp_path)
    wait_until(lambda: steps(tmp_path) >= 1)
    started = children(process.pid)
    assert len(started) >= 2
    process.kill()
    process.communicate()
    wait_until(lambda: not any(map(alive, started)))


def test_a_postponed_signal_is_raised_after_the_block():
    seen = []
    before = signal.signal(signal.SIGTERM, lambda number, _: seen.append(number))
    try:
        with postponed(signal.SIGTERM) as caught:
            signal.raise_signal(signal.SIGTERM)
            assert caught == [signal.SIGTERM] and seen == []
        assert seen == [signal.SIGTERM]
        with postponed(signal.SIGTERM):
            signal.raise_signal(signal.SIGTERM)
            signal.raise_signal(signal.SIGTERM)  # the second does not wait
            assert seen == [signal.SIGTERM] * 2
    finally:
        signal.signal(signal.SIGTERM, before)
