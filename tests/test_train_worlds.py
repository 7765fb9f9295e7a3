"""REINFORCE in worlds: episodes, baselines and validation in a mix of scenarios; weights that read more keys."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.states import same
from tiny import TINY, interrupt_after

from benchmarks.policies.nearest import nearest
from dan_policy import make_actor
from dan_policy.joint import READABLE, JointConfig, JointDAN
from dan_policy.registry import load, save
from mtsp_env import SCENARIOS
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Problem
from train import checkpoint
from train.collect import draw, draw_scenario, draw_set, environment, play, repeat
from train.loss import decisions_with_advantage, log_probs
from train.network import make_network
from train.reinforce import ReinforceLearner, reinforce
from train.remote import replay

JOINT = JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1, reads=tuple(READABLE))
WORLD = replace(
    TINY,
    policy="joint",
    joint=JOINT,
    scenario=tuple(SCENARIOS),
    baseline="shared",
    samples=2,
    n_agents=(2, 3),
    validation_instances=14,
)


def slow_down(rng, batch, n_nodes, n_agents):
    """A scenario of one's own."""
    return {"speeds": np.full((batch, n_agents), 0.5)}


def test_environments_fit_the_world_and_its_depot_rule():
    rng = np.random.default_rng(0)
    for scenario in SCENARIOS:
        problem = draw(rng, WORLD, 3, size=(8, 2), scenario=scenario)
        env = environment(problem, WORLD)
        assert env.rules.depot == ("final" if scenario == "plain" else "wait")
        assert env is environment(draw(rng, WORLD, 3, size=(8, 2), scenario=scenario), WORLD)  # built once
    assert environment(problem, replace(WORLD, world_depot="open")).rules.depot == "open"
    plain = draw(rng, WORLD, 3, size=(8, 2), scenario="plain")
    assert environment(plain, replace(WORLD, depot="wait")).rules.depot == "wait"


def test_a_scenario_of_ones_own():
    """In a world in which everybody is half as fast, everything takes twice as long."""
    config = replace(WORLD, scenario=("test_train_worlds:slow_down",))
    slow = draw(np.random.default_rng(1), config, 4, size=(7, 2))
    usual = Problem(2, {"nodes": slow.nodes, "speeds": torch.ones(4, 2, dtype=torch.float64)})
    actor = make_actor(nearest)  # which does not see how fast agents are
    once = play(actor, usual, replace(config, speed=0.01), "greedy").reward
    twice = play(actor, slow, replace(config, speed=0.02), "greedy").reward  # ticks that are twice as long
    assert torch.allclose(twice, 2 * once)


def test_one_scenario_draws_no_number():
    one, other = np.random.default_rng(2), np.random.default_rng(2)
    assert draw_scenario(one, replace(WORLD, scenario=("team",))) == "team"
    assert one.random() == other.random()
    drawn = {draw_scenario(one, WORLD) for _ in range(200)}
    assert drawn == set(SCENARIOS)


def test_scenarios_take_turns_in_sets_to_compare_policies_on():
    worlds = [part.world for part in draw_set(np.random.default_rng(3), WORLD, 14)]
    assert len(worlds) == 8 and set(worlds[:7]) == {
        (), ("appears",), ("breaks",), ("traffic",), ("speeds",), ("service",),
        ("speeds", "service", "appears", "breaks", "traffic"),
    }  # fmt: skip


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_decisions_that_are_evaluated_again_have_the_same_probability(scenario):
    """What the network read is kept with each decision, the keys of worlds included."""
    torch.manual_seed(4)
    network = JointDAN(JOINT).eval()
    for vector in network.effect.values():
        torch.nn.init.normal_(vector)
    problem = repeat(draw(np.random.default_rng(5), WORLD, 3, size=(8, 3), scenario=scenario), 2)
    episode = play(network, problem, WORLD, "greedy", keep=True)
    seen = environment(problem, WORLD).observation_spec.keys()
    assert {key for key in READABLE if key in episode.decisions} == set(READABLE) & set(seen)
    decisions = decisions_with_advantage(episode, torch.zeros(6))
    best = make_actor(network).get_dist(decisions).probs.max(1).values
    assert torch.allclose(log_probs(make_actor(network), decisions).exp(), best, atol=1e-6)
    again = replay(problem, episode.decisions["action"].T, network.in_keys, WORLD)
    assert torch.equal(again.reward, episode.reward)


@pytest.mark.parametrize("baseline", ["shared", "rollout"])
@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, monkeypatch, baseline):
    config = replace(WORLD, baseline=baseline, challenge_instances=16)
    reinforce(replace(config, out=tmp_path / "whole"))
    interrupt_after(3, ReinforceLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        reinforce(replace(config, out=tmp_path / "parts"))
    assert reinforce(replace(config, out=tmp_path / "parts", resume=True)).step == 6
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "baseline"):
        assert same(whole[key], parts[key]), key


def test_weights_start_to_read_with_no_effect(tmp_path):
    torch.manual_seed(6)
    plain = JointDAN(replace(JOINT, reads=()))
    save(tmp_path / "plain.safetensors", plain)
    config = replace(WORLD, init=str(tmp_path / "plain.safetensors"))
    assert make_network(config).config.reads == ()
    network = make_network(replace(config, reads=("service", "agent_speeds")))
    assert network.config.reads == ("service", "agent_speeds")
    for name, tensor in network.state_dict().items():
        assert torch.equal(tensor, plain.state_dict()[name] if name in plain.state_dict() else torch.zeros(16))
    save(tmp_path / "reading.safetensors", network)
    with pytest.raises(ValueError, match=r"would leave out weights that init='.*' holds: \['effect.agent_speeds'\]"):
        make_network(replace(config, init=str(tmp_path / "reading.safetensors"), reads=("service",)))
    assert load(tmp_path / "reading.safetensors").config.reads == ("service", "agent_speeds")
    with pytest.raises(ValueError, match="reads must be None: the policy 'dan' has no such option"):
        make_network(replace(config, policy="dan", init="dan", reads=("service",)))


@pytest.mark.parametrize(("option", "added"), [("distances", "distance_slopes"), ("polar", "embed_polar.weight")])
def test_weights_start_to_use_distances_and_polar_coordinates_with_no_effect(tmp_path, option, added):
    torch.manual_seed(6)
    save(tmp_path / "plain.safetensors", JointDAN(JOINT))
    config = replace(WORLD, init=str(tmp_path / "plain.safetensors"))
    network, plain = make_network(replace(config, **{option: True})), make_network(config)
    assert network.config == replace(plain.config, **{option: True})
    new = network.state_dict().keys() - plain.state_dict().keys()
    assert added in new and not any(network.state_dict()[name].any() for name in new)
    observation = BatchedMTSP(12, 3, [8], seed=0).reset()
    keys = [observation.get(key, None) for key in network.in_keys]
    assert torch.allclose(network(*keys), plain(*keys), atol=1e-5)
    save(tmp_path / "new.safetensors", network)
    assert getattr(load(tmp_path / "new.safetensors").config, option)
    with pytest.raises(ValueError, match=f"would leave out weights .*'{added}'"):
        make_network(replace(config, init=str(tmp_path / "new.safetensors"), **{option: False}))
