"""Ctrl-C, SIGTERM and SIGHUP end `python -m train` with 130, 143 and 129; kill -9 leaves no process behind."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
from helpers.processes import alive, children, wait_until

from train import checkpoint, interrupts
from train.interrupts import ENDING, postponed

ROOT = Path(__file__).parent.parent
CODES = {signal.SIGINT: 130, signal.SIGTERM: 143}
SMALL = ["--n-nodes", "6", "7", "--n-agents", "2", "2", "--network.embed-dim", "16", "--validation-instances", "4",
         "--no-tensorboard", "--threads", "1"]  # fmt: skip
REINFORCE = ["reinforce", "quick", "--batch-size", "2", "--challenge-instances", "4", *SMALL]
IMITATE = ["imitate", "--nodes-per-agent", "2", "--set-tokens", "100", "--buffer", "4", *SMALL]


def train(*arguments, **options):
    """A running ``python -m train``, started with the ``options`` of Popen."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "train", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, **pipes, **options)


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
    _, errors = process.communicate(timeout=300)
    assert (process.returncode, errors) == (CODES[number], f"train: ended by {number.name}\n")


@pytest.mark.parametrize("number", CODES)
@pytest.mark.slow
def test_a_signal_during_a_challenge_saves_the_step(number, tmp_path):
    """Every step ends with a challenge on many instances, so that a signal after the first step comes during one."""
    many = ["--challenge-every", "1", "--challenge-instances", "2000", "--checkpoint-every", "1000"]
    process = train(*REINFORCE, *many, "--out", tmp_path)
    wait_until(lambda: steps(tmp_path) >= 1)
    process.send_signal(number)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == CODES[number]
    assert "Traceback" not in errors and errors.splitlines()[-1] == f"train: ended by {number.name}"
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == steps(tmp_path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.slow
def test_a_signal_to_the_whole_process_group_reaches_the_label_workers_too_and_the_run_is_saved(number, tmp_path):
    """Ctrl-C in a terminal, a job scheduler that ends a job, and a terminal that is closed send such signals.

    The buffer holds one set and its workers make one at a time, so that the run needs labels to finish its step.
    """
    few = ["--buffer", "1", "--sets-per-step", "1", "--passes", "0.01", "--teacher-iterations", "2000"]
    process = train(*IMITATE, *few, "--steps", 100000, "--out", tmp_path, start_new_session=True)
    wait_until(lambda: steps(tmp_path) >= 1)
    os.killpg(process.pid, number)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 128 + number, errors
    assert "Traceback" not in errors and errors.splitlines()[-1] == f"train: ended by {number.name}"
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == steps(tmp_path) >= 1


@pytest.mark.slow
def test_a_label_worker_that_dies_ends_the_run_and_the_other_workers(tmp_path):
    """As when memory runs out. The pool then sends SIGTERM to the others, which they heed if their parent sends it."""
    process = train(*IMITATE, "--steps", 100000, "--workers", 2, "--out", tmp_path)
    wait_until(lambda: steps(tmp_path) >= 1)
    started = children(process.pid)
    os.kill(next(pid for pid in started if "spawn_main" in " ".join(psutil.Process(pid).cmdline())), signal.SIGKILL)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 2
    assert errors.splitlines()[-1].startswith("train: error: a process that makes labels has died")
    wait_until(lambda: not any(map(alive, started)))


@pytest.mark.slow
def test_label_workers_end_with_their_killed_parent(tmp_path):
    process = train(*IMITATE, "--steps", 100000, "--workers", 1, "--out", tmp_path)
    wait_until(lambda: steps(tmp_path) >= 1)
    started = children(process.pid)
    assert any("spawn_main" in " ".join(psutil.Process(pid).cmdline()) for pid in started)
    process.kill()
    process.communicate()
    wait_until(lambda: not any(map(alive, started)))


@pytest.fixture
def seen():
    """The signals that reach the handlers from before a block that postpones them."""
    seen = []
    before = {number: signal.signal(number, lambda number, _: seen.append(number)) for number in ENDING}
    yield seen
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDING)
def test_a_postponed_signal_is_raised_once_after_the_block(seen, number):
    """Also if it comes twice, as under torchrun, which passes on the signals that its processes have got already."""
    with postponed(*ENDING) as caught:
        signal.raise_signal(number)
        signal.raise_signal(number)
        assert caught == [number, number] and seen == []
    assert seen == [number]


def test_a_later_ctrl_c_does_not_wait(seen, monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(interrupts.time, "monotonic", lambda: clock[0])
    with postponed(*ENDING):
        signal.raise_signal(signal.SIGTERM)
        clock[0] = 60.0
        signal.raise_signal(signal.SIGTERM)
        assert seen == []
        signal.raise_signal(signal.SIGINT)
        assert seen == [signal.SIGINT]


def test_ignored_signals_stay_ignored(seen):
    """As ``nohup`` ignores SIGHUP."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with postponed(*ENDING) as caught:
        signal.raise_signal(signal.SIGHUP)
        assert caught == []
    assert seen == []
