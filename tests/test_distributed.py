"""Two processes take the step that one would take with all their episodes; they stop and decide together."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dan_policy import DAN, DANConfig, make_actor
from train import checkpoint, distributed
from train.collect import draw, play
from train.loss import EpisodicReinforceLoss, backward, decisions_with_advantage
from train.presets import QUICK

ROOT = Path(__file__).parent.parent
TINY = replace(QUICK, n_nodes=(6, 6), n_agents=(2, 2), network=DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2))


def torchrun(*arguments, processes=2):
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*command, *map(str, arguments)], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-3000:]


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
def test_training_under_torchrun_keeps_the_processes_alike_and_resumes(tmp_path):
    small = ["-m", "train", "reinforce", "quick", "--out", tmp_path, "--n-nodes", 5, 7, "--batch-size", 4,
             "--network.embed-dim", 16, "--challenge-instances", 8, "--challenge-every", 2, "--validation-instances", 4,
             "--no-tensorboard"]  # fmt: skip
    torchrun(*small, "--steps", 2)
    torchrun(*small, "--steps", 3, "--resume")
    one, other = (checkpoint.read(tmp_path / name) for name in ("checkpoint.pt", "checkpoint-1.pt"))
    assert one["progress"]["step"] == other["progress"]["step"] == 3
    assert one["progress"]["instances"] == 3 * 4 * 2
    for name, value in one["network"].items():
        assert torch.equal(value, other["network"][name])
    assert one["random"]["numpy"] != other["random"]["numpy"]  # each draws its own instances
    assert not torch.equal(one["baseline"]["test_costs"], other["baseline"]["test_costs"])


def test_alone_everything_is_the_identity():
    with distributed.processes("cpu"):
        values = torch.rand(3)
        assert distributed.gather(values) is values
        assert (distributed.rank(), distributed.world_size()) == (0, 1)
        assert distributed.any_process(True, "cpu") and not distributed.any_process(False, "cpu")


if __name__ == "__main__":
    one_process(sys.argv[1])
