"""Actors: any network plugs in, masked nodes are never picked, TorchRL's collector takes them."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, set_exploration_type

from dan_policy import DAN, DANConfig, make_actor, rollout
from dan_policy.actor import FiniteCategorical, as_actor
from dan_policy.network import network_keys
from mtsp_env.batched import BatchedMTSP

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


@pytest.mark.slow
def test_visited_cities_get_probability_zero(network):
    env = BatchedMTSP(12, 3, [8], seed=0)
    actor, td = make_actor(network), env.reset()
    for _ in range(6):
        probability = actor.get_dist(td).probs
        assert (probability[~td["action_mask"]] == 0).all()
        assert torch.allclose(probability.sum(-1), torch.ones(8), atol=1e-6)
        td = env.step(actor(td))["next"]


def test_greedy_takes_the_likeliest_and_sampling_follows_the_softmax():
    logits = torch.tensor([0.0, 2.0, 1.0, 9.0])
    actor = make_actor(lambda cities, agents, visited: logits.expand(cities.shape[:-1]))
    td = TensorDict(
        {
            "cities": torch.zeros(20_000, 4, 2),
            "agents": torch.zeros(20_000, 1, 3),
            "visited": torch.zeros(20_000, 4, dtype=torch.bool),
            "action_mask": torch.tensor([True, True, True, False]).expand(20_000, 4),
        },
        batch_size=[20_000],
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert (actor(td.clone())["action"] == 1).all()
    torch.manual_seed(0)
    drawn = torch.bincount(actor(td)["action"], minlength=4) / 20_000
    assert torch.allclose(drawn, torch.cat([logits[:3].softmax(0), torch.zeros(1)]), atol=0.02)


class Polar(nn.Module):
    """A network with an observation of its own: distances and angles from the depot, out of the nested state."""

    in_keys = (("game", "nodes"), "visited")

    def forward(self, nodes, visited):
        x, y = (nodes - nodes[..., :1, :]).unbind(-1)
        return torch.hypot(x, y) + torch.atan2(y, x)


def of_the_cities_alone(cities):
    return cities.norm(dim=-1)


of_the_cities_alone.in_keys = ("cities",)


@pytest.mark.parametrize("own", [Polar(), of_the_cities_alone], ids=["module", "function"])
def test_a_network_says_what_it_reads(own):
    env = BatchedMTSP(7, 2, [3], seed=0)
    td = env.reset()
    actor = make_actor(own)
    assert actor.in_keys == [*own.in_keys, "action_mask"]
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        action = actor(td)["action"]
    logits = own(*(td[key] for key in own.in_keys)).masked_fill(~td["action_mask"], -torch.inf)
    assert torch.equal(action, logits.argmax(-1))


def test_keys_that_are_given_come_first():
    assert network_keys(of_the_cities_alone) == ("cities",)
    assert network_keys(lambda *_: None) == network_keys(DAN(SMALL)) == ("cities", "agents", "visited")
    assert make_actor(of_the_cities_alone, ["agents"]).in_keys == ["agents", "action_mask"]


def test_an_actor_stays_the_actor_that_it_is(network):
    actor = make_actor(network)
    assert as_actor(actor) is actor
    assert as_actor(network).in_keys == actor.in_keys


def test_torchrls_collector_gathers_whole_episodes(network):
    """Each batch starts from resets and is as long as the cap of the rule "final", n - 1 + m decisions."""
    cap = 8 - 1 + 3
    collector = Collector(
        BatchedMTSP(8, 3, [4], depot="final", seed=0),
        make_actor(network),
        frames_per_batch=4 * cap,
        total_frames=2 * 4 * cap,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        assert batch.shape == (4, cap)
        assert (batch["game", "decisions"][:, 0] == 0).all() and batch["next", "done"].any(1).all()
        assert batch["action_mask"].gather(2, batch["action"][..., None]).all()


def test_the_log_probability_of_the_action_is_written_if_asked_for(network):
    td = BatchedMTSP(12, 3, [8], seed=0).reset()
    torch.manual_seed(0)
    played = make_actor(network, return_log_prob=True)(td.clone())
    expected = make_actor(network).get_dist(td).log_prob(played["action"])
    assert torch.equal(played["action_log_prob"], expected)
    assert "action_log_prob" not in make_actor(network)(td.clone())


@pytest.mark.parametrize("decode", ["greedy", "sample"])
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_logits_that_are_not_finite_are_named_and_masked_ones_do_not_matter(decode, value):
    def first_city_is_odd(cities, agents, visited):
        logits = -cities.norm(dim=-1)
        logits[..., 1] = value
        return logits

    env = BatchedMTSP(n_nodes=6, n_agents=2, batch_size=3, seed=0)
    with pytest.raises(ValueError, match=r"logits must be finite, got (nan|inf): parameters of the network may be NaN"):
        rollout(first_city_is_odd, env, decode)
    logits, mask = torch.tensor([[value, 0.0, -torch.inf]]), torch.tensor([[False, True, True]])
    assert FiniteCategorical(logits, mask=mask).probs.tolist() == [[0.0, 1.0, 0.0]]
