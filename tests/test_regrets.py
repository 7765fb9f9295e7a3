"""Learning from regrets: what a student's decisions cost, the policy that it should have, and runs that learn it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.completions import choices_of, decided, least_makespan
from helpers.states import same
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import TINY, TINY_PLANS, interrupt_after

from dan_policy import DAN, JointDAN, load, save
from mtsp_env import Instance
from train import checkpoint
from train.buffer import Buffer
from train.demonstrations import demonstrate
from train.imitate import ImitationLearner, imitate
from train.network import make_network
from train.plans import learnable_nodes
from train.regrets import GREATEST_REGRET, LEAST_PROBABILITY, Corrections, game_regrets, improved, with_hindsight
from train.supervised import imitation_losses

pytest.importorskip("numba", reason="the teacher is compiled with Numba")


@pytest.fixture
def regretful(tmp_path):
    """The options of a run that learns from the regrets of an untrained student."""
    torch.manual_seed(3)
    save(tmp_path / "student.safetensors", JointDAN(TINY_PLANS.joint))
    return replace(TINY_PLANS, labels="regrets", roll_in=str(tmp_path / "student.safetensors"))


def test_probabilities_fall_by_e_for_each_temperature_of_regret():
    prior = np.array([0.5, 0.25, 0.05, 0.2], np.float32)
    regret = np.array([0.0, 0.01, 0.02, np.inf], np.float32)
    target, expected = improved(prior, regret, temperature=0.01)
    weights = np.array([0.5, 0.25 / np.e, 0.05 / np.e**2])
    assert target[:3] == pytest.approx(0.8 * weights / weights.sum(), rel=1e-5)
    assert target[3] == pytest.approx(0.2)  # nothing is known about it
    assert expected == pytest.approx((0.25 * 0.01 + 0.05 * 0.02) / 0.8, rel=1e-5)


def test_a_node_that_the_student_never_takes_is_learnt_if_all_others_are_bad():
    target, _ = improved(np.array([1.0, 0.0]), np.array([1.0, 0.0]), temperature=0.002)
    assert target[1] > 0.99  # 25 temperatures


def test_the_best_node_counts_as_somewhat_likely_but_only_if_the_likely_ones_cost():
    """A student that is certain of node 0 learns to go to node 1 if the difference is large."""
    certain = np.array([1.0, 0.0])
    assert improved(certain, np.array([0.0, 0.0]), temperature=0.004)[0] == pytest.approx(certain)
    assert improved(certain, np.array([0.0, 0.02]), temperature=0.004)[0] == pytest.approx(certain)
    least = LEAST_PROBABILITY * (1 - np.exp(-5.0))
    assert improved(certain, np.array([0.02, 0.0]), temperature=0.004)[0][1] == pytest.approx(
        least / (least + np.exp(-5.0)), rel=1e-5
    )


def test_hindsight_lowers_what_the_chosen_nodes_cost():
    """Node 1 seemed to cost 10 % more than node 2, but its game ended at 1.05; node 4 would have been 1 % shorter."""
    costs = [(0, 1, {1: 1.1, 2: 1.0}), (1, 2, {2: 1.05}), (2, 3, {3: 1.05, 4: 1.04, 5: 1.06})]
    regrets = dict(with_hindsight(costs))
    assert list(regrets) == [0, 2]
    assert regrets[0] == pytest.approx({1: 0.04, 2: 0.0})
    share = (0.04 + 0.01 / 1.04) / (0.1 + 0.01 / 1.04)  # of the regrets of chosen nodes that is left
    assert regrets[2] == pytest.approx({3: 0.01 / 1.04, 4: 0.0, 5: 0.02 / 1.04 * share})


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=100, deadline=None)
def test_in_hindsight_the_regrets_of_the_chosen_nodes_make_up_the_gap_of_the_game(seed):
    """As the teacher's tours are kept, one node always costs what the node chosen before did: here node 0."""
    rng = np.random.default_rng(seed)
    costs, cost = [], 1.0
    for step in range(6):
        after = {0: cost, 1: 1.0 + rng.random(), 2: 1.0 + rng.random()}
        chosen = int(rng.integers(3))
        costs.append((step, chosen, after))
        cost = after[chosen]
    regrets = dict(with_hindsight(costs))
    shortest = min(min(after.values()) for _, _, after in costs)
    assert np.prod([1.0 + regrets[step][node] for step, node, _ in costs]) == pytest.approx(cost / shortest, rel=1e-9)
    assert all(min(after.values()) == 0.0 for after in regrets.values())


def test_regrets_have_a_greatest_value():
    """Larger regrets count as the greatest one: both in what the student expects and in its target."""
    prior = np.array([0.5, 0.5])
    target, expected = improved(prior, np.array([1.0, 0.0]), temperature=0.05)
    assert expected == pytest.approx(GREATEST_REGRET / 2)
    assert target[0] == pytest.approx(1 / (1 + np.e))


@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1.0))
@settings(max_examples=100, deadline=None)
def test_targets_are_probabilities_and_lose_no_more_than_the_student(seed, temperature):
    rng = np.random.default_rng(seed)
    prior = rng.dirichlet(np.ones(6), size=4).astype(np.float32)
    regret = np.where(rng.random((4, 6)) < 0.5, rng.exponential(0.02, (4, 6)), np.inf)
    regret[0] = np.inf
    regret[1] = np.where(np.isfinite(regret[1]), 0.0, np.inf)
    target, expected = improved(prior, regret, temperature)
    assert target.sum(-1) == pytest.approx(np.ones(4), abs=1e-5)
    assert target[:2] == pytest.approx(prior[:2], abs=2e-6)  # nothing known, or nothing to choose between
    known = np.isfinite(regret)
    cost = np.where(known, np.minimum(regret, GREATEST_REGRET), 0.0)
    after = (np.where(known, target, 0.0) * cost).sum(-1) / np.maximum(np.where(known, target, 0.0).sum(-1), 1e-6)
    assert (after <= expected + 1e-6).all()


@pytest.mark.slow
def test_regrets_of_small_games_are_exact():
    """Along a random game, the regret of each node is how much longer the best tours after it are than the best."""
    rng = np.random.default_rng(5)
    tried = 0
    for _ in range(8):
        instance = Instance(rng.random((6, 2)), 2)
        prefixes, deciders, chosen, states = [[0], [0]], [], [], []
        for step in range(5):
            agent = step % 2
            node = int(rng.choice(choices_of(instance, prefixes, agent)[:-1]))
            states.append([list(prefix) for prefix in prefixes])
            deciders.append(agent)
            chosen.append(node)
            prefixes[agent].append(node)
        turns = zip(states, deciders, strict=True)
        legal = np.array([[node in choices_of(instance, *turn) for node in range(6)] for turn in turns])
        game = (np.array(deciders), legal, legal / 6.0, np.array(chosen))  # everything is likely
        for step, regrets in game_regrets(instance, *game, teacher_iterations=1000, seed=0):
            nodes = choices_of(instance, states[step], deciders[step])
            costs = {node: least_makespan(instance, decided(states[step], deciders[step], node)) for node in nodes}
            for node, regret in regrets.items():
                assert regret == pytest.approx(costs[node] / min(costs[other] for other in regrets) - 1.0, abs=1e-6)
                tried += 1
    assert tried > 50


def random_game(seed: int, n_nodes: int, n_agents: int) -> tuple[Instance, tuple[np.ndarray, ...]]:
    """An instance, and a game in which agents take turns to go to random cities; every city looks likely."""
    rng = np.random.default_rng(seed)
    cities = rng.permutation(n_nodes - 1) + 1
    legal = np.ones((n_nodes - 1, n_nodes), bool)
    legal[:, 0] = False
    for step in range(1, n_nodes - 1):
        legal[step, cities[:step]] = False
    deciders = np.arange(n_nodes - 1) % n_agents
    return Instance(rng.random((n_nodes, 2)), n_agents), (deciders, legal, legal / n_nodes, cities)


def test_regrets_are_relative_to_the_best_node_not_to_the_teachers_first_plan():
    instance, game = random_game(6, n_nodes=30, n_agents=3)
    for _, regrets in game_regrets(instance, *game, teacher_iterations=1, seed=0):
        assert min(regrets.values()) == 0.0 and len(regrets) > 1


def test_only_legal_nodes_are_tried_even_if_the_teacher_would_leave_an_agent_at_home():
    """Two agents take what the third should have visited, which must visit a city nevertheless."""
    for seed in range(5):
        instance, (_, legal, *game) = random_game(seed, n_nodes=8, n_agents=3)
        deciders = np.array([0, 1, 0, 1, 0, 1, 2])
        steps = list(game_regrets(instance, deciders, legal, *game, teacher_iterations=20, seed=0))
        assert len(steps) >= 5 and all(legal[step, list(regrets)].all() for step, regrets in steps)


@pytest.mark.slow
def test_corrections_are_of_the_students_own_games(regretful):
    network = load(regretful.roll_in)
    for index in range(3):
        corrections = demonstrate(regretful, index)
        assert isinstance(corrections, Corrections)
        decisions, valid = corrections.decisions("cpu")
        target, legal = decisions["target"], decisions["action_mask"]
        assert valid.any(1).all() and valid[:-1].all()  # only the last row is filled up
        assert torch.allclose(target.sum(-1), torch.ones(valid.shape), atol=1e-5) and not target[~legal].any()
        logits = network(*(decisions[key] for key in network.in_keys))
        prior = logits.masked_fill(~legal, -torch.inf).softmax(-1)
        weight = decisions["weight"][valid]
        games, n_nodes = valid.shape[1], decisions["action_mask"].shape[-1]
        assert (weight >= 1.0).all() and weight.sum() >= games * (n_nodes - 1)  # they stand for all decisions
        unchanged = torch.isclose(prior, target, atol=1e-4).all(-1)
        assert unchanged.any() and not unchanged.all()
        open_nodes = (~decisions["visited"]).sum(-1).flatten()[valid.flatten()]
        closed = decisions["agents"].shape[2]  # at the same index, games differ by the agents that have gone home
        assert (open_nodes.diff() <= closed).all()


@pytest.mark.slow
def test_every_correction_is_used_as_often_as_passes_say(regretful):
    for passes in (0.5, 1.0, 2.5):
        buffer = Buffer(replace(regretful, passes=passes, buffer=2), (), np.random.default_rng(0))
        buffer.add(0)
        rows = len(buffer.sets[0][1])
        counts = np.bincount(buffer.left[0], minlength=rows)
        assert counts.sum() == max(1, round(passes * rows)) and counts.max() - counts.min() <= 1


@pytest.mark.slow
@pytest.mark.parametrize("network", [JointDAN, DAN])
def test_the_loss_is_0_if_the_targets_are_met_and_falls_as_they_are_learnt(regretful, network):
    policy = "joint" if network is JointDAN else "dan"
    config = replace(regretful, policy=policy, network=TINY.network)
    decisions, valid = demonstrate(config, 0).decisions("cpu")
    batch = decisions[valid]
    torch.manual_seed(0)
    learner = make_network(config)
    met = batch.clone()
    logits = learner(*(met[key] for key in learner.in_keys)).detach()
    met["target"] = logits.masked_fill(~learnable_nodes(met), -torch.inf).softmax(-1)
    assert imitation_losses(learner, met, config).total.item() == pytest.approx(0.0, abs=1e-5)
    optimiser = torch.optim.Adam(learner.parameters(), lr=1e-3)
    losses = []
    for _ in range(60):
        losses.append(imitation_losses(learner, batch, config).total)
        optimiser.zero_grad()
        losses[-1].backward()
        optimiser.step()
    assert min(losses) >= 0.0 and losses[-1] < 0.7 * losses[0]


@pytest.mark.slow
def test_decisions_count_by_their_weights(regretful):
    decisions, valid = demonstrate(regretful, 0).decisions("cpu")
    batch, learner = decisions[valid], make_network(regretful)
    twice = torch.cat([batch, batch[:3]])
    twice["weight"], batch["weight"] = torch.ones(len(twice)), torch.ones(len(batch))
    batch["weight"][:3] = 2.0
    loss, expected = (imitation_losses(learner, one, regretful).total.item() for one in (batch, twice))
    assert loss == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
def test_a_run_resumes_bit_for_bit_and_workers_make_the_same_sets(tmp_path, monkeypatch, regretful):
    imitate(replace(regretful, out=tmp_path / "whole", workers=1))
    interrupt_after(5, ImitationLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        imitate(replace(regretful, out=tmp_path / "parts"))
    imitate(replace(regretful, out=tmp_path / "parts", resume=True, workers=1))
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "buffer"):
        assert same(whole[key], parts[key]), key


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"labels": "costs"}, "labels must be 'tours', 'regrets' or 'policy', got 'costs'"),
        ({"regret_temperature": 0.0}, "regret_temperature must be finite and above 0, got 0.0"),
        ({"roll_in": None}, "labels='regrets' needs a network in roll_in, .* got None"),
        ({"scenario": ("team",)}, r"labels='regrets' needs .* got .*, \('team',\)"),
        ({"plan_matching": "invariant"}, "labels='regrets' needs .* 'invariant'"),
        ({"passes": 0.0}, "passes must be above 0 and at most 100, got 0.0"),
        ({"passes": 101.0}, "passes must be above 0 and at most 100, got 101.0"),
    ],
)
def test_bad_options_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(TINY_PLANS, **({"labels": "regrets", "roll_in": "default"} | change))
