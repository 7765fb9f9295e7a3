"""Samples are drawn as surely as they are told to be."""

import numpy as np
import pytest

from benchmarks.__main__ import main
from dan_policy import solve
from dan_policy.solution import sample_clip
from mtsp_env import uniform


def test_without_a_clip_samples_take_the_one_of_their_size() -> None:
    instance = uniform(np.random.default_rng(0), 30, 3)
    plain = solve(instance, decode="sample", samples=4)
    assert solve(instance, decode="sample", samples=4, clip=sample_clip(10.0, 30)).tours == plain.tours
    with pytest.raises(ValueError, match=r"clip must be above 0, got 0\.0"):
        solve(instance, decode="sample", clip=0.0)


def test_the_surer_the_samples_the_more_alike() -> None:
    """With a C of 10,000 every sample is the greedy game; with one of 0.001 none is any good."""
    instance = uniform(np.random.default_rng(0), 30, 3)
    greedy = solve(instance)
    assert solve(instance, decode="sample", samples=2, clip=1e4).makespan == pytest.approx(greedy.makespan)
    assert solve(instance, decode="sample", samples=2, clip=1e-3).makespan > 1.5 * greedy.makespan


def test_the_table_compares_with_the_c_in_use(tmp_path, capsys) -> None:
    out = tmp_path / "clip.md"
    assert main(["clip", "--sizes", "8x2", "60x4", "--instances", "2", "--samples", "3", "--out", str(out)]) == 0
    rows = [line.split(" | ") for line in out.read_text().splitlines() if line.startswith(("| 8", "| 60"))]
    assert [(row[0], row[1]) for row in rows] == [
        ("| 8, 2", "5"), ("| 8, 2", "10"), ("| 8, 2", "20"), ("| 60, 4", "6"), ("| 60, 4", "12"), ("| 60, 4", "24")
    ]  # fmt: skip
    assert [row[3] == "– |" for row in rows] == [False, True, False] * 2
    assert main(["clip", "--instances", "1"]) == 2 and "at least 2, got 1" in capsys.readouterr().err
    assert main(["clip", "--sizes", "50"]) == 2 and "such as 50x5, got '50'" in capsys.readouterr().err
