"""The effects of the clip C and of the view, and the tables of all sweeps."""

import numpy as np
import pytest
import torch

from benchmarks.__main__ import main
from benchmarks.studies import sweeps
from benchmarks.suite import Cell
from dan_policy import solve
from dan_policy.heuristics import sampling_clip
from mtsp_env import uniform


@pytest.mark.slow
def test_the_default_clip_is_that_of_the_size() -> None:
    instance = uniform(np.random.default_rng(0), 30, 3)
    plain = solve(instance, decode="sample", samples=4)
    assert solve(instance, decode="sample", samples=4, clip=sampling_clip(10.0, 30)).tours == plain.tours
    with pytest.raises(ValueError, match=r"clip must be above 0, got 0\.0"):
        solve(instance, decode="sample", clip=0.0)


@pytest.mark.slow
def test_samples_differ_less_with_a_larger_clip() -> None:
    """With C = 10,000 every sample is the greedy game; with C = 0.001 samples are nearly random."""
    instance = uniform(np.random.default_rng(0), 30, 3)
    greedy = solve(instance)
    assert solve(instance, decode="sample", samples=2, clip=1e4).makespan == pytest.approx(greedy.makespan)
    assert solve(instance, decode="sample", samples=2, clip=1e-3).makespan > 1.5 * greedy.makespan


@pytest.mark.slow
def test_the_table_compares_with_the_c_in_use(tmp_path, capsys) -> None:
    out = tmp_path / "clip.md"
    assert main(["sweep-clip", "--sizes", "8x2", "60x4", "--instances", "2", "--samples", "3", "--out", str(out)]) == 0
    rows = [line.split(" | ") for line in out.read_text().splitlines() if line.startswith(("| 8", "| 60"))]
    assert [(row[0], row[1]) for row in rows] == [
        ("| 8, 2", "10"), ("| 8, 2", "5"), ("| 8, 2", "20"), ("| 60, 4", "12"), ("| 60, 4", "6"), ("| 60, 4", "24")
    ]  # fmt: skip
    assert [row[3] == "–" for row in rows] == [True, False, False] * 2
    assert main(["sweep-clip", "--instances", "1"]) == 2 and "at least 2, got 1" in capsys.readouterr().err
    assert main(["sweep-view", "--instances", "1000000000"]) == 2
    assert "instances must be at most 10000, got 1000000000" in capsys.readouterr().err
    assert main(["sweep-clip", "--sizes", "50"]) == 2 and "such as 50x5, got '50'" in capsys.readouterr().err


@pytest.mark.slow
def test_the_table_compares_with_seeing_everything(tmp_path) -> None:
    """Views that are not smaller than the instance are left out; smaller ones give other tours."""
    out = tmp_path / "view.md"
    assert main(["sweep-view", "--sizes", "40x3", "120x4", "--instances", "2", "--out", str(out)]) == 0
    lines = out.read_text().splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines if line.startswith(("| 40", "| 12"))]
    assert [(row[0], row[1]) for row in rows] == [
        ("40, 3", "40"),
        ("120, 4", "120"),
        ("120, 4", "100"),
        ("120, 4", "50"),
    ]
    assert [row[3] == "–" for row in rows] == [True, True, False, False]
    plans = [solve(one, "dan", view=50) for one in Cell(120, 4, 2).instances(sweeps.SEED)]
    assert float(rows[3][2]) == pytest.approx(np.mean([plan.makespan for plan in plans]), abs=1e-4)


@pytest.mark.slow
def test_the_table_compares_with_agents_that_look_for_themselves(tmp_path) -> None:
    out = tmp_path / "confidence.md"
    assert main(["sweep-confidence", "--sizes", "15x3", "--instances", "2", "--out", str(out)]) == 0
    rows = [line.strip("| ").split(" | ") for line in out.read_text().splitlines() if line.startswith("| 15")]
    assert [(row[1], row[3] == "–") for row in rows] == [
        ("1", True), ("0.99", False), ("0.97", False), ("0.95", False), ("0.9", False)
    ]  # fmt: skip
    plans = [solve(one, confidence=1.0) for one in Cell(15, 3, 2).instances(sweeps.SEED)]
    assert float(rows[0][2]) == pytest.approx(np.mean([plan.makespan for plan in plans]), abs=1e-4)


@pytest.mark.slow
def test_the_table_compares_ways_to_search_on_one_thread(tmp_path, monkeypatch) -> None:
    """The symmetries and the rounds never make tours longer, and the number of threads stays as it was."""
    threads, used, out = torch.get_num_threads(), set(), tmp_path / "search.md"
    plan = sweeps.solve
    monkeypatch.setattr(sweeps, "solve", lambda *args, **more: used.add(torch.get_num_threads()) or plan(*args, **more))
    options = ["--sizes", "15x3", "--instances", "2", "--samples", "3", "--rounds", "2", "5", "--out", str(out)]
    assert main(["sweep-search", *options]) == 0
    rows = [line.strip("| ").split(" | ") for line in out.read_text().splitlines() if line.startswith("| 15")]
    assert [row[1] for row in rows] == [
        *("greedy", "greedy x8", "best of 3 samples", "greedy x8, 2 rounds", "greedy x8, 5 rounds")
    ]
    greedy, symmetric, _, few, many = (float(row[2]) for row in rows)
    assert greedy >= symmetric >= few >= many
    assert used == {1} and torch.get_num_threads() == threads
    assert main(["sweep-search", "--rounds", "4", "-1", "--out", str(out)]) == 2
    assert len(used) == 1, "refused before anything is planned"
