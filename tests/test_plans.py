"""The teacher's plan labels every agent and every city; networks learn from it, and resume bit for bit."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.states import same
from tiny import TINY_PLANS as TINY
from tiny import interrupt_after

from dan_policy.dan import DAN, DANConfig
from dan_policy.games import as_links
from dan_policy.joint import JointDAN
from dan_policy.layers import DenseLogits
from dan_policy.registry import load
from mtsp_env.instance import Problem
from train import checkpoint
from train.baseline import better
from train.buffer import Buffer
from train.collect import costs
from train.demonstrations import Demonstrations, as_decisions, demonstrate
from train.imitate import ImitationLearner, imitate
from train.network import observation_keys
from train.plans import PLAN_KEYS, add_plans, plan_losses, visitors
from train.supervised import imitation_losses, learns_plans, rate

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

JOINT = TINY.joint
KEYS = ("cities", "agents", "visited", "agent", "action_mask", ("game", "destination"))


@pytest.fixture
def solved():
    """Three agents: 0 goes east, then north; 1 visits one city next to the depot; 2 goes west, then south."""
    nodes = np.array([[0.5, 0.5], [0.9, 0.5], [0.9, 0.9], [0.5, 0.55], [0.1, 0.5], [0.1, 0.1]])
    return Demonstrations(nodes[None], *as_links([[[0, 1, 2, 0], [0, 3, 0], [0, 4, 5, 0]]], 6))


@pytest.fixture
def decisions(solved):
    """The six decisions of that game: everyone leaves, agent 1 goes home, agents 0 and 2 visit their second cities."""
    decisions, valid = as_decisions(solved, KEYS, TINY)
    assert valid.all() and decisions["agent"][:, 0].tolist() == [0, 1, 2, 1, 0, 2]
    return add_plans(decisions, solved)[:, 0]


def test_plans_label_waiting_travelling_and_closed_agents(decisions):
    plan = decisions["plan"]
    home = None  # a closed agent has no next node
    expected = [[1, 3, 4], [2, 3, 4], [2, 0, 4], [2, 0, 5], [2, home, 5], [0, home, 5]]
    assert plan["closed"].tolist() == [[node is home for node in row] for row in expected]
    for labels, row in zip(plan["next"].tolist(), expected, strict=True):
        assert [label for label, node in zip(labels, row, strict=True) if node is not home] == [
            node for node in row if node is not home
        ]
    assert plan["visitor"].tolist() == [[0, 0, 0, 1, 2, 2]] * 6
    own = plan["next"].gather(1, decisions["agent"][:, None])[:, 0]
    assert torch.equal(own, decisions["action"])


def test_every_label_of_a_set_fits_its_decision():
    """The deciding agent's label is its action; next nodes are unvisited; a city's visitor visits it."""
    for index in range(4):
        demonstrations = demonstrate(TINY, index)
        decisions, valid = as_decisions(demonstrations, KEYS, TINY)
        decisions = add_plans(decisions, demonstrations)
        one = decisions[valid]
        closed, following = one["plan", "closed"], one["plan", "next"]
        assert torch.equal(following.gather(1, one["agent"][:, None])[:, 0], one["action"])
        assert not closed.gather(1, one["agent"][:, None]).any()
        assert not one["visited"].gather(1, following)[~closed].any()
        for t, b in valid.nonzero().tolist():
            if (city := int(decisions["action"][t, b])) != 0:
                assert visitors(demonstrations)[b, city] == decisions["agent"][t, b]


def test_losses_of_uniform_logits_count_what_is_open(decisions):
    """First decision: six nodes and three agents. Last: two nodes (city 5 and the depot), and two open agents."""
    zeros = torch.zeros(1, 3, 6)
    for step, nodes, agents in ((0, 6, 3), (5, 2, 2)):
        next_loss, assignment_loss = plan_losses(DenseLogits(zeros[:, 0], zeros, zeros), decisions[step : step + 1])
        assert float(next_loss) == pytest.approx(math.log(nodes))
        assert float(assignment_loss) == pytest.approx(math.log(agents))


def test_losses_vanish_for_the_teachers_plan_and_ignore_closed_agents(decisions):
    plan = decisions["plan"]
    following = 50.0 * torch.nn.functional.one_hot(plan["next"], 6)
    assignment = 50.0 * torch.nn.functional.one_hot(plan["visitor"], 3).transpose(1, 2)
    closed = plan["closed"][:, :, None]
    for noise in (0.0, 100.0):  # added to the logits of closed agents
        logits = DenseLogits(following[:, 0], following + noise * closed, assignment + noise * closed)
        assert max(map(float, plan_losses(logits, decisions))) < 1e-6
    wrong = DenseLogits(following[:, 0], following.flip(2), assignment.flip(1))
    assert min(map(float, plan_losses(wrong, decisions))) > 1.0


def test_a_network_may_have_only_one_of_the_outputs(decisions):
    logits = torch.zeros(6, 3, 6)
    next_loss, assignment_loss = plan_losses(DenseLogits(logits[:, 0], None, logits), decisions)
    assert float(next_loss) == 0.0 and float(assignment_loss) > 0.0


def test_the_policys_loss_is_the_same_with_and_without_plans(decisions):
    torch.manual_seed(0)
    network = JointDAN(JOINT)
    with torch.no_grad():
        dense, plain = (imitation_losses(network, part, TINY) for part in (decisions, decisions.exclude("plan")))
    assert float(dense.loss) == pytest.approx(float(plain.loss), rel=1e-5) and dense.agreed == plain.agreed
    assert dense.next > 0 and dense.assignment > 0 and plain.next == plain.assignment == 0


@pytest.mark.parametrize("labels", ["actions", "plans", "targets"])
def test_no_label_leaves_it_to_the_rule_to_keep_agents_out(decisions, labels):
    """By "final", nobody may go home at the first three decisions. The losses fall if the depot is less likely."""

    class Fixed(torch.nn.Module):
        in_keys = ("cities", "agents", "visited")

        def __init__(self):
            super().__init__()
            self.logits = torch.nn.Parameter(torch.zeros(6, 3, 6))

        def forward(self, cities, agents, visited):
            return self.logits[:, 0]

        def forward_dense(self, *observation):
            return DenseLogits(self.logits[:, 0], None, None)

    assert decisions["action_mask"][:, 0].tolist() == [False, False, False, True, True, True]
    given = decisions if labels == "plans" else decisions.exclude("plan")
    if labels == "targets":
        given = given.set("target", torch.nn.functional.one_hot(given["action"], 6).float())
    network = Fixed()
    imitation_losses(network, given, TINY).total.backward()
    slope = network.logits.grad[:, 0]
    assert (slope[:3, 0] > 0).all()
    assert torch.equal(slope == 0, decisions["visited"])  # visited cities are nothing to learn about


@pytest.mark.slow
def test_dan_learns_who_visits_each_city():
    dan = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True, assignment=True)
    learner = ImitationLearner(replace(TINY, policy="dan", network=dan, learning_rate=1e-2))
    logs = [learner.train_step() for _ in range(12)]
    assert all(log["next_loss"] == 0.0 for log in logs)
    assert 0 < logs[-1]["assignment_loss"] < logs[0]["assignment_loss"]


@pytest.mark.slow
def test_weights_of_zero_and_networks_without_the_outputs_need_no_plans():
    joint, dan = JointDAN(JOINT), DAN(DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2))
    off = replace(TINY, next_weight=0.0, assignment_weight=0.0)
    assert learns_plans(joint, TINY) and not learns_plans(joint, off) and not learns_plans(dan, TINY)
    dense_dan = DAN(replace(dan.config, assignment=True))
    assert learns_plans(dense_dan, TINY) and not learns_plans(dense_dan, replace(TINY, assignment_weight=0.0))
    for network, config in ((joint, TINY), (joint, off), (dan, TINY), (dense_dan, TINY)):
        plans = learns_plans(network, config)
        keys = observation_keys(network)
        batch = Buffer(config, keys, np.random.default_rng(0), plans).draw(1)[0]
        assert ("plan" in batch.keys()) is plans  # noqa: SIM118
        assert {*keys, *(PLAN_KEYS if plans else ())} <= set(batch.keys(include_nested=True))


@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, monkeypatch):
    imitate(replace(TINY, out=tmp_path / "whole"))

    interrupt_after(5, ImitationLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        imitate(replace(TINY, out=tmp_path / "parts"))
    assert checkpoint.read(tmp_path / "parts" / "checkpoint.pt")["progress"]["step"] == 5
    assert imitate(replace(TINY, out=tmp_path / "parts", resume=True)).step == 12
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "buffer"):
        assert same(whole[key], parts[key]), key
    assert load(tmp_path / "whole" / "best.safetensors").config == JOINT


@pytest.mark.slow
def test_imitation_of_plans_learns_what_the_teacher_does(tmp_path):
    """120 steps at n = 10, m = 2 lower the greedy cost on held-out instances."""
    config = replace(
        TINY, out=tmp_path, n_nodes=(10, 10), n_agents=(2, 2), set_tokens=2000, sets_per_step=3, steps=120, average=0.9,
        learning_rate=3e-3, warmup=10, validate_every=1000, checkpoint_every=1000,
        joint=replace(JOINT, embed_dim=32, feedforward_dim=64, n_layers=2),
    )  # fmt: skip
    nodes = torch.rand(256, 10, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    held_out = [Problem(2, {"nodes": nodes})]
    before = costs(ImitationLearner(config).averaged_network, held_out, config)
    after = costs(imitate(config).averaged_network, held_out, config)
    assert better(after, before, 1e-6)
    assert after.mean() < 0.85 * before.mean()


def test_the_learning_rate_may_follow_the_clock():
    config = replace(TINY, steps=1000, warmup=10, final_rate=0.1, anneal_seconds=50.0)
    assert rate(config, 20, seconds=25.0) == pytest.approx(0.55)
    assert rate(config, 20, seconds=50.0) == rate(config, 20, seconds=80.0) == pytest.approx(0.1)
    assert rate(config, 1000, seconds=1.0) == pytest.approx(0.1)
    assert rate(config, 4, seconds=25.0) == 0.5  # still warming up


@pytest.mark.parametrize("name", ["next_weight", "assignment_weight"])
def test_negative_weights_are_refused(name):
    with pytest.raises(ValueError, match=f"{name} must be finite and at least 0, got -0.5"):
        replace(TINY, **{name: -0.5})
