"""What a training run writes, how it is resumed bit for bit, and what it refuses."""

import re
import signal
import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.states import same
from tiny import TINY, interrupt_after

from benchmarks.policies.attention_model import AttentionModel
from dan_policy import load
from dan_policy.registry import load_extra
from train import checkpoint
from train.__main__ import main
from train.checkpoint import check_same_run
from train.reinforce import ReinforceLearner, reinforce
from train.reinforce_config import ReinforceConfig


@pytest.mark.parametrize("average", [0.0, 0.9])
@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, average):
    config = replace(TINY, average=average)
    reinforce(replace(config, out=tmp_path / "whole"))
    reinforce(replace(config, out=tmp_path / "parts", steps=3))
    torch.manual_seed(123)  # something else happened in between
    reinforce(replace(config, out=tmp_path / "parts", resume=True))
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "baseline", "random"):
        assert same(whole[key], parts[key]), key
    for key in ("step", "instances", "best"):
        assert whole["progress"][key] == parts["progress"][key], key


@pytest.mark.slow
def test_an_interrupt_finishes_the_step_and_saves(tmp_path, monkeypatch):
    interrupt_after(3, ReinforceLearner, monkeypatch)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):  # raised again, once everything is saved
        reinforce(replace(TINY, out=tmp_path, checkpoint_every=1000))
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == 3
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.slow
def test_a_run_is_not_overwritten_nor_resumed_as_another(tmp_path):
    reinforce(replace(TINY, out=tmp_path, steps=1))
    with pytest.raises(FileExistsError, match="add --resume"):
        reinforce(replace(TINY, out=tmp_path))
    with pytest.raises(ValueError, match="batch_size was 6, is 7"):
        reinforce(replace(TINY, out=tmp_path, resume=True, batch_size=7))
    with pytest.raises(FileNotFoundError, match="no checkpoint at"):
        reinforce(replace(TINY, out=tmp_path / "other", resume=True))
    check_same_run(TINY.to_dict(), replace(TINY, steps=99, seconds=1.0))


def test_a_checkpoint_may_be_older_than_an_option():
    """Options that the checkpoint lacks had their default values."""
    older = TINY.to_dict()
    del older["average"], older["network"]["view"]
    check_same_run(older, TINY)
    for changed in (
        replace(TINY, average=0.5),
        replace(TINY, network=replace(TINY.network, prune_visited=True, view=5)),
    ):
        with pytest.raises(ValueError, match=r"average was 0\.0, is 0\.5|network was .*'view': None"):
            check_same_run(older, changed)


@pytest.mark.slow
def test_a_damaged_checkpoint_can_be_replaced_by_the_one_before_it(tmp_path):
    """The continuation logs every step once, and ends as the whole run would have ended."""
    run = replace(TINY, out=tmp_path / "run", checkpoint_every=2, steps=6)
    reinforce(replace(run, out=tmp_path / "whole"))
    reinforce(replace(run, steps=5))  # checkpoints at 2, 4 and 5
    path = tmp_path / "run" / "checkpoint.pt"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"its checksum does not fit.*: mv "):
        reinforce(replace(run, resume=True))
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"no checkpoint at .*: mv .*previous\.pt .*checkpoint\.pt"):
        reinforce(replace(run, resume=True))
    checkpoint.previous(path).replace(path)
    assert checkpoint.read(path)["progress"]["step"] == 4
    reinforce(replace(run, resume=True))
    whole, again = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "run"))
    assert same(whole["network"], again["network"])
    for name in ("cost", "validation_cost"):
        logs = [np.loadtxt(tmp_path / part / f"logs/scalars/{name}.csv", delimiter=",") for part in ("whole", "run")]
        assert np.array_equal(*logs), name


@pytest.mark.parametrize("lacks", ["config", "network", "random", "progress", "optimiser", "baseline"])
@pytest.mark.slow
def test_a_checkpoint_that_lacks_a_part_is_refused(tmp_path, lacks):
    run = replace(TINY, out=tmp_path, steps=1)
    learner = ReinforceLearner(run)
    learner.save()
    path = tmp_path / "checkpoint.pt"
    state = checkpoint.read(path)
    del state[lacks]
    checkpoint.write(path, state)
    with pytest.raises(ValueError, match=f"does not hold the state of a ReinforceLearner .*{lacks}"):
        reinforce(replace(run, resume=True))


@pytest.mark.slow
def test_one_run_at_a_time_writes_to_a_folder(tmp_path, monkeypatch):
    run = replace(TINY, out=tmp_path, steps=1)

    def start_another():
        with pytest.raises(ValueError, match="another run is writing to it"):
            reinforce(run)
        refused.append(True)

    def train_step(self):
        other = threading.Thread(target=start_another)
        other.start()
        other.join()
        return step(self)

    step, refused = ReinforceLearner.train_step, []
    monkeypatch.setattr(ReinforceLearner, "train_step", train_step)
    reinforce(run)
    assert refused == [True]
    with pytest.raises(FileExistsError, match="add --resume"):
        reinforce(run)


@pytest.mark.slow
def test_what_a_killed_run_left_is_removed(tmp_path):
    (tmp_path / ".checkpoint.pt.0123.tmp").write_text("half")
    reinforce(replace(TINY, out=tmp_path, steps=1))
    assert not list(tmp_path.glob(".*.tmp"))


@pytest.mark.slow
def test_logs_and_weights_are_written(tmp_path):
    learner = reinforce(replace(TINY, out=tmp_path, tensorboard=True))
    cost = np.loadtxt(tmp_path / "logs/scalars/cost.csv", delimiter=",")
    assert cost[:, 0].tolist() == [1, 2, 3, 4, 5, 6]
    assert {p.name for p in tmp_path.glob("*.safetensors")} == {"best.safetensors", "last.safetensors"}
    assert list(tmp_path.glob("tensorboard/events*"))
    continued = ReinforceLearner(replace(TINY, init=str(tmp_path / "last.safetensors")))
    assert same(dict(continued.network.state_dict()), dict(learner.network.state_dict()))


@pytest.mark.slow
def test_a_run_that_ends_before_its_first_validation_has_best_weights_too(tmp_path):
    reinforce(replace(TINY, out=tmp_path, steps=1, validate_every=2))
    first = (tmp_path / "best.safetensors").read_bytes()
    assert same(*(dict(load(tmp_path / f"{name}.safetensors").state_dict()) for name in ("best", "last")))
    learner = reinforce(replace(TINY, out=tmp_path, steps=3, validate_every=2, resume=True))
    assert (tmp_path / "best.safetensors").read_bytes() != first  # those that were validated take their place
    assert load_extra(tmp_path / "best.safetensors")["step"] == 2
    assert learner.best < np.inf


@pytest.mark.slow
def test_a_custom_network_is_trained_saved_and_continued(tmp_path):
    policy = "benchmarks.policies.attention_model:AttentionModel"
    learner = reinforce(replace(TINY, out=tmp_path, policy=policy, steps=2))
    assert isinstance(learner.network, AttentionModel)
    again = ReinforceLearner(replace(TINY, policy=policy, init=str(tmp_path / "last.safetensors")))
    assert same(dict(again.network.state_dict()), dict(learner.network.state_dict()))
    with pytest.raises(ValueError, match="names the factory 'benchmarks"):
        ReinforceLearner(replace(TINY, init=str(tmp_path / "last.safetensors")))
    with pytest.raises(ValueError, match=r"package.module:factory, got 'nothing.here:at_all'"):
        ReinforceLearner(replace(TINY, policy="nothing.here:at_all"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policy": "os:getcwd"}, "os:getcwd must return a module or a function, got str"),
        ({"policy": "torch.nn:Identity"}, "policy='torch.nn:Identity' has no parameters to train"),
        (
            {"policy": "torch.nn:Linear", "policy_options": {"in_features": 2, "out_features": 2}},
            "policy='torch.nn:Linear' fails on an observation .*takes 2 positional arguments",
        ),
        ({"distribution": "os:getcwd"}, "distribution='os:getcwd' cannot be drawn from .*takes no arguments"),
        ({"device": "meta"}, "no device 'meta' here"),
        ({"device": "cpu:99"}, "no device 'cpu:99' here"),
    ],
)
def test_what_cannot_be_trained_is_named(options, message):
    with pytest.raises(ValueError, match=message):
        ReinforceLearner(replace(TINY, **options))


@pytest.mark.slow
@pytest.mark.parametrize("option", [["--batch-size", "100000000000"], ["--validation-instances", "100000000000"]])
@pytest.mark.parametrize("checked", [True, False])
def test_a_lack_of_memory_is_one_line(tmp_path, capsys, monkeypatch, checked, option):
    """Sizes are refused before memory is asked for, with those that fit; what the check misses is one line as well."""
    if not checked:
        monkeypatch.setattr("train.collect.check_memory", lambda *_: None)
    expected = r"the number of instances .* 100000000000 needs about .* fits" if checked else r"out of memory \("
    command = ["reinforce", "quick", "--steps", "1", "--network.embed-dim", "16", "--challenge-instances", "2"]
    command += ["--validation-instances", "2", "--no-tensorboard", "--out", str(tmp_path / option[0]), *option]
    assert main(command) == 2
    printed = capsys.readouterr().err
    assert re.match(f"train: error: {expected}", printed) and printed.count("\n") == 1


@pytest.mark.slow
def test_dropping_visited_cities_can_be_switched_on_and_off_with_the_same_weights(tmp_path):
    reinforce(replace(TINY, out=tmp_path, steps=1))
    before = load(tmp_path / "last.safetensors")
    assert before.config.prune_visited
    for prune, expected in ((None, True), (True, True), (False, False)):
        after = ReinforceLearner(replace(TINY, init=str(tmp_path / "last.safetensors"), prune_visited=prune)).network
        assert after.config == replace(before.config, prune_visited=expected)
        assert same(dict(after.state_dict()), dict(before.state_dict()))
    for other in ({}, {"init": "default", "policy": "package.module:factory"}):
        with pytest.raises(
            ValueError, match="prune_visited must be None unless a registered policy starts from init, got False"
        ):
            ReinforceConfig(prune_visited=False, **other)
