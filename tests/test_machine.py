"""Memory: containers' limits count, and sizes that do not fit are refused with the largest that does."""

from pathlib import Path

import numpy as np
import psutil
import pytest

from mtsp_env import machine


def test_available_memory_is_within_that_of_the_machine() -> None:
    assert 0 < machine.available_memory() <= psutil.virtual_memory().total


@pytest.mark.parametrize(("text", "limited"), [(str(2**62), False), ("max\n", False), (None, False), ("1000\n", True)])
def test_the_limit_of_a_container_counts(tmp_path: Path, monkeypatch, text: str | None, limited: bool) -> None:
    file = tmp_path / "memory.max"
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr(machine, "CGROUP_LIMITS", (file,))
    assert (machine.available_memory() == 0) == limited


def test_sizes_that_do_not_fit_are_refused_with_the_largest_that_does(monkeypatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 2**30)
    machine.check_memory("samples", 2**20, 2**10)
    with pytest.raises(
        ValueError, match="samples 1048577 needs about 1 GiB of memory, of which 1 GiB are free; at most "
    ):
        machine.check_memory("samples", 2**20 + 1, 2**10)
    with pytest.raises(ValueError, match=r"at most 1048576 fits$"):
        machine.check_memory("samples", 10**30, 2**10)


def test_small_sizes_are_accepted_without_a_look_at_the_memory(monkeypatch) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: pytest.fail("looked"))
    machine.check_memory("n_nodes", np.int64(1000), 2000)
