"""Ray workers play what one process would play with the same weights; a run with them continues bit for bit."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from dan_policy import DAN, DANConfig
from train.collect import draw, play
from train.presets import QUICK
from train.reinforce import reinforce
from train.remote import RayWorkers, play_part, replay

ray = pytest.importorskip("ray", reason="needs the extra ray")

KEYS = ("cities", "agents", "visited", "action_mask")
CONFIG = replace(
    QUICK,
    n_nodes=(5, 9),
    n_agents=(2, 3),
    batch_size=3,
    validation_instances=4,
    challenge_instances=4,
    tensorboard=False,
    network=DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True),
    collector="ray",
)


@pytest.fixture(scope="module")
def cluster():
    """A local cluster that prints nothing."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.fixture
def network():
    torch.manual_seed(0)
    return DAN(CONFIG.network)


@pytest.mark.parametrize("depot", ["final", "open"])
def test_actions_alone_restore_an_episode(network, depot):
    config = replace(CONFIG, depot=depot)
    problem = draw(np.random.default_rng(0), config, 6)
    played = play(network, problem, config, "sample", keep=True)
    actions = torch.nn.functional.pad(played.decisions["action"].T, (0, 7))
    again = replay(problem, actions, KEYS, config)
    assert torch.equal(again.reward, played.reward)
    assert torch.equal(again.valid, played.valid)
    assert (again.decisions[played.valid] == played.decisions[played.valid]).all()


@pytest.mark.slow
def test_workers_play_their_parts_with_the_current_weights(network, cluster):
    config = replace(CONFIG, samples=2, baseline="shared", curriculum=((5, 10, 12, 3, 3),))
    workers = RayWorkers(network, config, first_step=3)
    sizes = []
    for step in (3, 4, 5):
        problem, episode = workers.collect()
        parts = [play_part(network, config, step, worker) for worker in range(2)]
        assert torch.equal(problem.nodes, torch.cat([part.nodes for part, _ in parts]))
        assert torch.equal(episode.reward, torch.cat([part.reward for _, part in parts]))
        sizes.append((*problem.nodes.shape[:2], problem.n_agents))
        with torch.no_grad():
            for parameter in network.parameters():
                parameter.add_(torch.randn_like(parameter))
    assert all(batch == 12 for batch, *_ in sizes)  # 2 workers, 3 instances, 2 samples
    assert [10 <= n <= 12 for _, n, _ in sizes] == [False, False, True]
    assert not torch.equal(
        episode.reward, play_part(network, config, 5, 0)[1].reward.repeat(2)
    )  # the weights have changed
    workers.close()
    assert ray.is_initialized()  # not started by the workers


@pytest.mark.slow
def test_a_run_with_workers_continues_bit_for_bit(tmp_path, cluster):
    config = replace(CONFIG, ray_workers=1)
    whole = reinforce(replace(config, out=tmp_path / "whole", steps=3))
    reinforce(replace(config, out=tmp_path / "parts", steps=2))
    parts = reinforce(replace(config, out=tmp_path / "parts", steps=3, resume=True))
    assert parts.instances == whole.instances == 9
    for name, weight in whole.network.state_dict().items():
        assert torch.equal(weight, parts.network.state_dict()[name]), name


@pytest.mark.slow
def test_more_workers_than_cpus_are_refused(network, cluster):
    with pytest.raises(ValueError, match="ray_workers must be at most Ray's 2 CPUs, got 3"):
        RayWorkers(network, replace(CONFIG, ray_workers=3), first_step=0)


@pytest.mark.slow
def test_without_ray_the_error_names_the_group(network, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match="pip install --group ray"):
        RayWorkers(network, CONFIG, first_step=0)
