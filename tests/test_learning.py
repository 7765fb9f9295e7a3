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
from benchmarks.studies.variants import Budget, Variant
from benchmarks.suite import SEED, Cell
from train import checkpoint
from train.learner import checkpoint_path
from train.presets import QUICK, REFINE
from train.reinforce import reinforce
from train.supervised_config import ImitateConfig, ImproveConfig

CELL = Cell(50, 5, 3)
SECOND = Budget(1 / 60)


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(ablations, "SAMPLES", 2)
    monkeypatch.setattr(ablations, "CELLS", (CELL,))
    monkeypatch.setattr(ablations, "SIZES", {"n_nodes": (6, 8), "n_agents": (2, 2), "nodes_per_agent": 2})
    monkeypatch.setattr(ablations, "IMITATE", {"workers": 0, "set_tokens": 64, "buffer": 4})
    monkeypatch.setattr(
        ablations, "REGRETS", ablations.REGRETS | {"set_tokens": 64, "buffer": 4, "teacher_iterations": 5}
    )
    monkeypatch.setattr(ablations, "REFINE", replace(REFINE, batch_size=2, samples=2))
    monkeypatch.setattr(ablations, "ROLLOUT", ablations.ROLLOUT | {"batch_size": 4, "challenge_instances": 2})
    monkeypatch.setattr(ablations, "ImproveConfig", partial(ImproveConfig, batch_size=2, samples=2))
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


SMALL_DAN = Variant("DAN", network={"city_layers": 1, "agent_layers": 0})
SMALL_JOINT = Variant("joint", network={"n_layers": 1}, policy="joint", next_weight=0.5, assignment_weight=1.0)
ATTENTION_MODEL = "benchmarks.policies.attention_model:AttentionModel"


@pytest.mark.parametrize(
    ("variant", "weights"),
    [
        (replace(SMALL_DAN, stages=(("imitate", 0.7), ("reinforce", 0.3))), 825_088),
        (replace(SMALL_DAN, network={"city_layers": 1}), 1_022_848),
        (replace(SMALL_DAN, network={"city_layers": 1}, stages=(("reinforce", 1.0),)), 1_022_848),
        (replace(SMALL_DAN, network={}, stages=(("reinforce", 1.0),), policy=ATTENTION_MODEL), 710_272),
        *(
            (replace(SMALL_JOINT, stages=(("imitate", 0.5), (stage, 0.5))), 264_960)
            for stage in ("reinforce", "rollout", "improve", "regrets")
        ),
    ],
    ids=lambda value: "-".join([value.policy, *dict(value.stages)]) if isinstance(value, Variant) else "",
)
@pytest.mark.slow
def test_a_variant_is_trained_in_its_stages(small, tmp_path, variant, weights):
    result = ablations.train_and_evaluate(variant, SECOND, 0, tmp_path)
    assert list(result["steps"]) == [stage for stage, _ in variant.stages] and all(result["steps"].values())
    assert len(result["gaps"]["50x5"]["greedy"]) == len(result["gaps"]["50x5"]["sample"]) == 3
    assert result["seconds"] > 0 and result["weights"] == weights
    folders = ablations.stage_folders(variant, SECOND, 0, tmp_path)
    inits = [checkpoint.read(folder / "checkpoint.pt")["config"]["init"] for folder in folders]
    assert inits == [None, *(str(folder / "last.safetensors") for folder in folders[:-1])]


def test_stages_are_the_kinds_of_training_that_they_say(tmp_path):
    def config(stage):
        return ablations.stage_config(stage, SMALL_JOINT, Budget(0.15), 3, tmp_path, "joint")

    assert config("reinforce").baseline == "shared" and config("rollout").baseline == "rollout"
    episodes = [config(stage).batch_tokens * config(stage).samples for stage in ("reinforce", "rollout")]
    assert episodes[0] == episodes[1]
    assert (config("imitate").labels, config("imitate").roll_in) == ("tours", None)
    assert (config("regrets").labels, config("regrets").roll_in) == ("regrets", "joint")
    for stage in ("imitate", "improve", "regrets"):
        assert config(stage).anneal_seconds == 9.0 and config(stage).next_weight == 0.5
    for stage in ablations.TRAIN:
        assert (config(stage).seed, config(stage).init, config(stage).threads) == (3, "joint", 1)
        assert config(stage).n_nodes == ablations.SIZES["n_nodes"]


@pytest.mark.slow
def test_variants_that_begin_alike_share_what_they_begin_with(small, tmp_path):
    stages = (("imitate", 0.5), ("reinforce", 0.5))
    first, second = (
        ablations.train_and_evaluate(replace(SMALL_DAN, name=name, stages=stages[:count]), SECOND, 0, tmp_path)
        for name, count in (("first", 1), ("second", 2))
    )
    assert second["steps"]["imitate"] == first["steps"]["imitate"]
    assert second["seconds"] > first["seconds"]
    others = (
        replace(SMALL_DAN, network={}),
        replace(SMALL_DAN, policy="joint"),
        replace(SMALL_DAN, next_weight=0.5),
        replace(SMALL_DAN, assignment_weight=0.5),
        replace(SMALL_DAN, optimiser="muon"),
        replace(SMALL_DAN, stages=(("imitate", 0.4),)),
        replace(SMALL_DAN, stages=(("reinforce", 1.0),)),
    )
    budgets = (Budget(1.0), Budget(2.0), Budget(1.0, "steps"))
    every = [(SMALL_DAN, budget, 0) for budget in budgets]
    every += [(SMALL_DAN, Budget(1.0), 1), *((other, Budget(1.0), 0) for other in others)]
    assert len({ablations.stage_folders(*each, tmp_path)[0] for each in every}) == len(every)
    assert len({ablations.result_file(*each, tmp_path) for each in every}) == len(every)


@pytest.mark.slow
def test_dense_labels_are_those_of_the_variant(small, tmp_path):
    plain = replace(SMALL_JOINT, next_weight=0.0, assignment_weight=0.0, optimiser="muon")
    for variant, labelled in ((SMALL_JOINT, True), (plain, False)):
        assert ablations.train_and_evaluate(variant, SECOND, 0, tmp_path)["steps"]["imitate"] > 0
        (folder,) = ablations.stage_folders(variant, SECOND, 0, tmp_path)
        state = checkpoint.read(checkpoint_path(ImitateConfig(out=folder)))
        assert ("muon" in state["optimiser"]) is (variant.optimiser == "muon")
        for name in ("next_loss", "assignment_loss"):
            with next(folder.rglob(f"{name}.csv")).open() as file:
                losses = [float(row[1]) for row in csv.reader(file)]
            assert any(losses) is labelled, name


@pytest.mark.slow
def test_an_interrupted_variant_continues_where_it_stopped(small, tmp_path, monkeypatch):
    variant = replace(SMALL_DAN, stages=(("imitate", 0.5), ("reinforce", 0.5)))

    def interrupted(config):
        reinforce(replace(config, steps=2))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setitem(ablations.TRAIN, "reinforce", interrupted)
        ablations.train_and_evaluate(variant, SECOND, 0, tmp_path)
    folders = ablations.stage_folders(variant, SECOND, 0, tmp_path)
    before = [checkpoint.read(folder / "checkpoint.pt")["progress"]["step"] for folder in folders]
    steps = ablations.train_and_evaluate(variant, SECOND, 0, tmp_path)["steps"]
    assert steps["imitate"] == before[0]  # finished
    assert steps["reinforce"] > before[1] > 0  # continued, if only by the step that was begun


def write_outcome(variant, seed, gap, folder):
    """Write a made-up result."""
    gaps = {cell.label: {"greedy": [gap, 3 * gap], "sample": [gap / 10, 3 * gap / 10]} for cell in ablations.CELLS}
    steps = {stage: 1234 + 5 * number for number, (stage, _) in enumerate(variant.stages)}
    result = {"steps": steps, "seconds": 120.0, "weights": 1000, "gaps": gaps, "processor": f"Processor {seed}"}
    ablations.result_file(variant, Budget(2.0), seed, folder).write_text(json.dumps(result))


def test_a_table_has_a_line_for_each_variant(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(ablations.STUDIES, "dan", ablations.STUDIES["dan"][:2])
    for variant in ablations.STUDIES["dan"]:
        write_outcome(variant, 0, 0.1, tmp_path)
    ablations.main("dan", 2.0, None, (0,), tmp_path / "runs", tmp_path, tmp_path / "out" / "table.md")
    table = (tmp_path / "out" / "table.md").read_text()
    both = "| 20.0 ± 10.0 | 2.0 ± 1.0 "
    assert f"| imitation alone {3 * both}| 2.0 | imitate 1,234 | 1,000 |" in table.splitlines()
    assert f"REINFORCE {3 * both}| 2.0 | imitate 1,234, reinforce 1,239 | 1,000 |" in table
    assert "python -m benchmarks ablations --study dan --minutes 2 --seeds 0`" in table
    with pytest.raises(ValueError, match="name at least one seed"):
        ablations.main("dan", 2.0, None, (), tmp_path / "runs", tmp_path, tmp_path / "table.md")
    assert not (tmp_path / "table.md").exists()


def test_several_seeds_give_one_line_and_their_own_gaps(tmp_path, monkeypatch, capsys):
    (variant,) = variants = ablations.STUDIES["dense-labels"][:1]
    monkeypatch.setitem(ablations.STUDIES, "dense-labels", variants)
    for seed, gap in ((0, 0.1), (3, 0.2)):
        write_outcome(variant, seed, gap, tmp_path)
    ablations.main("dense-labels", 2.0, None, (0, 3), tmp_path / "runs", tmp_path, tmp_path / "table.md")
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert "on one thread (Processor 0 and Processor 3)" in lines[2]
    both = "| 30.0 ± 15.0 | 3.0 ± 1.5 "  # the mean of two seeds on instances with the gaps 15 % and 45 %
    assert f"| {variant.name} {3 * both}| 20.0, 40.0 | 2.0 | imitate 1,234 | 1,000 |" in lines


@pytest.mark.slow
def test_equal_steps_learn_from_the_same_instances(small, tmp_path):
    """Whatever the network and the labels; a folder for each budget; as many steps as asked for."""
    budget = Budget(3, "steps")
    instances = []
    for variant in (SMALL_DAN, SMALL_JOINT):
        assert ablations.train_and_evaluate(variant, budget, 0, tmp_path)["steps"] == {"imitate": 3}
        (folder,) = ablations.stage_folders(variant, budget, 0, tmp_path)
        progress = checkpoint.read(folder / "checkpoint.pt")["progress"]
        instances.append((progress["step"], progress["instances"]))
    assert instances[0] == instances[1]


def test_steps_are_for_variants_with_one_stage(tmp_path):
    with pytest.raises(ValueError, match="steps must be None for the study 'refinement'"):
        ablations.main("refinement", steps=5, folder=tmp_path / "runs", out=tmp_path / "table.md")
    with pytest.raises(ValueError, match="steps must be"):
        ablations.main("joint", steps=0, folder=tmp_path / "runs", out=tmp_path / "table.md")
    (variant,) = ablations.STUDIES["dense-labels"][:1]
    table = ablations._report("dense-labels", Budget(1_234_567, "steps"), (0,), [])
    assert "for 1234567 steps on one thread" in table and "--steps 1234567" in table and "labelling" not in table
    config = ablations.stage_config("imitate", variant, Budget(7, "steps"), 0, tmp_path, None)
    assert config.steps == 7 and config.anneal_seconds is None and config.seconds is None


def test_studies_compare_what_they_say():
    """Every combination of labels for the joint network; all kinds of refinement from the same start; equal time."""
    dense = ablations.STUDIES["dense-labels"]
    labels = [(v.next_weight > 0, v.assignment_weight > 0) for v in dense if v.policy == "joint"]
    assert sorted(labels) == [(False, False), (False, True), (True, False), (True, True)]
    assert {variant.stages for variant in dense} == {(("imitate", 1.0),)}
    refined = ablations.STUDIES["refinement"]
    assert [v.stages[-1][0] for v in refined] == ["imitate", "reinforce", "rollout", "improve", "regrets"]
    assert len({variant.learner for variant in refined}) == 1 and len({v.stages[0] for v in refined[1:]}) == 1
    for variants in ablations.STUDIES.values():
        assert len({variant.name for variant in variants}) == len(variants)
        assert len({(variant.learner, variant.stages) for variant in variants}) == len(variants)
        assert all(sum(share for _, share in variant.stages) == pytest.approx(1.0) for variant in variants)


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
    first = ablations.STUDIES["dan"][0]
    ablations.result_file(first, Budget(1.0), 0, tmp_path).write_text('{"steps": 1')
    with pytest.raises(ValueError, match=r"seed-0\.json: not a JSON file"):
        ablations.main(minutes=1.0, folder=tmp_path / "runs", results=tmp_path, out=tmp_path / "table.md")


@pytest.mark.parametrize("module", [ablations, curves])
@pytest.mark.parametrize("minutes", [0.0, -1.0, float("nan"), float("inf")])
def test_no_time_is_refused(module, minutes, tmp_path):
    with pytest.raises(ValueError, match="minutes must be a finite number of minutes above 0"):
        module.main(minutes=minutes, folder=tmp_path / "runs")
    assert not (tmp_path / "runs").exists()
