"""Learning another network's policy in its own games."""

from dataclasses import replace

import pytest
import torch
from tiny import TINY, TINY_PLANS

from dan_policy import DAN, JointDAN, save
from train import checkpoint
from train.demonstrations import demonstrate
from train.imitate import imitate
from train.network import make_network
from train.plans import policy_log_probs
from train.supervised import imitation_losses


@pytest.fixture
def distilled(tmp_path):
    """The options of a run that learns the policy of an untrained network."""
    torch.manual_seed(3)
    save(tmp_path / "known.safetensors", JointDAN(TINY_PLANS.joint))
    return replace(TINY_PLANS, labels="policy", roll_in=str(tmp_path / "known.safetensors"))


def test_labels_are_the_networks_policy_at_every_decision_of_its_games(distilled):
    network = make_network(replace(distilled, init=distilled.roll_in)).eval()
    for index in range(3):
        decisions, valid = demonstrate(distilled, index).decisions("cpu")
        assert (valid.sum(0) >= decisions["visited"].shape[2] - 1).all()  # every city once
        batch = decisions[valid]
        logits = network(*(batch[key] for key in network.in_keys)).detach()
        policy = logits.masked_fill(~batch["action_mask"], -torch.inf).softmax(1)
        assert torch.allclose(policy, batch["target"], atol=1e-6)


def test_a_network_has_nothing_to_learn_from_itself_but_what_the_rule_forbade(distilled):
    network = make_network(replace(distilled, init=distilled.roll_in)).eval()
    decisions, valid = demonstrate(distilled, 0).decisions("cpu")
    batch = decisions[valid]
    allowed = batch["action_mask"][:, 0]
    assert allowed.any() and not allowed.all()
    assert imitation_losses(network, batch[allowed], distilled).total.item() == pytest.approx(0.0, abs=1e-5)
    logits = network(*(batch[key] for key in network.in_keys)).detach()
    at_the_depot = policy_log_probs(logits, batch)[~allowed, 0].exp()
    expected = -torch.log1p(-at_the_depot).mean()  # it would have gone there by another rule
    assert expected > 0.01
    assert imitation_losses(network, batch[~allowed], distilled).total.item() == pytest.approx(
        expected.item(), rel=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("network", [JointDAN, DAN])
def test_any_network_learns_the_policy_of_another(tmp_path, distilled, network):
    policy = "joint" if network is JointDAN else "dan"
    run = replace(distilled, policy=policy, network=TINY.network, out=tmp_path / "run", steps=200, learning_rate=1e-2)
    imitate(replace(run, warmup=2, validate_every=200, checkpoint_every=200))
    losses = []
    for weights in (None, str(tmp_path / "run" / "last.safetensors")):
        torch.manual_seed(5)
        learner = make_network(replace(run, init=weights)).eval()
        sets = (demonstrate(replace(distilled, seed=77), index).decisions("cpu") for index in range(4))
        each = [imitation_losses(learner, decisions[valid], distilled).total.item() for decisions, valid in sets]
        losses.append(sum(each))
    assert losses[1] < 0.5 * losses[0], losses
    assert checkpoint.read(tmp_path / "run" / "checkpoint.pt")["progress"]["step"] == 200


@pytest.mark.parametrize("change", [{"roll_in": None}, {"scenario": ("team",)}, {"plan_matching": "invariant"}])
def test_what_needs_a_network_and_plain_games_says_so(change):
    with pytest.raises(ValueError, match="labels='policy' needs a network in roll_in"):
        replace(TINY_PLANS, **({"labels": "policy", "roll_in": "default"} | change))
