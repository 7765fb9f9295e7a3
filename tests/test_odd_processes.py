"""The three commands as processes without standard streams, without docstrings, in a folder that is gone."""

import os
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from benchmarks.__main__ import main
from benchmarks.harness import rows
from mtsp_env import check_tours, read_instance, read_tours
from train import checkpoint

ROOT = Path(__file__).parent.parent
COMMANDS = {
    "mtsp": "dan_policy.cli solve {folder}/square.json --out {folder}/tours.json --plot {folder}/tours.png",
    "train": "train reinforce quick --batch-size 2 --n-nodes 5 6 --n-agents 2 2 --network.embed-dim 16 --threads 1 "
    "--challenge-instances 4 --validation-instances 4 --no-tensorboard --steps 2 --out {folder}/run",
    "benchmarks": "benchmarks run --table smoke --methods nearest --out {folder}/rows.jsonl",
}
pytestmark = pytest.mark.slow


def run(command, folder, options="", redirected="", place=None):
    """Run one of the commands by a shell, in the folder ``place`` or one that is gone before Python starts."""
    arguments = COMMANDS[command].format(folder=folder)
    python = f"{shlex.quote(sys.executable)} {options} -m {arguments} {redirected}"
    gone = "" if place else f"mkdir {folder}/gone && cd {folder}/gone && rmdir {folder}/gone && "
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    return subprocess.run(["sh", "-c", gone + python], cwd=place, env=environment, capture_output=True, text=True)


def check_results(command, folder):
    """What a command has written is whole."""
    if command == "mtsp":
        check_tours(read_instance(folder / "square.json"), read_tours(folder / "tours.json"))
        assert (folder / "tours.png").read_bytes().startswith(b"\x89PNG")
    elif command == "train":
        assert checkpoint.read(folder / "run" / "checkpoint.pt")["progress"]["step"] == 2
    else:
        results = rows.read(folder / "rows.jsonl")
        assert len(results) == 3 and all(row.ok for row in results)


@pytest.mark.parametrize("command", COMMANDS)
def test_without_standard_streams_a_command_works(command, folder):
    """What is opened first would take the places of the missing streams, and get what is printed."""
    done = run(command, folder, redirected="<&- >&- 2>&-", place=folder)
    assert done.returncode == 0
    check_results(command, folder)


def test_without_assertions_the_commands_work(folder):
    """In one process, because Python keeps no compiled files for this option where they may not be written."""
    commands = [COMMANDS[command].format(folder=folder).split() for command in COMMANDS]
    code = f"""
import runpy, sys
for module, *arguments in {commands}:
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-O", "-c", code], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for command in COMMANDS:
        check_results(command, folder)


@pytest.mark.parametrize("command", COMMANDS)
def test_without_docstrings_a_command_works_or_says_why_not(command, folder):
    """TorchRL cannot be imported then; ``benchmarks run`` starts its solvers without that option."""
    done = run(command, folder, options="-OO", place=folder)
    if command == "benchmarks":
        assert done.returncode == 0, done.stderr
        check_results(command, folder)
        return
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == (f"{command}: error: TorchRL cannot be imported without docstrings: run Python without -OO\n")


def test_without_docstrings_a_study_says_why_it_cannot_be_imported(monkeypatch, capsys):
    """TorchRL then adds to docstrings that are None."""
    monkeypatch.setattr("benchmarks.__main__.import_module", lambda name: None + "")
    monkeypatch.setattr("dan_policy.arguments.sys.flags", SimpleNamespace(optimize=2))
    assert main(["speed"]) == 2
    error = "benchmarks: error: TorchRL cannot be imported without docstrings: run Python without -OO\n"
    assert capsys.readouterr() == ("", error)


@pytest.mark.parametrize("command", COMMANDS)
def test_in_a_folder_that_is_gone_a_command_says_so(command, folder):
    """MKL, which multiplies PyTorch's matrices, would end the process."""
    done = run(command, folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"{command}: error: the working directory is gone: change to one that exists\n"


def test_training_goes_on_if_nobody_reads_its_progress(tmp_path):
    """As in ``python -m train ... 2>&1 | head -1``."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", *COMMANDS["train"].format(folder=tmp_path).split()]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, stdout=writer, stderr=writer, env=environment)
    os.close(writer)
    assert done.returncode == 0
    check_results("train", tmp_path)
