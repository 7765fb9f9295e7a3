"""Ablations and learning curves, on tiny sizes and for seconds: what is trained, evaluated, saved and resumed."""

import csv
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from benchmarks import best_known
from benchmarks.policies import nearest
from benchmarks.studies import ablations, curves
from benchmarks.suite import SEED, Cell
from train import checkpoint
from train.learner import checkpoint_path
from train.presets import QUICK, REFINE
from train.supervised_config import ImitateConfig

CELL = Cell(50, 5, 3)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(ablations, "SAMPLES", 2)
    monkeypatch.setattr(ablations, "CELLS", (CELL,))
    monkeypatch.setattr(ablations, "SIZES", {"n_nodes": (6, 8), "n_agents": (2, 2), "nodes_per_agent": 2})
    monkeypatch.setattr(ablations, "ImitateConfig", partial(ImitateConfig, set_tokens=64, buffer=4))
    monkeypatch.setattr(ablations, "REFINE", replace(REFINE, batch_size=2, samples=2))
    monkeypatch.setitem(curves.SETTING, "n_nodes", (6, 6))
    monkeypatch.setitem(curves.SETTING, "n_agents", (2, 2))
    monkeypatch.setitem(curves.SETTING, "validation_instances", 8)


@pytest.mark.slow
def test_gaps_are_to_the_best_known_tours():
    class Nearest(torch.nn.Module):
        def forward(self, cities, agents, visited):
            return nearest.nearest(cities, agents, visited)

    gaps = {decode: ablations.gaps(Nearest(), CELL, decode) for decode in ("greedy", "sample")}
    known = best_known.read(CELL, SEED)
    assert len(known) == len(gaps["greedy"]) == 3
    assert all(gap > 0.05 for gap in gaps["greedy"])
    assert all(gap > -1e-6 for gap in gaps["sample"])


@pytest.mark.parametrize(
    ("variant", "stages"),
    [
        (ablations.Variant("both", network={"city_layers": 1, "agent_layers": 0}), (True, True)),
        (ablations.Variant("taught", imitation=1.0, network={"city_layers": 1}), (True, False)),
        (ablations.Variant("alone", imitation=0.0, network={"city_layers": 1}), (False, True)),
        (
            ablations.Variant("other", imitation=0.0, policy="benchmarks.policies.attention_model:AttentionModel"),
            (False, True),
        ),
    ],
)
@pytest.mark.slow
def test_a_variant_is_trained_in_its_stages(small, tmp_path, variant, stages):
    result = ablations.train_and_evaluate(variant, 1.0, 0, tmp_path)
    assert (result["imitation_steps"] > 0, result["reinforce_steps"] > 0) == stages
    assert len(result["gaps"]["50x5"]["greedy"]) == len(result["gaps"]["50x5"]["sample"]) == 3
    assert result["seconds"] > 0
    weights = {"both": 825_088, "taught": 1_022_848, "alone": 1_022_848, "other": 710_272}
    assert result["weights"] == weights[variant.name]


@pytest.mark.slow
def test_dense_labels_are_those_of_the_variant(small, tmp_path):
    weighted = ablations.Variant("w", 1.0, {"n_layers": 1}, "joint", next_weight=0.5, assignment_weight=1.0)
    plain = ablations.Variant("p", 1.0, {"n_layers": 1, "distances": True}, "joint", optimiser="muon")
    for variant, labelled in ((weighted, True), (plain, False)):
        result = ablations.train_and_evaluate(variant, 1.0, 0, tmp_path / variant.name)
        assert result["imitation_steps"] > 0
        state = checkpoint.read(checkpoint_path(ImitateConfig(out=tmp_path / variant.name / "imitation")))
        assert ("muon" in state["optimiser"]) is (variant.optimiser == "muon")
        for name in ("next_loss", "assignment_loss"):
            with next((tmp_path / variant.name).rglob(f"{name}.csv")).open() as file:
                losses = [float(row[1]) for row in csv.reader(file)]
            assert any(losses) is labelled, name


@pytest.mark.slow
def test_an_interrupted_variant_continues_where_it_stopped(small, tmp_path):
    variant = ablations.Variant("taught", 1.0, {"city_layers": 1})
    first = ablations.train_and_evaluate(variant, 0.5, 0, tmp_path)
    again = ablations.train_and_evaluate(variant, 0.5, 0, tmp_path)
    assert again["imitation_steps"] == first["imitation_steps"] + 1  # no time was left, except for the step begun
    longer = ablations.train_and_evaluate(variant, again["seconds"] + 0.5, 0, tmp_path)
    assert longer["imitation_steps"] > again["imitation_steps"]
    assert longer["seconds"] >= again["seconds"] + 0.5


def outcome(variant, seed, gap, minutes=2.0):
    """A made-up result."""
    gaps = {cell.label: {"greedy": [gap, 3 * gap], "sample": [gap / 10, 3 * gap / 10]} for cell in ablations.CELLS}
    rest = {"reinforce_steps": 7, "seconds": 120.0, "weights": 1000, "gaps": gaps, "imitation_steps": 1234}
    return {"minutes": minutes, "seed": seed, "name": variant.name} | rest


def test_saved_results_are_reused_by_the_same_run_only(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(ablations.STUDIES, "dan", ablations.DAN_VARIANTS[:2])
    for number, variant in enumerate(ablations.DAN_VARIANTS[:2]):
        (tmp_path / f"dan-{number}-seed0.json").write_text(json.dumps(outcome(variant, 0, 0.1)))
    ablations.main("dan", 2.0, (0,), tmp_path, tmp_path / "out" / "table.md")
    table = (tmp_path / "out" / "table.md").read_text()
    both = "| 20.0 ± 10.0 | 2.0 ± 1.0 "
    assert f"| imitation alone {3 * both}| 2.0 | 1,234 | 7 | 1,000 |" in table.splitlines()
    assert "python -m benchmarks ablations --study dan --minutes 2 --seeds 0`" in table
    with pytest.raises(ValueError, match="belongs to another run"):
        ablations.main("dan", 3.0, (0,), tmp_path, tmp_path / "table.md")
    assert not (tmp_path / "table.md").exists()
    with pytest.raises(ValueError, match="name at least one seed"):
        ablations.main("dan", 2.0, (), tmp_path, tmp_path / "table.md")


def test_several_seeds_give_one_line_and_their_own_gaps(tmp_path, monkeypatch, capsys):
    (variant,) = variants = ablations.DENSE_LABELS[:1]
    monkeypatch.setitem(ablations.STUDIES, "dense-labels", variants)
    for seed, gap in ((0, 0.1), (3, 0.2)):
        (tmp_path / f"dense-labels-0-seed{seed}.json").write_text(json.dumps(outcome(variant, seed, gap)))
    ablations.main("dense-labels", 2.0, (0, 3), tmp_path, tmp_path / "table.md")
    lines = (tmp_path / "table.md").read_text().splitlines()
    both = "| 30.0 ± 15.0 | 3.0 ± 1.5 "  # the mean of two seeds on instances with the gaps 15 % and 45 %
    assert f"| {variant.name} {3 * both}| 20.0, 40.0 | 2.0 | 1,234 | 7 | 1,000 |" in lines


def test_the_study_of_dense_labels_has_every_combination_for_the_joint_network():
    joint = [variant for variant in ablations.DENSE_LABELS if variant.policy == "joint"]
    labels = {(variant.next_weight > 0, variant.assignment_weight > 0) for variant in joint}
    assert labels == {(False, False), (True, False), (False, True), (True, True)} and len(joint) == 4
    assert {variant.imitation for variant in ablations.DENSE_LABELS} == {1.0}


@pytest.mark.slow
def test_curves_are_trained_until_their_time_is_over(small, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(curves, "QUICK", replace(QUICK, batch_size=4, challenge_instances=4))
    imitate, reinforce = curves.imitate, curves.reinforce
    monkeypatch.setattr(curves, "reinforce", lambda config: reinforce(replace(config, validate_every=1)))
    monkeypatch.setattr(curves, "imitate", lambda config: imitate(replace(config, validate_every=1, set_tokens=64)))
    curves.main(0.02, tmp_path / "runs", tmp_path)
    with (tmp_path / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    by_name = {name: [row for row in rows if row["method"] == name] for name in {row["method"] for row in rows}}
    assert set(by_name) == {"REINFORCE from scratch", "imitation", "reference solver"}
    teacher = float(by_name["reference solver"][0]["validation_cost"])
    for name in ("REINFORCE from scratch", "imitation"):
        seconds = [float(row["seconds"]) for row in by_name[name]]
        assert seconds[-1] >= 1.2 and np.all(np.diff(seconds) > 0)
        assert all(float(row["validation_cost"]) > teacher for row in by_name[name])
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")

    before = (tmp_path / "curves.csv").read_text()
    curves.main(0.02, tmp_path / "runs", tmp_path)  # nothing is left to train
    assert (tmp_path / "curves.csv").read_text() == before
    spent = max(float(row["seconds"] or 0.0) for row in rows)  # on a busy machine one step may be longer than all
    curves.main(spent / 60 + 0.02, tmp_path / "runs", tmp_path)
    assert len((tmp_path / "curves.csv").read_text()) > len(before)


@pytest.mark.slow
def test_curves_that_were_killed_before_their_first_checkpoint_are_begun_again(small, tmp_path, monkeypatch):
    often = {"validate_every": 1, "steps": 2}
    reinforce, imitate = curves.reinforce, curves.imitate
    monkeypatch.setattr(curves, "QUICK", replace(QUICK, batch_size=4, challenge_instances=4))
    monkeypatch.setattr(curves, "reinforce", lambda config: reinforce(replace(config, **often)))
    monkeypatch.setattr(curves, "imitate", lambda config: imitate(replace(config, set_tokens=64, **often)))
    for name in ("reinforce", "imitate"):
        (tmp_path / "runs" / name / "logs").mkdir(parents=True)
    curves.main(0.1, tmp_path / "runs", tmp_path)
    assert (tmp_path / "curves.csv").exists()


def test_damaged_results_are_named(tmp_path):
    (tmp_path / "dan-0-seed0.json").write_text('{"minutes": 1')
    with pytest.raises(ValueError, match=r"dan-0-seed0\.json: not a JSON file"):
        ablations.main(minutes=1.0, folder=tmp_path, out=tmp_path / "table.md")


@pytest.mark.parametrize("module", [ablations, curves])
@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), float("inf")])
def test_no_time_is_refused(module, minutes, tmp_path):
    with pytest.raises(ValueError, match="minutes must be a finite number of minutes above 0"):
        module.main(minutes=minutes, folder=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
