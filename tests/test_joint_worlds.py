"""What a JointDAN reads in worlds: no effect before it is learnt, the symmetries of the plain network, gradients."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dan_policy import load, make_actor, rollout, save, solve
from dan_policy.joint import AGENT_KEYS, READABLE, JointConfig, JointDAN
from mtsp_env import SCENARIOS, uniform
from mtsp_env.batched import BatchedMTSP, random_legal_action
from mtsp_env.rules import OBSERVED

KEYS = tuple(READABLE)
SMALL = JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=2)
PLAIN_KEYS = ("cities", "agents", "visited", "agent")


def networks(learnt=False):
    """A plain network, and one with the same weights that reads all keys; ``learnt``: they have an effect."""
    torch.manual_seed(0)
    plain, reading = JointDAN(SMALL).eval(), JointDAN(replace(SMALL, reads=KEYS)).eval()
    reading.load_state_dict(reading.state_dict() | plain.state_dict())
    if learnt:
        for vector in reading.effect.values():
            torch.nn.init.normal_(vector)
    return plain, reading


def observations(scenario, steps=12, **options):
    """Some decisions of random games."""
    env = BatchedMTSP(12, 4, 6, scenario=scenario, depot="wait", seed=1, **options)
    state, generator = env.reset(), torch.Generator().manual_seed(2)
    for _ in range(steps):
        yield state.select(*PLAIN_KEYS, *(key for key in KEYS if key in state))
        state = env.step(state.set("action", random_legal_action(state["action_mask"], generator)))["next"]


def inputs(seen, keys=KEYS):
    return [seen[key] for key in PLAIN_KEYS], [seen.get(key, None) for key in keys]


def test_all_keys_that_worlds_add_can_be_read():
    assert set(READABLE) == set(OBSERVED)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("options", [{}, {"view": 4, "hearing": 0.3}])
def test_before_it_is_learnt_reading_changes_nothing(scenario, options):
    plain, reading = networks()
    for seen in observations(scenario, **options):
        known, extra = inputs(seen)
        assert torch.equal(reading(*known, *extra), plain(*known))
        for ours, theirs in zip(reading.forward_dense(*known, *extra), plain.forward_dense(*known), strict=True):
            assert torch.equal(ours, theirs)


def test_each_key_matters_once_it_is_learnt():
    _, reading = networks(learnt=True)
    seen = list(observations("everything", view=5, hearing=0.5))[10]
    known, extra = inputs(seen)
    assert not any(values is None for values in extra)
    logits = reading(*known, *extra)
    for index, key in enumerate(KEYS):
        without = [None if i == index else values for i, values in enumerate(extra)]
        assert not torch.allclose(reading(*known, *without), logits, atol=1e-4), key


def test_a_key_that_is_not_there_counts_as_neutral():
    _, reading = networks(learnt=True)
    for seen in observations("plain", steps=3):
        known, extra = inputs(seen)
        assert extra == [None] * len(KEYS)
        sizes = {key: 4 if key in AGENT_KEYS else 12 for key in KEYS}
        neutral = [torch.full((6, sizes[key]), READABLE[key]) for key in KEYS]
        assert torch.equal(reading(*known), reading(*known, *neutral))
        assert torch.equal(reading(*known), reading(*known, *extra))


def test_symmetries_hold_for_what_is_read():
    """Permuting cities permutes logits; permuting agents permutes dense rows."""
    _, reading = networks(learnt=True)
    seen = list(observations("everything", hearing=0.5))[8]
    (cities, agents, visited, agent), extra = inputs(seen)
    read = dict(zip(KEYS, extra, strict=True))
    towns = torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(11) + 1])
    team = torch.tensor([2, 0, 3, 1])
    moved = (team[None] == agent[:, None]).int().argmax(1)
    permuted = [values[:, team if key in AGENT_KEYS else towns] for key, values in read.items()]
    before = reading.forward_dense(cities, agents, visited, agent, *extra)
    after = reading.forward_dense(cities[:, towns], agents[:, team], visited[:, towns], moved, *permuted)
    assert torch.allclose(after.policy, before.policy[:, towns], atol=1e-5)
    assert torch.allclose(after.next, before.next[:, team][:, :, towns], atol=1e-5)
    assert torch.allclose(after.assignment, before.assignment[:, team][:, :, towns], atol=1e-5)
    fixed = [values[:, team] if key in AGENT_KEYS else values for key, values in read.items()]
    only_keys = reading.forward_dense(cities, agents, visited, agent, *fixed)
    assert not torch.allclose(only_keys.policy, before.policy, atol=1e-3)  # whose speed it is matters


def test_gradients_reach_what_is_read():
    _, reading = networks()
    seen = list(observations("everything", view=5, hearing=0.5))[10]
    known, extra = inputs(seen)
    reading(*known, *extra).square().sum().backward()
    for key, vector in reading.effect.items():
        assert vector.grad.abs().max() > 0, key


def test_files_keep_what_is_read_and_older_files_read_nothing(tmp_path):
    _, reading = networks(learnt=True)
    save(tmp_path / "reading.safetensors", reading)
    again = load(tmp_path / "reading.safetensors")
    assert again.config.reads == KEYS and again.in_keys == (*PLAIN_KEYS, *KEYS)
    seen = list(observations("everything"))[5]
    known, extra = inputs(seen)
    assert torch.equal(again(*known, *extra), reading(*known, *extra))
    assert load("default").config.reads == () and load("default").in_keys == PLAIN_KEYS


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["plain", "team", "everything"])
def test_it_plays_in_every_world_as_an_actor(scenario):
    _, reading = networks(learnt=True)
    env = BatchedMTSP(10, 3, 4, scenario=scenario, depot="wait", seed=3)
    one = rollout(reading, env, "greedy", keep=("agent",))
    env.set_seed(3)
    other = rollout(make_actor(reading), env, "greedy", keep=("agent",))
    assert torch.equal(one.decisions["action"], other.decisions["action"])
    assert bool(one.last["terminated"].all())


@pytest.mark.slow
def test_plain_instances_are_solved_as_by_the_plain_network():
    plain, reading = networks()
    instance = uniform(np.random.default_rng(4), 15, 3)
    assert solve(instance, reading).tours == solve(instance, plain).tours
    assert solve(instance, make_actor(reading)).tours == solve(instance, plain).tours
