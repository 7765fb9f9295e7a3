"""``python -m mtsp_env`` says what is installed and plays a game."""

from __future__ import annotations

import importlib.metadata

import numpy as np
import pytest

import mtsp_env.__main__ as self_check
from mtsp_env import __version__


def test_it_prints_versions_and_plays(capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    def version(name: str) -> str:
        if name == "torch":
            raise importlib.metadata.PackageNotFoundError(name)
        return importlib.metadata.version(name)

    monkeypatch.setattr(self_check, "version", version)
    assert self_check.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"mtsp-env {__version__}, Python 3.")
    assert f"numpy {np.__version__}" in lines and "torch is not installed" in lines
    assert lines[-1].startswith("makespan ") and lines[-1].endswith("the tours are valid")


def test_the_game_is_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    makespan, bound = self_check.play(n_nodes=12, n_agents=2, seed=3)
    assert bound <= makespan < 2 * 12

    def refuse(*_: object) -> None:
        raise ValueError("city 3 missing from the tours")

    monkeypatch.setattr(self_check, "check_tours", refuse)
    with pytest.raises(ValueError, match="city 3 missing"):
        self_check.main()
