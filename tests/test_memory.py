"""The study of memory runs every case and notices growth."""

import mmap

import pytest

from benchmarks.__main__ import main
from benchmarks.studies import memory
from train import logs


@pytest.mark.slow
def test_logs_are_closed_before_their_folder_is_deleted(monkeypatch):
    """Else the thread of TensorBoard may write to it meanwhile."""
    closed = []

    class NotedLogs(logs.Logs):
        def __init__(self, folder, step, tensorboard):
            super().__init__(folder, step, tensorboard)
            self.folder = folder

        def close(self):
            super().close()
            closed.append(self.folder.exists())

    monkeypatch.setattr(logs, "Logs", NotedLogs)
    memory.measure("training steps", 10)
    assert closed == [True]


@pytest.mark.parametrize("name", memory.CASES)
@pytest.mark.slow
def test_every_case_runs(name):
    measured = memory.measure(name, 10)
    assert 0 < measured.warm <= measured.peak and measured.end <= measured.peak and measured.seconds > 0


def test_growth_is_noticed(monkeypatch):
    def leak():
        kept = []
        while True:
            kept.append(mmap.mmap(-1, 2**20))  # new pages, never ones that the process has freed before
            kept[-1].write(b"x" * 2**20)
            yield

    monkeypatch.setitem(memory.CASES, "leak", (leak, 50))
    measured = memory.measure("leak", 50)
    assert 30 * 2**20 < measured.end - measured.warm < 80 * 2**20


def test_bad_input_is_named(capsys):
    assert main(["memory", "--share", "0.0001"]) == 2
    assert "rounds of 'AEC episodes' must be a whole number of at least 10, got 2" in capsys.readouterr().err
    for share in ("nan", "inf", "0"):
        assert main(["memory", "--share", share]) == 2
        assert "share must be a finite number above 0, got" in capsys.readouterr().err
    assert main(["memory", "--cases", "nothing"]) == 2
    assert "unknown case 'nothing'; choose from" in capsys.readouterr().err
