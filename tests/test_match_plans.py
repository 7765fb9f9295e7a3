"""Agents that have not left the depot may exchange their tours: the exchange that is chosen has the smallest loss."""

import itertools
from dataclasses import replace

import pytest
import torch
from tiny import TINY_PLANS

from dan_policy.dan import DAN, DANConfig
from dan_policy.joint import JointDAN
from dan_policy.layers import DenseLogits
from train.demonstrations import as_decisions, demonstrate
from train.imitate import ImitationLearner
from train.plans import add_plans, match_plans, plan_losses
from train.supervised import imitation_losses, learns_plans

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

KEYS = ("cities", "agents", "visited", "agent", "action_mask", ("game", "destination"))
CONFIG = replace(TINY_PLANS, n_nodes=(7, 9), n_agents=(3, 3), plan_matching="invariant")
NEXT_WEIGHT, ASSIGNMENT_WEIGHT = 0.7, 1.3


@pytest.fixture(params=[0, 1, 2])
def decisions(request):
    """Three games at a decision at which 3, 2 or 1 of three agents have not left the depot."""
    demonstrations = demonstrate(CONFIG, 0)
    whole, valid = as_decisions(demonstrations, KEYS, CONFIG)
    assert valid[request.param].all()
    return add_plans(whole, demonstrations)[request.param, :3]


def random_logits(decisions, seed):
    generator = torch.Generator().manual_seed(seed)
    n, m = decisions["visited"].shape[1], 3
    following = 3 * torch.randn(len(decisions), m, n, generator=generator)
    assignment = 3 * torch.randn(len(decisions), m, n, generator=generator)
    policy = following.gather(1, decisions["agent"][:, None, None].expand(-1, 1, n))[:, 0]
    return DenseLogits(policy, following, assignment)


def loss(logits, decisions):
    policy = logits.policy.masked_fill(~decisions["action_mask"], -torch.inf)
    next_loss, assignment_loss = plan_losses(logits, decisions)
    weighted = NEXT_WEIGHT * next_loss + ASSIGNMENT_WEIGHT * assignment_loss
    return float(torch.nn.functional.cross_entropy(policy, decisions["action"]) + weighted)


def exchanged(decisions, row, order):
    """The decisions if agent a of one row takes the tour of agent ``order[a]``."""
    changed = decisions.clone()
    for agent, taken in enumerate(order):
        changed["plan", "next"][row, agent] = decisions["plan", "next"][row, taken]
        cities = decisions["plan", "visitor"][row] == taken
        changed["plan", "visitor"][row, cities] = agent
    changed["plan", "visitor"][row, 0] = 0
    changed["action"][row] = changed["plan", "next"][row, decisions["agent"][row]]
    return changed


def exchanges(decisions):
    """All ways to exchange the tours of agents that have not left, over all rows."""
    orders = []
    for row in range(len(decisions)):
        waiting = (decisions["game", "destination"][row] == 0) & ~decisions["plan", "closed"][row]
        waiting = waiting.nonzero()[:, 0].tolist()
        others = [agent for agent in range(3) if agent not in waiting]
        orders.append([
            [dict(zip([*waiting, *others], [*order, *others], strict=True))[agent] for agent in range(3)]
            for order in itertools.permutations(waiting)
        ])  # fmt: skip
    for choice in itertools.product(*orders):
        changed = decisions
        for row, order in enumerate(choice):
            changed = exchanged(changed, row, order)
        yield changed


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("outputs", ["both", "next", "assignment", "policy"])
def test_no_exchange_of_tours_has_a_smaller_loss(decisions, seed, outputs):
    logits = random_logits(decisions, seed)
    logits = logits._replace(
        next=logits.next if outputs in ("both", "next") else None,
        assignment=logits.assignment if outputs in ("both", "assignment") else None,
    )
    before = decisions.clone()
    matched = match_plans(logits, decisions, NEXT_WEIGHT, ASSIGNMENT_WEIGHT)
    assert (decisions == before).all()  # it belongs to the caller
    losses = [loss(logits, one) for one in exchanges(decisions)]
    assert loss(logits, matched) == pytest.approx(min(losses), abs=1e-5)
    waiting = int(((decisions["game", "destination"] == 0) & ~decisions["plan", "closed"]).sum())
    assert len(losses) == {9: 216, 6: 8, 3: 1}[waiting]


def test_every_agent_keeps_a_whole_tour(decisions):
    matched = match_plans(random_logits(decisions, 0), decisions, NEXT_WEIGHT, ASSIGNMENT_WEIGHT)
    assert any((one == matched).all() for one in exchanges(decisions))
    assert matched["action_mask"].gather(1, matched["action"][:, None]).all()


def test_an_exchange_is_found_where_the_network_prefers_it(decisions):
    """The network prefers every plan reversed among the waiting agents; matching makes its loss vanish."""
    waiting = (decisions["game", "destination"] == 0) & ~decisions["plan", "closed"]
    wanted = decisions
    for row in range(len(decisions)):
        alike = waiting[row].nonzero()[:, 0].tolist()
        swap = dict(zip(alike, reversed(alike), strict=True))
        wanted = exchanged(wanted, row, [swap.get(agent, agent) for agent in range(3)])
    n = decisions["visited"].shape[1]
    following = 50.0 * torch.nn.functional.one_hot(wanted["plan", "next"], n)
    assignment = 50.0 * torch.nn.functional.one_hot(wanted["plan", "visitor"], 3).transpose(1, 2)
    policy = 50.0 * torch.nn.functional.one_hot(wanted["action"], n)
    logits = DenseLogits(policy, following, assignment)
    matched = match_plans(logits, decisions, 1.0, 1.0)
    assert loss(logits, matched) < 1e-6
    assert torch.equal(matched["action"], wanted["action"])


def test_the_invariant_loss_is_at_most_the_canonical_one():
    torch.manual_seed(0)
    network = JointDAN(CONFIG.joint)
    demonstrations = demonstrate(CONFIG, 0)
    whole, valid = as_decisions(demonstrations, KEYS, CONFIG)
    whole = add_plans(whole, demonstrations)
    lower = []
    for step in range(len(whole)):
        one = whole[step][valid[step]]
        with torch.no_grad():
            invariant = imitation_losses(network, one, CONFIG)
            canonical = imitation_losses(network, one, replace(CONFIG, plan_matching="canonical"))
        assert invariant.total <= canonical.total + 1e-5
        lower.append(bool(invariant.total < canonical.total - 1e-3))
    assert lower[:2] == [True, True] and not any(lower[2:])  # two or more agents wait only at the first two decisions


def test_it_needs_dense_outputs_and_trains():
    dan = DAN(DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2))
    with pytest.raises(ValueError, match=r"plan_matching must be 'canonical' for networks without .* such as DAN"):
        learns_plans(dan, CONFIG)
    assert learns_plans(JointDAN(CONFIG.joint), replace(CONFIG, next_weight=0.0, assignment_weight=0.0))
    learner = ImitationLearner(CONFIG)
    logs = [learner.train_step() for _ in range(3)]
    assert all(log["loss"] > 0 and log["grad_norm"] > 0 for log in logs)
