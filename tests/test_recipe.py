"""A recipe is read with every mistake named; its stages follow one another, and resume bit for bit."""

import json
import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers.states import same

from dan_policy import load, save
from dan_policy.joint import JointConfig, JointDAN
from dan_policy.registry import load_extra
from train import checkpoint
from train.__main__ import main
from train.imitate import ImitationLearner
from train.improve import ImproveLearner
from train.loop import sole_writer
from train.presets import REFINE
from train.recipe import PREVIOUS, UNLIMITED, read_recipe
from train.reinforce import ReinforceLearner
from train.reinforce_config import ReinforceConfig
from train.stages import recipe
from train.supervised_config import ImitateConfig, ImproveConfig

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

RECIPES = sorted((Path(__file__).parent.parent / "train" / "recipes").glob("*.toml"))
SHARED = """
[shared]
policy = "joint"
joint = {embed_dim = 16, feedforward_dim = 32, n_heads = 2, n_layers = 1}
n_nodes = [6, 9]
n_agents = [1, 3]
nodes_per_agent = 2
validation_instances = 8
validate_every = 2
checkpoint_every = 2
average = 0.5
tensorboard = false
"""
IMITATION = "{set_tokens = 100, buffer = 3, sets_per_step = 2, workers = 0, teacher_iterations = 20, warmup = 2"
STAGES = f"""
[[stages]]
name = "first"
command = "imitate"
options = {IMITATION}, steps = 4}}

[[stages]]
name = "roll-in"
command = "imitate"
options = {IMITATION}, steps = 3, roll_in = "previous"}}

[[stages]]
name = "refine"
command = "reinforce"
preset = "refine"
share = 0.25
options = {{steps = 3, batch_size = 2, samples = 3, challenge_instances = 4, warmup = 2, distances = true}}

[[stages]]
name = "improve"
command = "improve"
options = {{steps = 3, batch_size = 2, samples = 3, warmup = 2}}
"""
FOLDERS = ["first", "roll-in", "refine", "improve"]
FINAL = dict.fromkeys(FOLDERS, "best.safetensors") | {"refine": "mixed.safetensors"}  # what a stage ends with


@pytest.fixture
def written(tmp_path):
    """A function that writes a recipe and returns its path."""

    def write(text):
        path = tmp_path / "recipe.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def tiny(written):
    return written(SHARED + STAGES)


@pytest.fixture
def one_stage(written):
    return written(SHARED + STAGES[: STAGES.index("[[stages]]", 20)])


def log_of(out):
    return json.loads((out / "log.json").read_text())


def test_a_recipe_is_read_into_configurations(tiny):
    first, roll_in, refine, improve = (stage.config for stage in read_recipe(tiny))
    assert (type(first), type(refine), type(improve)) == (ImitateConfig, ReinforceConfig, ImproveConfig)
    assert first.joint == JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1)
    assert first.init is None and first.roll_in is None and first.n_nodes == (6, 9)
    assert roll_in.init == roll_in.roll_in == refine.init == improve.init == PREVIOUS
    assert (refine.baseline, refine.normalise, refine.speed) == (REFINE.baseline, REFINE.normalise, REFINE.speed)
    assert (refine.samples, refine.steps, refine.n_agents) == (3, 3, (1, 3))
    assert [stage.share for stage in read_recipe(tiny)] == [1.0, 1.0, 0.25, 1.0]


def test_a_budget_in_seconds_alone_sets_no_limit_on_steps_and_anneals(written):
    stages = read_recipe(
        written(SHARED + STAGES.replace("steps = 4", "seconds = 60").replace("steps = 3", "seconds = 5"))
    )
    assert all(stage.config.steps == UNLIMITED for stage in stages)
    assert [getattr(stage.config, "anneal_seconds", None) for stage in stages] == [60.0, 5.0, None, 5.0]


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_the_recipes_that_come_with_the_project_are_valid(path):
    stages = read_recipe(path)
    assert [stage.command for stage in stages] == ["imitate", "reinforce", "imitate", "imitate"]
    assert [getattr(stage.config, "labels", None) for stage in stages] == ["tours", None, "regrets", "regrets"]
    assert all(stage.config.roll_in == PREVIOUS for stage in stages[2:])
    assert all(stage.config.joint.distances for stage in stages)
    assert {stage.config.policy for stage in stages} == {"joint"}
    assert {stage.config.precision for stage in stages} == {"bfloat16"}
    assert all(stage.config.seconds for stage in stages)
    assert [stage.share for stage in stages] == [1.0, 0.35, 1.0, 1.0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[shared]", "[shared", "not a TOML file"),
        ("[shared]", "[common]", r"unknown key 'common'; choose from \['shared', 'stages'\]"),
        (STAGES, "", "stages is missing"),
        (SHARED + STAGES, "stages = []", "stages must be a list of at least 1 stage, got"),
        ('name = "first"', "", "stage 1: name is missing"),
        ('name = "first"', 'name = "../up"', r"stage 1: name must consist of letters.*'\.\./up'"),
        ('name = "roll-in"', 'name = "first"', "stage 2: name must differ from the other stages', got 'first'"),
        ('command = "improve"', 'command = "imprve"', r"unknown command 'imprve'; choose from \['imitate', 'improve'"),
        (
            'preset = "refine"',
            'preset = "refined"',
            r"preset must be one of \['paper', 'quick', 'refine'\] of reinforce",
        ),
        ('command = "improve"', 'command = "improve"\npreset = "quick"', "preset must be .* of reinforce, got 'quick'"),
        ('command = "improve"', 'command = "improve"\nsteps = 3', "stage 4: unknown key 'steps'"),
        ("set_tokens = 100", "set_token = 100", r"\(first\): set_token: .*; ImitateConfig has no such option"),
        ("n_layers = 1", "layers = 1", r"\(first\): joint.layers: .*no such option"),
        ("n_layers = 1", "n_layers = 0", r"\(first\): joint: n_layers must be a whole number from 1 to 1000, got 0"),
        ("n_nodes = [6, 9]", "n_nodes = [6, 5]", r"\(first\): n_nodes\[1\] must be a whole number of at least 6"),
        ("n_nodes = [6, 9]", 'n_nodes = [6, "9"]', r"\(first\): n_nodes.1: .*valid integer"),
        ("tensorboard = false", "tensorboard = 0", r"\(first\): tensorboard: .*boolean"),
        ("tensorboard = false", "buffer = 4", r"\(refine\): buffer: .*; ReinforceConfig has no such option"),
        ("share = 0.25", "share = 0", r"\(refine\): share must be a number above 0 and at most 1, got 0"),
        ("share = 0.25", "share = nan", "share must be a number above 0 and at most 1, got nan"),
        ("share = 0.25", "share = true", "share must be a number above 0 and at most 1, got True"),
        ("share = 0.25", "share = 1.5", r"share must be .* at most 1, got 1\.5"),
        (
            'name = "first"',
            'name = "first"\nshare = 0.5',
            "share must be 1 in a stage that starts from no weights, got 0.5",
        ),
        ("steps = 4", "seed = 4", r"\(first\): steps or seconds must be given"),
        ("steps = 4", 'steps = 4, roll_in = "previous"', "no stage comes before the first"),
        ("steps = 4", "steps = 4, resume = true", "resume is set by the command line"),
        ("steps = 4", 'steps = 4, out = "runs"', "out is set by the command line"),
    ],
)
def test_mistakes_in_a_recipe_are_named(written, old, new, message):
    text = SHARED + STAGES
    assert old in text
    with pytest.raises(ValueError, match=message):
        read_recipe(written(text.replace(old, new, 1)))


@pytest.mark.slow
def test_stages_follow_one_another_and_are_logged(tiny, tmp_path):
    out = tmp_path / "run"
    recipe(tiny, out)
    log = log_of(out)
    assert [stage["name"] for stage in log["stages"]] == FOLDERS and log["from_stage"] is None
    for stage, before in zip(log["stages"], [None, *FOLDERS], strict=False):
        progress = checkpoint.read(out / stage["name"] / "checkpoint.pt")["progress"]
        options = load_extra(out / stage["name"] / "best.safetensors")["config"]
        assert options["init"] == (None if before is None else str(out / before / FINAL[before]))
        assert stage["weights"] == f"{stage['name']}/{FINAL[stage['name']]}"
        assert options["roll_in"] == options["init"] if stage["name"] == "roll-in" else True
        assert stage["status"] == "complete" and stage["steps"] == progress["step"] == (4 if before is None else 3)
        assert stage["instances"] == progress["instances"] > 0
        assert stage["hours"] == progress["seconds"] / 3600 > 0
        assert stage["best_validation_cost"] == progress["best"] <= stage["validation_cost"]
        load(out / stage["weights"])
    began, best, mixed = (
        load(out / file).state_dict()
        for file in ("roll-in/best.safetensors", "refine/best.safetensors", "refine/mixed.safetensors")
    )
    assert mixed.keys() - began.keys() == {"distance_slopes", "next_slope", "assignment_slope"}  # this stage adds them
    for name, parameter in mixed.items():
        before = began.get(name, torch.zeros_like(parameter))
        torch.testing.assert_close(parameter, 0.75 * before + 0.25 * best[name])
    with pytest.raises(FileExistsError, match="holds a run already: add --resume"):
        recipe(tiny, out)
    recipe(tiny, out, resume=True)  # nothing is left to do
    assert log_of(out) == log


@pytest.mark.slow
def test_an_interrupted_recipe_resumes_bit_for_bit(tiny, tmp_path, monkeypatch):
    """It is interrupted in the second, third and fourth stage."""
    whole, parts = tmp_path / "whole", tmp_path / "run"
    recipe(tiny, parts)
    parts.rename(whole)  # the paths of the weights are options, and must be the same in both runs

    def interrupting(train_step):
        def interrupted(self):
            logs = train_step(self)
            if self.config.out.name != "first" and self.step == 1:
                signal.raise_signal(signal.SIGINT)
            return logs

        return interrupted

    for learner in (ImitationLearner, ReinforceLearner, ImproveLearner):
        monkeypatch.setattr(learner, "train_step", interrupting(learner.train_step))
    for number in (1, 2, 3):
        with pytest.raises(KeyboardInterrupt):
            recipe(tiny, parts, resume=number > 1)
        expected = ["complete"] * number + ["under way"] + ["waiting"] * (3 - number)
        assert [stage["status"] for stage in log_of(parts)["stages"]] == expected
        assert log_of(parts)["stages"][number]["steps"] == 1
        torch.manual_seed(123)  # something else happened in between
    recipe(tiny, parts, resume=True)
    for name in FOLDERS:
        one, other = (checkpoint.read(out / name / "checkpoint.pt") for out in (whole, parts))
        for state in (one, other):
            state.get("buffer", {}).pop("student", None)  # a file's hash, whose metadata have no fixed order
        for key in one.keys() - {"config", "progress"}:
            assert same(one[key], other[key]), (name, key)
        assert all(one["progress"][key] == other["progress"][key] for key in ("step", "instances", "best"))


@pytest.mark.slow
def test_seconds_stop_a_recipe_and_are_a_stages_budget(written, tmp_path):
    """A stage with a budget of a nanosecond takes one step; a run for a nanosecond takes none or one."""
    short = written(SHARED + STAGES.replace("steps = 3", "seconds = 1e-9").replace("steps = 4", "seconds = 1e-9"))
    recipe(short, tmp_path / "budget")
    assert [(stage["status"], stage["steps"]) for stage in log_of(tmp_path / "budget")["stages"]] == [
        ("complete", 1)
    ] * 4
    tiny = written(SHARED + STAGES)
    recipe(tiny, tmp_path / "run", seconds=1e-9)
    assert [stage["status"] for stage in log_of(tmp_path / "run")["stages"]] == ["waiting"] * 4
    recipe(tiny, tmp_path / "run", resume=True)
    assert [stage["status"] for stage in log_of(tmp_path / "run")["stages"]] == ["complete"] * 4


@pytest.mark.slow
def test_a_stage_that_was_stopped_before_it_was_recorded_is_completed(one_stage, tmp_path):
    out = tmp_path / "run"
    recipe(one_stage, out)
    log = log_of(out)
    before = checkpoint.read(out / "first" / "checkpoint.pt")
    unrecorded = {"status": "under way", "weights": None, "validation_cost": None}
    (out / "log.json").write_text(json.dumps(log | {"stages": [log["stages"][0] | unrecorded]}))
    recipe(one_stage, out, resume=True)
    assert log_of(out) == log
    assert same(checkpoint.read(out / "first" / "checkpoint.pt")["network"], before["network"])


@pytest.mark.slow
def test_training_goes_on_from_weights_alone(tiny, tmp_path):
    torch.manual_seed(7)
    network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1))
    save(tmp_path / "given.safetensors", network)
    out = tmp_path / "run"
    recipe(tiny, out, init=str(tmp_path / "given.safetensors"), from_stage="refine", seconds=1e-9)
    assert [stage["status"] for stage in log_of(out)["stages"]] == ["skipped"] * 2 + ["waiting"] * 2
    (tmp_path / "given.safetensors").unlink()  # the run has a copy
    recipe(tiny, out, resume=True)
    assert [stage["status"] for stage in log_of(out)["stages"]] == ["skipped"] * 2 + ["complete"] * 2
    assert load_extra(out / "refine" / "best.safetensors")["config"]["init"] == str(out / "init.safetensors")
    given = load(out / "init.safetensors")
    assert all(map(torch.equal, given.parameters(), network.parameters()))
    assert not (out / "first").exists()


@pytest.mark.slow
def test_the_first_stage_may_start_from_weights_too(one_stage, tmp_path):
    out = tmp_path / "run"
    torch.manual_seed(7)
    save(tmp_path / "given.safetensors", JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1)))
    recipe(one_stage, out, init=str(tmp_path / "given.safetensors"), from_stage="first")
    options = load_extra(out / "first" / "best.safetensors")["config"]
    assert options["init"] == str(out / "init.safetensors")


@pytest.mark.slow
def test_bad_arguments_are_refused_before_anything_is_written(tiny, written, tmp_path, monkeypatch):
    out = tmp_path / "run"
    for kwargs, message in (
        ({"init": "default"}, "init and from_stage go together, got init='default' and from_stage=None"),
        ({"from_stage": "refine"}, "init and from_stage go together"),
        (
            {"init": "default", "from_stage": "polish"},
            r"from_stage must be one of \['first', 'roll-in', .* got 'polish'",
        ),
        ({"init": "default", "from_stage": "refine", "resume": True}, "init must be None with resume"),
        ({"seconds": 0.0}, "seconds must be a finite number of seconds above 0, got 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            recipe(tiny, out, **kwargs)
    with pytest.raises(FileNotFoundError, match="no weights at nobody"):
        recipe(tiny, out, init="nobody", from_stage="refine")
    with pytest.raises(FileNotFoundError, match="no run to resume at"):
        recipe(tiny, out, resume=True)
    with pytest.raises(FileNotFoundError, match=r"no weights at lost\.safetensors"):
        recipe(written(SHARED + STAGES.replace('"previous"', '"lost.safetensors"')), out)
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(ValueError, match="a recipe is trained by one process"):
        recipe(written(SHARED + STAGES), out)
    assert not out.exists()


def test_a_run_is_resumed_only_with_its_own_recipe(written, tmp_path):
    out = tmp_path / "run"
    recipe(written(SHARED + STAGES), out, seconds=1e-9)
    with pytest.raises(ValueError, match="a resumed run keeps its stages"):
        recipe(written(SHARED + STAGES.replace('"improve"\ncommand', '"polish"\ncommand')), out, resume=True)
    (out / "log.json").write_text('{"stages": 3}')
    with pytest.raises(ValueError, match=r"log\.json: not a log of a recipe, or a damaged one"):
        recipe(written(SHARED + STAGES), out, resume=True)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
def test_a_recipe_is_a_regular_file(tmp_path):
    """A pipe may never end."""
    os.mkfifo(tmp_path / "recipe.toml")
    with pytest.raises(ValueError, match=r"recipe\.toml: not a regular file"):
        recipe(tmp_path / "recipe.toml", tmp_path / "run")


def test_one_recipe_at_a_time_is_trained_in_a_folder(one_stage, tmp_path):
    out = tmp_path / "run"
    with sole_writer(out):
        for resume in (False, True):
            with pytest.raises(ValueError, match="run: another run is writing to it"):
                recipe(one_stage, out, resume=resume)
            (out / "log.json").touch()


def test_a_stage_whose_checkpoint_lacks_its_progress_is_refused(one_stage, tmp_path):
    recipe(one_stage, tmp_path / "run", seconds=1e-9)
    checkpoint.write(tmp_path / "run" / "first" / "checkpoint.pt", {"network": {}})
    with pytest.raises(ValueError, match=r"first/checkpoint\.pt: it does not say how long its run took .*'progress'"):
        recipe(one_stage, tmp_path / "run", resume=True)


@pytest.mark.slow
def test_the_command_line_replaces_device_and_threads(one_stage, tmp_path, capsys):
    out = tmp_path / "run"
    threads = torch.get_num_threads()
    try:
        assert main(["recipe", str(one_stage), "--out", str(out), "--device", "cpu", "--threads", "1"]) == 0
    finally:
        torch.set_num_threads(threads)
    assert load_extra(out / "first" / "best.safetensors")["config"]["threads"] == 1
    assert "stage first: complete" in capsys.readouterr().err
    assert main(["recipe", str(one_stage), "--out", str(out)]) == 2
    assert "add --resume" in capsys.readouterr().err


@pytest.mark.slow
def test_reinforce_warms_up_before_its_decay():
    from tiny import TINY

    def rates(warmup):
        learner = ReinforceLearner(replace(TINY, warmup=warmup, decay=0.5, decay_every=4, learning_rate=1.0))
        seen = []
        for _ in range(8):
            seen.append(learner.optimiser.param_groups[0]["lr"])
            learner.optimiser.step()
            learner.schedule.step()
        return seen

    assert rates(0) == rates(1) == [1.0] * 4 + [0.5] * 4
    assert rates(3) == pytest.approx([1 / 3, 2 / 3, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5])
