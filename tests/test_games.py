"""Games of one instance, played by the rules: the same in NumPy (CPU) and in torch (GPU), as in the environment."""

import numpy as np
import pytest
import torch

from benchmarks.policies.nearest import nearest
from dan_policy import make_actor, rollout
from dan_policy.games import begin, best_tours, play
from dan_policy.planning import SPEED
from mtsp_env import check_tours, rules, uniform
from mtsp_env.batched import BatchedMTSP

GAME = rules.make_rules(15, 3, SPEED, "final", "sparse", None)


def scattered(cities, agents, visited, visits):
    """Logits that depend on the whole observation and on the state."""
    return torch.sin(20 * cities.sum(-1) + agents.sum((-1, -2))[:, None] + visits.to(cities.dtype)) - visited.float()


scattered.in_keys = ("cities", "agents", "visited", ("game", "visits"))


def in_torch(state):
    """The same state in tensors, as ``begin`` gives it for a GPU."""
    return rules.state_from_arrays({name: torch.tensor(array) for name, array in state.arrays().items()}, 3)


@pytest.mark.parametrize("policy", [nearest, scattered, make_actor(scattered)], ids=["nearest", "scattered", "actor"])
@pytest.mark.parametrize("augment", [False, True])
@pytest.mark.parametrize("seed", [None, 0])
def test_games_in_numpy_are_games_in_torch(policy, augment, seed):
    instance = uniform(np.random.default_rng(2), 15, 3)
    start = begin(instance, GAME, [[0, 3], [0], [0, 4, 1]], rows=6, augment=augment)
    ends = []
    for state in (start, in_torch(start)):
        generator = None if seed is None else torch.Generator().manual_seed(seed)
        ends.append(play(policy, state, GAME, generator))
    for name, array in ends[0].arrays().items():
        np.testing.assert_allclose(ends[1].arrays()[name].numpy(), array, rtol=0, atol=1e-12, err_msg=name)
    assert best_tours(ends[0]) == best_tours(ends[1])
    check_tours(instance, best_tours(ends[0]))
    assert (rules.makespan(start) <= rules.makespan(ends[0])).all()


@pytest.mark.parametrize("policy", [nearest, scattered], ids=["nearest", "scattered"])
def test_a_greedy_game_is_the_environments_greedy_episode(policy):
    instance = uniform(np.random.default_rng(5), 15, 3)
    env = BatchedMTSP(15, 3, [1], SPEED, depot="final")
    episode = rollout(policy, env, "greedy", torch.tensor(instance.nodes)[None])
    assert best_tours(play(policy, begin(instance, GAME), GAME)) == env.tours(episode.last)[0]


@pytest.mark.slow
def test_samples_follow_the_softmax_over_legal_nodes():
    """The first decision of many games, at which the depot is not legal, however large its logit."""
    instance = uniform(np.random.default_rng(6), 3, 1)
    game = rules.make_rules(3, 1, SPEED, "final", "sparse", None)

    def logits(visited):
        return torch.tensor([9.0, 1.0, 0.0]).expand(len(visited), 3)

    logits.in_keys = ("visited",)
    end = play(logits, begin(instance, game, rows=20_000), game, torch.Generator().manual_seed(0))
    first = (end.visits[:, 1] < end.visits[:, 2]).mean()
    assert first == pytest.approx(1 / (1 + np.exp(-1)), abs=0.01)
