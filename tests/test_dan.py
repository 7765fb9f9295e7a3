"""DAN: symmetries, masking, precision, gradients."""

from dataclasses import replace

import pytest
import torch

from dan_policy import layers
from dan_policy.dan import DAN, DANConfig
from dan_policy.layers import AttentionLayer

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=2)
CONFIGS = {
    "small": SMALL,
    "paper": DANConfig.paper(),
    "official": DANConfig.official(),
    "pruned": replace(SMALL, prune_visited=True),
    "short-sighted": replace(SMALL, prune_visited=True, view=3),
}


@pytest.fixture(params=CONFIGS)
def network(request):
    torch.manual_seed(0)
    return DAN(CONFIGS[request.param]).eval()


def observation(batch=5, n=9, m=4, seed=0, dtype=torch.float32):
    generator = torch.Generator().manual_seed(seed)
    cities = torch.rand(batch, n, 2, generator=generator, dtype=torch.float64) * 2 - 1
    agents = torch.rand(batch, m, 3, generator=generator, dtype=torch.float64)
    visited = torch.rand(batch, n, generator=generator) < 0.4
    visited[:, 0] = False
    return cities.to(dtype), agents.to(dtype), visited


def open_logits(network, cities, agents, visited):
    """Logits at the nodes that may be picked, 0 elsewhere."""
    return network(cities, agents, visited).masked_fill(visited, 0.0)


@pytest.mark.slow
def test_permuting_cities_permutes_logits(network):
    cities, agents, visited = observation()
    order = torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(8) + 1])  # the depot has its own embedding
    logits = open_logits(network, cities, agents, visited)
    permuted = open_logits(network, cities[:, order], agents, visited[:, order])
    assert torch.allclose(permuted, logits[:, order], atol=1e-5)
    assert not torch.allclose(permuted, logits, atol=1e-3)


def test_permuting_agents_changes_nothing(network):
    cities, agents, visited = observation()
    permuted = open_logits(network, cities, agents[:, torch.randperm(4)], visited)
    assert torch.allclose(permuted, open_logits(network, cities, agents, visited), atol=1e-5)


def test_agents_matter(network):
    cities, agents, visited = observation()
    assert not torch.allclose(network(cities, agents, visited), network(cities, agents + 0.5, visited), atol=1e-4)


def test_a_batch_equals_its_rows_alone(network):
    cities, agents, visited = observation()
    together = open_logits(network, cities, agents, visited)
    for row in range(5):
        one = slice(row, row + 1)
        alone = open_logits(network, cities[one], agents[one], visited[one])
        assert torch.allclose(alone, together[one], atol=1e-5)


def test_leading_dimensions_are_free(network):
    cities, agents, visited = observation(batch=6)
    flat = network(cities, agents, visited)
    assert torch.allclose(network(cities[0], agents[0], visited[0]), flat[0], atol=1e-5) or network.config.prune_visited
    shaped = network(cities.view(2, 3, 9, 2), agents.view(2, 3, 4, 3), visited.view(2, 3, 9))
    assert torch.equal(shaped, flat.view(2, 3, 9))


def test_float32_agrees_with_float64(network):
    single = network(*observation())
    double = network.double()(*observation(dtype=torch.float64))
    assert torch.allclose(single.double(), double, atol=1e-4)


def test_logits_stay_within_the_clip(network):
    cities, agents, visited = observation()
    assert network(cities * 100, agents * 100, visited).abs().max() <= network.config.tanh_clip


def test_gradients_reach_every_parameter(network):
    cities, agents, visited = observation()
    (network(cities, agents, visited).masked_fill(visited, 0.0) ** 2).sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_the_glimpse_ignores_visited_cities_and_pruning_forgets_them():
    cities, agents, visited = observation()
    moved = torch.where(visited[:, :, None], cities + 0.3, cities)
    torch.manual_seed(0)
    pruned = DAN(CONFIGS["pruned"])
    assert torch.allclose(
        open_logits(pruned, moved, agents, visited), open_logits(pruned, cities, agents, visited), atol=1e-5
    )
    whole = DAN(SMALL)
    whole.load_state_dict(pruned.state_dict())
    assert not torch.allclose(
        open_logits(whole, moved, agents, visited), open_logits(whole, cities, agents, visited), atol=1e-4
    )
    nothing = torch.zeros_like(visited)
    assert torch.allclose(pruned(cities, agents, nothing), whole(cities, agents, nothing), atol=1e-5)


def test_bfloat16_pads_to_a_few_lengths():
    """A kernel is built for each shape, so lengths are rounded up to a few, which are at most 12.5 % longer."""
    rounded = {length: layers.padded_length(length) for length in range(1, 1025)}
    assert all(length <= longer for length, longer in rounded.items())
    assert all(longer - length < max(8, length / 8) for length, longer in rounded.items())
    assert len(set(rounded.values())) == 40


def test_the_padding_of_bfloat16_is_not_seen(monkeypatch):
    """Under autocast, rows are longer than their open nodes; the logits are those of unpadded rows."""
    network, (cities, agents, visited) = DAN(CONFIGS["pruned"]).eval(), observation(n=30)
    visited[:, 11:] = True
    lengths, logits = [], DAN._logits

    def spy(self, kept, *args, **kwargs):
        lengths.append(kept.shape[1])
        return logits(self, kept, *args, **kwargs)

    monkeypatch.setattr(DAN, "_logits", spy)
    exact = open_logits(network, cities, agents, visited)
    with torch.autocast("cpu", torch.bfloat16):
        padded = open_logits(network, cities, agents, visited)
        monkeypatch.setattr(layers, "padded_length", lambda length: length)
        unpadded = open_logits(network, cities, agents, visited)
    assert lengths == [10, 16, 10]
    assert torch.allclose(padded, unpadded, atol=0.02)
    assert torch.allclose(padded, exact, atol=0.2)
    assert not torch.allclose(padded, exact.roll(1, 0), atol=0.2)


def test_attention_layer_is_the_formula():
    """Single head, post-norm, against the paper's equations written out."""
    torch.manual_seed(0)
    layer = AttentionLayer(8, 16, 1, "post").double()
    query, source = torch.randn(2, 3, 8, dtype=torch.float64), torch.randn(2, 5, 8, dtype=torch.float64)
    mask = torch.tensor([[True, True, False, True, True], [True] * 5])
    w_k, w_v = layer.key_value.weight.chunk(2)
    q, k, v = query @ layer.query.weight.T, source @ w_k.T, source @ w_v.T
    u = (q @ k.transpose(1, 2) / 8**0.5).masked_fill(~mask[:, None], float("-inf"))
    h = layer.norm_attention(query + u.softmax(-1) @ v @ layer.out.weight.T)
    expected = layer.norm_feedforward(h + layer.feedforward(h))
    assert torch.allclose(layer(query, source, mask), expected, atol=1e-12)


def test_official_has_the_published_size():
    assert sum(p.numel() for p in DAN(DANConfig.official()).parameters()) == pytest.approx(1.4e6, rel=0.03)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_heads": 3}, "n_heads must divide embed_dim=128, got 3"),
        ({"city_layers": 0}, "city_layers must be a whole number from 1 to 1000, got 0"),
        ({"encoder_norm": "batch"}, "unknown norm 'batch'"),
        ({"tanh_clip": 0.0}, "tanh_clip must be a number above 0 and at most 1e\\+06, got 0.0"),
        (
            {"view": 0, "prune_visited": True},
            "view must be None, or with prune_visited at least 1 city, got 0",
        ),
        ({"view": 5}, "view must be None, or with prune_visited at least 1 city, got 5"),
    ],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        DANConfig(**kwargs)


def test_a_view_shows_the_nearest_unvisited_cities():
    """As if there were no others; those get the smallest logit, and stay legal."""
    cities, agents, visited = observation(n=30)
    torch.manual_seed(0)
    network = DAN(replace(SMALL, prune_visited=True, view=6))
    logits = network(cities, agents, visited)
    for row in range(len(cities)):
        distance = cities[row].square().sum(1).where(~visited[row], torch.inf)
        distance[0] = -1.0
        seen = distance.argsort()[:7].sort().values  # the depot and six cities
        one = slice(row, row + 1)
        alone = network(cities[one, seen], agents[one], visited[one, seen])
        assert torch.allclose(logits[one, seen], alone, atol=1e-5)
        hidden = [node for node in range(30) if node not in seen]
        assert (logits[row, hidden] == -network.config.tanh_clip).all()


def test_a_view_of_all_cities_hides_none():
    cities, agents, visited = observation()
    torch.manual_seed(0)
    everything = DAN(CONFIGS["pruned"])
    wide = DAN(replace(SMALL, prune_visited=True, view=8))
    wide.load_state_dict(everything.state_dict())
    assert torch.equal(wide(cities, agents, visited), everything(cities, agents, visited))


def test_the_assignment_is_off_by_default_and_leaves_the_policy_alone():
    torch.manual_seed(0)
    plain = DAN(SMALL)
    dense = DAN(replace(SMALL, assignment=True))
    added = dense.state_dict().keys() - plain.state_dict().keys()
    assert added == {"assignment_query.weight", "assignment_key.weight"}
    assert plain.dense_outputs == () and dense.dense_outputs == ("assignment",)
    dense.load_state_dict(plain.state_dict(), strict=False)
    cities, agents, visited = observation()
    logits = plain(cities, agents, visited)
    assert torch.equal(dense(cities, agents, visited), logits)
    assert torch.equal(dense.forward_dense(cities, agents, visited).policy, logits)
    none = plain.forward_dense(cities, agents, visited)
    assert torch.equal(none.policy, logits) and none.next is none.assignment is None


@pytest.mark.parametrize("prune", [False, True])
def test_permuting_agents_and_cities_permutes_the_assignment(prune):
    torch.manual_seed(0)
    network = DAN(replace(SMALL, assignment=True, prune_visited=prune)).double()
    cities, agents, visited = observation(dtype=torch.float64)
    assignment = network.forward_dense(cities, agents, visited).assignment  # (B, m, n)
    assert assignment.shape == (5, 4, 9) and (assignment[visited[:, None].expand_as(assignment)] == 0).all()
    others, order = torch.tensor([2, 0, 3, 1]), torch.tensor([0, 4, 2, 8, 1, 3, 7, 5, 6])
    permuted = network.forward_dense(cities[:, order], agents[:, others], visited[:, order]).assignment
    assert torch.allclose(permuted, assignment[:, others][:, :, order], atol=1e-10)
    assert not torch.allclose(assignment[:, 0], assignment[:, 1])
    leading = [one.unflatten(0, (5, 1)) for one in (cities, agents, visited)]
    assert torch.equal(network.forward_dense(*leading).assignment[:, 0], assignment)


def test_the_assignments_gradients_reach_its_parameters_and_the_encoders():
    torch.manual_seed(0)
    network = DAN(replace(SMALL, assignment=True, prune_visited=True))
    network.forward_dense(*observation()).assignment.square().sum().backward()
    reached = {name for name, parameter in network.named_parameters() if parameter.grad is not None}
    assert {"assignment_query.weight", "assignment_key.weight", "embed_city.weight", "embed_agent.weight"} <= reached
    assert "pointer_key.weight" not in reached
