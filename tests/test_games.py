"""Games of one instance, played by the rules: the same in NumPy (CPU) and in torch (GPU), as in the environment."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from benchmarks.policies.nearest import nearest
from dan_policy import make_actor, rollout
from dan_policy.games import begin, best_tours, play
from dan_policy.joint import JointConfig, JointDAN
from dan_policy.planning import SPEED
from mtsp_env import check_tours, rules, uniform
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import batch

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


class Timetable:
    """A network whose logits for an agent's next node depend on that agent alone, so that it foresees all decisions."""

    in_keys = ("visited", "agent")

    def __init__(self, confidence, n_agents=3, n_nodes=15, sharpness=30.0, view=None):
        generator = torch.Generator().manual_seed(4)
        self.table = sharpness * torch.rand(n_agents, n_nodes, generator=generator)
        self.config = SimpleNamespace(confidence=confidence, view=view)
        self.looks = []  # the deciding agents of the games that were looked at, for each forward pass

    def __call__(self, visited, agent):
        self.looks.append(agent.tolist())
        return self.table[agent]

    def forward_next(self, visited, agent):
        self.looks.append(agent.tolist())
        return self.table.expand(len(agent), -1, -1).clone()


@pytest.mark.parametrize("seed", [None, 0])
def test_who_foresees_everything_plays_the_same_games_with_fewer_looks(seed):
    instance = uniform(np.random.default_rng(2), 15, 3)
    start = begin(instance, GAME, rows=4, augment=True)
    looks = {}
    for confidence in (None, 1.0, 0.9, 0.3):
        policy = Timetable(confidence)
        end = play(policy, start, GAME, None if seed is None else torch.Generator().manual_seed(seed))
        looks[confidence] = sum(map(len, policy.looks))
        if confidence is None:
            expected = end
        assert all(np.array_equal(end.arrays()[name], array) for name, array in expected.arrays().items())
    assert looks[0.3] < looks[0.9] < looks[1.0] == looks[None]


def test_sharper_logits_do_not_make_a_network_surer():
    """With the logits that samples are drawn from, agents look as often as with those of the training."""
    start = begin(uniform(np.random.default_rng(2), 15, 3), GAME, rows=4, augment=True)
    looks = []
    for times in (1.0, 4.0):
        policy = Timetable(0.9, sharpness=30.0 * times)
        play(policy, start, GAME, sharpness=times)
        looks.append(policy.looks)
    sharp = Timetable(0.9, sharpness=120.0)
    play(sharp, start, GAME)
    assert looks[0] == looks[1] and len(sharp.looks) < len(looks[0])


@pytest.mark.parametrize("view", [0, 1, 6, 13, 14, None])
def test_nothing_is_foreseen_for_others_while_cities_are_out_of_view(view):
    start = begin(uniform(np.random.default_rng(2), 15, 3), GAME)
    policy, state, decisions = Timetable(1e-9, view=view), start, 0
    play(policy, start, GAME)
    while view is not None and (~state.visited[0]).sum() - 1 > view:  # until nothing is out of view
        state = rules.depart(state, GAME, np.array([_likeliest(policy, state)]))
        decisions += 1
    everything = Timetable(1e-9)
    play(everything, state, GAME)
    assert len(policy.looks) == decisions + len(everything.looks)


def test_under_autocast_few_numbers_of_games_are_looked_at():
    instances = [uniform(np.random.default_rng(seed), 15, 3) for seed in range(24)]
    start, policy, plain = rules.start(batch(instances), GAME), Timetable(0.5), Timetable(0.5)
    with torch.autocast("cpu", torch.bfloat16):
        end = play(policy, start, GAME)
    assert best_tours(end) == best_tours(play(plain, start, GAME))
    assert {len(agents) for agents in policy.looks} <= {8, 16, 24}
    assert not {len(agents) for agents in plain.looks} <= {8, 16, 24}


def test_nobody_acts_twice_on_what_was_foreseen_once():
    """However low the confidence, an agent that has moved since the last look asks for a new one."""
    instance = uniform(np.random.default_rng(2), 15, 3)
    policy, state = Timetable(1e-9), begin(instance, GAME)
    deciders = []
    end = play(policy, state, GAME)
    while not rules.terminated(state).all():  # the same game, one decision after the other
        deciders.append(int(rules.agent_to_decide(state)[0]))
        state = rules.depart(state, GAME, np.array([_likeliest(policy, state)]))
    assert best_tours(state) == best_tours(end)
    expected, moved = [], {0, 1, 2}
    for agent in deciders:
        if agent in moved:
            expected.append([agent])
            moved = set()
        moved.add(agent)
    assert policy.looks == expected


def _likeliest(policy, state):
    mask = torch.as_tensor(rules.observe(state, GAME).action_mask)[0]
    return int(policy.table[int(rules.agent_to_decide(state)[0])].masked_fill(~mask, -torch.inf).argmax())


def test_games_side_by_side_look_when_they_would_alone():
    torch.manual_seed(3)
    network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1, confidence=0.2)).eval()
    instances = [uniform(np.random.default_rng(seed), 15, 3) for seed in range(4)]
    timetable, looks = Timetable(0.3), []
    for policy in (network, timetable):
        alone = [best_tours(play(policy, begin(instance, GAME), GAME)) for instance in instances]
        looks.append(sorted(agent for agents in timetable.looks for agent in agents))
        together = play(policy, rules.start(batch(instances), GAME), GAME)
        assert list(map(rules.tours, together.visits, together.destination)) == alone
    both = sorted(agent for agents in timetable.looks for agent in agents)
    assert both == sorted(2 * looks[1]), "as often together as alone"
