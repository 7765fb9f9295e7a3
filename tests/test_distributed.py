"""Two processes take the step that one would take with all their episodes; they stop and decide together."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.processes import wait_until
from helpers.states import same

from dan_policy import DAN, DANConfig, make_actor
from train import checkpoint, distributed
from train.collect import draw, play
from train.loss import EpisodicReinforceLoss, backward, decisions_with_advantage
from train.presets import QUICK
from train.reinforce import ReinforceLearner

ROOT = Path(__file__).parent.parent
TINY = replace(QUICK, n_nodes=(6, 6), n_agents=(2, 2), network=DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2))


def torchrun(*arguments, processes=2):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*command, *map(str, arguments)], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stderr


TINY_RUN = ["-m", "train", "reinforce", "quick", "--n-nodes", 5, 7, "--batch-size", 4, "--network.embed-dim", 16,
            "--validation-instances", 4, "--no-tensorboard"]  # fmt: skip
SMALL = [*TINY_RUN, "--challenge-instances", 8, "--challenge-every", 2]


def gradient(network, seeds):
    """Add the gradient of the mean over five episodes per seed (made-up advantages); return the number of decisions."""
    total = 0
    for seed in seeds:
        torch.manual_seed(seed)
        episode = play(network, draw(np.random.default_rng(seed), TINY, 5), TINY, "sample", keep=True)
        decisions = decisions_with_advantage(episode, torch.linspace(-1, 1, 5) + seed)
        backward(EpisodicReinforceLoss(make_actor(network), n_episodes=5 * len(seeds)), decisions, chunk=7 + seed)
        total += len(decisions)
    return total


def one_process(folder):
    """What each process of the test below runs: the gradient of its own episodes, then the mean over all processes."""
    torch.manual_seed(0)
    network = DAN(TINY.network)
    with distributed.processes("cpu"):
        gradient(network, [distributed.rank()])
        distributed.average_gradients(network)
        gathered = distributed.gather(torch.tensor([float(distributed.rank())]))
        votes = distributed.any_process(distributed.rank() == 1, "cpu"), distributed.any_process(False, "cpu")
        gradients = {name: p.grad for name, p in network.named_parameters()}
        checkpoint.write(Path(folder) / str(distributed.rank()), {"grad": gradients, "all": gathered, "votes": votes})


@pytest.mark.slow
def test_two_processes_have_the_gradient_of_one_with_all_their_episodes(tmp_path):
    torchrun(__file__, tmp_path)
    torch.manual_seed(0)
    network = DAN(TINY.network)
    gradient(network, [0, 1])
    for rank in ("0", "1"):
        result = checkpoint.read(tmp_path / rank)
        for name, parameter in network.named_parameters():
            torch.testing.assert_close(result["grad"][name], parameter.grad, rtol=1e-4, atol=1e-6)
        assert result["all"].tolist() == [0.0, 1.0]
        assert result["votes"] == (True, False)


@pytest.mark.slow
def test_processes_stay_alike_and_a_damaged_checkpoint_sends_all_of_them_back_to_the_one_before(tmp_path):
    """The continuation ends as a run would have ended whose files stayed whole."""
    every_step = [*SMALL, "--checkpoint-every", 1]
    run = tmp_path / "run"
    torchrun(*every_step, "--steps", 4, "--out", run)
    one, other = (checkpoint.read(run / name) for name in ("checkpoint.pt", "checkpoint-1.pt"))
    assert one["progress"]["step"] == other["progress"]["step"] == 4
    assert one["progress"]["instances"] == 4 * 4 * 2
    assert same(one["network"], other["network"])
    assert one["random"]["numpy"] != other["random"]["numpy"]  # each draws its own instances
    assert not torch.equal(one["baseline"]["test_costs"], other["baseline"]["test_costs"])

    path = run / "checkpoint-1.pt"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    errors = torchrun(*every_step, "--steps", 4, "--resume", "--out", run)
    assert f"{path} is left out, step 3 is continued ({path}: not a checkpoint, or a damaged one" in errors
    assert f"{path.with_name('checkpoint.pt')} is left out, step 3 is continued (another process" in errors
    for whole, name in ((one, "checkpoint.pt"), (other, "checkpoint-1.pt")):
        again = checkpoint.read(run / name)
        assert again["progress"]["step"] == 4
        for part in ("network", "average", "optimiser", "schedule", "baseline", "random"):
            assert same(whole[part], again[part]), (name, part)
    steps = np.loadtxt(run / "logs" / "scalars" / "cost.csv", delimiter=",")[:, 0]
    assert steps.tolist() == [1, 2, 3, 4]


@pytest.mark.slow
def test_a_signal_to_all_processes_and_torchrun_saves_the_same_step_in_each(tmp_path):
    """Each process gets the signal twice: once from the job's scheduler and once from torchrun.

    Steps end with a long challenge.
    """
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", *map(str, TINY_RUN)]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    options = ["--checkpoint-every", "100000", "--steps", "100000", "--out", str(tmp_path)]
    options += ["--challenge-every", "1", "--challenge-instances", "2000"]
    job = subprocess.Popen(
        [*command, *options], cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    log = tmp_path / "logs" / "scalars" / "cost.csv"
    wait_until(lambda: log.exists() and log.read_text().count("\n") >= 1)
    os.killpg(job.pid, signal.SIGTERM)
    _, errors = job.communicate(timeout=300)
    assert errors.count("train: ended by SIGTERM") == 2, errors
    steps = [checkpoint.read(tmp_path / name)["progress"]["step"] for name in ("checkpoint.pt", "checkpoint-1.pt")]
    assert steps == [log.read_text().count("\n")] * 2


@pytest.mark.slow
def test_processes_without_a_common_checkpoint_all_say_so(tmp_path, monkeypatch):
    """The other process has saved steps 6 and 7."""
    learner = ReinforceLearner(replace(TINY, out=tmp_path, steps=5, resume=True, validation_instances=2))
    learner.step = 5
    learner.save()
    with monkeypatch.context() as patch:
        patch.setattr("train.learner.world_size", lambda: 2)
        patch.setattr("train.learner.gather", lambda steps: torch.cat([steps, torch.tensor([7, 6])]))
        with pytest.raises(ValueError, match=r"no whole checkpoint: they have those of steps \[\[5\], \[6, 7\]\]"):
            learner.restore()
        patch.setattr("train.learner.gather", lambda steps: torch.cat([steps, torch.tensor([5, 4])]))
        with pytest.raises(ValueError, match="the run had 1 processes, and would now have 2"):
            learner.restore()
    learner.restore()


def test_alone_everything_is_the_identity():
    with distributed.processes("cpu"):
        values = torch.rand(3)
        assert distributed.gather(values) is values
        assert (distributed.rank(), distributed.world_size()) == (0, 1)
        assert distributed.any_process(True, "cpu") and not distributed.any_process(False, "cpu")


if __name__ == "__main__":
    one_process(sys.argv[1])
