"""Whole episodes: each decision once, the same in both environments, from any start."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from benchmarks.policies.nearest import nearest
from dan_policy import DAN, DANConfig, make_actor, rollout
from dan_policy.network import find_device
from mtsp_env import check_tours, mtsp_v0, uniform
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import batch

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "final"])
def test_an_episode_holds_each_decision_once_and_nothing_after_its_end(network, depot):
    env = BatchedMTSP(9, 3, [16], speed=0.1, depot=depot, seed=0)
    torch.manual_seed(0)
    episode = rollout(network, env, "sample", keep=("visited", "action_mask", ("game", "decisions")))
    steps, rows = episode.valid.shape
    assert episode.decisions.shape == (steps, rows)
    assert episode.valid[0].all() and episode.valid[-1].any()
    assert (episode.valid[:-1] | ~episode.valid[1:]).all()  # once over, always over
    legal = episode.decisions["action_mask"].gather(2, episode.decisions["action"][..., None])[..., 0]
    assert legal[episode.valid].all()
    cities_taken = ((episode.decisions["action"] > 0) & episode.valid).sum(0)
    assert (cities_taken == 8).all()
    assert torch.equal(episode.decisions["game", "decisions"], torch.arange(steps)[:, None].expand(steps, rows))
    assert torch.allclose(episode.reward.double(), -env.makespan(episode.last), rtol=1e-6)


def aec_tours(instance, choose):
    """The tours of the AEC loop in which each agent does what ``choose`` says of its observation and mask."""
    env = mtsp_v0.raw_env(n_nodes=instance.n_nodes, n_agents=instance.n_agents)
    env.reset(options={"instance": instance})
    for _ in env.agent_iter():
        seen, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            break
        env.step(choose(seen["observation"], seen["action_mask"]))
    return env.tours


@pytest.mark.slow
def test_rollout_agrees_with_the_pettingzoo_environment(network):
    """The same network, greedily, agent by agent in the AEC loop."""

    def choose(seen, mask):
        cities, agents, visited = (torch.as_tensor(seen[key])[None] for key in ("cities", "agents", "visited"))
        logits = network(cities, agents, visited.bool())[0]
        return int(logits.masked_fill(~torch.as_tensor(mask).bool(), -torch.inf).argmax())

    instance = uniform(np.random.default_rng(0), 10, 3)
    batched = BatchedMTSP(10, 3, [1])
    episode = rollout(network, batched, "greedy", torch.tensor(instance.nodes)[None])
    assert batched.tours(episode.last)[0] == aec_tours(instance, choose)


def test_nearest_goes_to_the_nearest_in_both_faces():
    """The plug-in of the README: a plain function as an actor, and the same rule in the AEC loop."""

    def choose(seen, mask):
        distance = np.linalg.norm(seen["cities"], axis=1)
        distance[(np.asarray(mask) == 0) | (np.arange(25) == 0)] = np.inf
        return int(distance.argmin())

    instance = uniform(np.random.default_rng(4), 25, 3)
    batched = BatchedMTSP(25, 3, [1])
    episode = rollout(nearest, batched, "greedy", torch.tensor(instance.nodes)[None])
    assert batched.tours(episode.last)[0] == aec_tours(instance, choose)
    check_tours(instance, batched.tours(episode.last)[0])


def test_instances_come_as_nodes_as_a_problem_or_as_a_tensordict():
    instances = [uniform(np.random.default_rng(k), 8, 2) for k in range(3)]
    problem, env = batch(instances), BatchedMTSP(8, 2, [3], depot="final")
    nodes = torch.as_tensor(problem.nodes)
    given = [nodes, problem, TensorDict({"game": TensorDict({"nodes": nodes}, [3])}, [3])]
    episodes = [rollout(policy, env, "greedy", each) for each in given for policy in (nearest, make_actor(nearest))]
    for episode in episodes:
        assert torch.equal(episode.last["game", "nodes"], nodes)
        assert env.tours(episode.last) == env.tours(episodes[0].last)


def test_an_episode_goes_on_from_a_state_that_it_was_cut_off_at():
    env = BatchedMTSP(8, 2, [3], depot="final", seed=1)
    nodes = env.reset()["game", "nodes"]
    whole = rollout(nearest, env, "greedy", nodes)
    start = rollout(nearest, env, "greedy", nodes, max_decisions=4)
    assert len(start.valid) == 4 and not start.last["done"].any()
    rest = rollout(nearest, env, "greedy", start.last)
    assert len(rest.valid) == len(whole.valid) - 4
    assert env.tours(rest.last) == env.tours(whole.last)


def test_bad_arguments_are_named(network):
    env = BatchedMTSP(5, 2, [2])
    with pytest.raises(ValueError, match="unknown decode 'beam'; choose from"):
        rollout(network, env, "beam")
    with pytest.raises(ValueError, match="max_decisions must be a whole number of at least 1, got 0"):
        rollout(network, env, max_decisions=0)
    with pytest.raises(ValueError, match="nodes must have shape"):
        rollout(network, env, instances=torch.rand(2, 6, 2))


def test_a_device_is_found_or_named():
    assert find_device("cpu") == torch.device("cpu")
    assert find_device().type == ("cuda" if torch.cuda.is_available() else "cpu")
    for name in ("nonsense", "cuda:99"):
        with pytest.raises(ValueError, match=f"no device '{name}' here"):
            find_device(name)
