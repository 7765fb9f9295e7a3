"""JointDAN: symmetries, view, pruning, precision, dense outputs, gradients."""

from dataclasses import replace

import pytest
import torch

from dan_policy import layers
from dan_policy.joint import JointConfig, JointDAN, polar_coordinates, token_distances

SMALL = JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=2)
CONFIGS = {
    "small": SMALL,
    "default": JointConfig(),
    "short-sighted": replace(SMALL, view=3),
    "distances": replace(SMALL, distances=True),
    "polar": replace(SMALL, distances=True, polar=True),
}


@pytest.fixture(params=CONFIGS)
def network(request):
    torch.manual_seed(0)
    return JointDAN(CONFIGS[request.param]).eval()


@pytest.fixture(params=["small", "distances", "polar"])
def small(request):
    torch.manual_seed(0)
    return JointDAN(CONFIGS[request.param]).eval()


def observation(batch=5, n=9, m=4, seed=0, dtype=torch.float32):
    """Cities, agents, visited and agent. Two agents stand at one place, so only the index identifies the decider."""
    generator = torch.Generator().manual_seed(seed)
    cities = torch.rand(batch, n, 2, generator=generator, dtype=torch.float64) * 2 - 1
    agents = torch.rand(batch, m, 3, generator=generator, dtype=torch.float64)
    agents[:, :2] = 0.0
    visited = torch.rand(batch, n, generator=generator) < 0.4
    visited[:, 0] = False
    agent = torch.randint(2, (batch,), generator=generator)
    return cities.to(dtype), agents.to(dtype), visited, agent


def test_permuting_cities_permutes_logits(network):
    cities, agents, visited, agent = observation()
    order = torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(8) + 1])  # the depot has its own embedding
    logits = network(cities, agents, visited, agent)
    permuted = network(cities[:, order], agents, visited[:, order], agent)
    assert torch.allclose(permuted, logits[:, order], atol=1e-5)
    assert not torch.allclose(permuted, logits, atol=1e-3)


def test_permuting_agents_changes_nothing_for_the_decider_and_permutes_dense_rows(network):
    cities, agents, visited, agent = observation()
    order = torch.tensor([2, 0, 3, 1])
    moved = (order[None] == agent[:, None]).int().argmax(1)  # the decider's new index
    logits = network(cities, agents, visited, agent)
    assert torch.allclose(network(cities, agents[:, order], visited, moved), logits, atol=1e-5)
    dense = network.forward_dense(cities, agents, visited, agent)
    permuted = network.forward_dense(cities, agents[:, order], visited, moved)
    for before, after in zip(dense[1:], permuted[1:], strict=True):
        assert torch.allclose(after, before[:, order], atol=1e-5)


def test_the_index_tells_the_decider_from_an_agent_at_the_same_place(network):
    cities, agents, visited, agent = observation()
    agents[:, 1, 2] = 0.5  # agents 0 and 1 head for the same place, and agent 1 has yet to arrive
    first, second = (network(cities, agents, visited, torch.full_like(agent, index)) for index in (0, 1))
    assert not torch.allclose(first, second, atol=1e-4)


def test_agents_matter(network):
    cities, agents, visited, agent = observation()
    assert not torch.allclose(
        network(cities, agents, visited, agent), network(cities, agents + 0.5, visited, agent), atol=1e-4
    )


def test_the_deciders_row_of_the_dense_logits_is_the_policy(network):
    cities, agents, visited, agent = observation()
    dense = network.forward_dense(cities, agents, visited, agent)
    assert dense.next.shape == dense.assignment.shape == (5, 4, 9)
    assert torch.equal(dense.policy, dense.next[torch.arange(5), agent])
    assert torch.allclose(network(cities, agents, visited, agent), dense.policy, atol=1e-5)


def test_what_all_agents_do_next_is_what_the_dense_logits_say(network):
    seen = observation(batch=6)
    assert torch.allclose(network.forward_next(*seen), network.forward_dense(*seen).next, atol=1e-5)
    shaped = [part.unflatten(0, (2, 3)) for part in seen]
    assert torch.equal(network.forward_next(*shaped), network.forward_next(*seen).unflatten(0, (2, 3)))


def test_a_batch_equals_its_rows_alone(network):
    together = network(*observation())
    for row in range(5):
        alone = network(*(part[row : row + 1] for part in observation()))
        assert torch.allclose(alone, together[row : row + 1], atol=1e-5)


def test_leading_dimensions_are_free(network):
    flat = observation(batch=6)
    shaped = [part.unflatten(0, (2, 3)) for part in flat]
    assert torch.equal(network(*shaped), network(*flat).unflatten(0, (2, 3)))
    assert torch.allclose(network(*(part[0] for part in flat)), network(*flat)[0], atol=1e-5)
    dense = network.forward_dense(*shaped)
    assert dense.policy.shape == (2, 3, 9) and dense.next.shape == dense.assignment.shape == (2, 3, 4, 9)


def test_pruning_equals_removing_the_visited_cities(small):
    cities, agents, visited, agent = observation()
    logits = small(cities, agents, visited, agent)
    assert (logits[visited] == -SMALL.tanh_clip).all()
    moved = torch.where(visited[:, :, None], cities + 0.3, cities)
    assert torch.equal(small(moved, agents, visited, agent), logits)
    for row in range(len(cities)):
        one, is_open = slice(row, row + 1), ~visited[row]
        alone = small(cities[one, is_open], agents[one], visited[one, is_open], agent[one])
        assert torch.allclose(logits[one, is_open], alone, atol=1e-5)


def test_a_view_holds_the_nearest_unvisited_cities(small):
    """It does not matter where the others are; those get the least logit, so that they stay legal."""
    cities, agents, visited, agent = observation(n=30)
    small.config = replace(small.config, view=6)
    logits = small(cities, agents, visited, agent)
    dense = small.forward_dense(cities, agents, visited, agent)
    for row in range(len(cities)):
        distance = cities[row].square().sum(1).where(~visited[row], torch.inf)
        distance[0] = -1.0
        seen = distance.argsort()[:7].sort().values  # the depot and six cities
        one = slice(row, row + 1)
        hidden = [node for node in range(30) if node not in seen]
        elsewhere = cities[one].clone()
        elsewhere[:, hidden] += 10.0
        assert torch.allclose(small(elsewhere, agents[one], visited[one], agent[one]), logits[one], atol=1e-5)
        if not small.config.distances:  # with distances, the number of unvisited cities is their scale
            alone = small(cities[one, seen], agents[one], visited[one, seen], agent[one])
            assert torch.allclose(logits[one, seen], alone, atol=1e-5)
        assert (logits[row, hidden] == -SMALL.tanh_clip).all()
        assert (dense.next[row, :, hidden] == -SMALL.tanh_clip).all()
        assert (dense.assignment[row, :, hidden] == 0.0).all()


def test_cities_out_of_view_have_no_effect(small):
    """Those out of view may as well be visited; with distances, they do not count in their scale either."""
    cities, agents, visited, agent = observation()
    small.config = replace(small.config, view=2)
    logits = small(cities, agents, visited, agent)
    hidden = visited | (logits <= -small.config.tanh_clip)
    hidden[:, 0] = False
    assert (hidden.sum(1) > visited.sum(1)).any()
    assert torch.allclose(small(cities, agents, hidden, agent), logits, atol=1e-5)


def test_a_view_of_all_cities_hides_none(small):
    seen = small(*observation())
    small.config = replace(small.config, view=8)
    assert torch.equal(small(*observation()), seen)


def test_padding_for_bfloat16_changes_nothing(small, monkeypatch):
    cities, agents, visited, agent = observation(n=30)
    visited[:, 11:] = True
    exact = small(cities, agents, visited, agent)
    with torch.autocast("cpu", torch.bfloat16):
        padded = small(cities, agents, visited, agent)
        monkeypatch.setattr(layers, "padded_length", lambda length: length)
        unpadded = small(cities, agents, visited, agent)
    assert padded.dtype == torch.float32
    assert torch.allclose(padded, unpadded, atol=0.05)
    assert torch.allclose(padded, exact, atol=0.3)


def test_float32_agrees_with_float64(network):
    single = network(*observation())
    double = network.double()(*observation(dtype=torch.float64))
    assert torch.allclose(single.double(), double, atol=1e-4)


def test_distances_of_a_case_solved_by_hand():
    """Two agents, two nodes. The second agent has half a unit still to go to where the second node is."""
    agents = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.4, 0.5]]])
    nodes = torch.tensor([[[0.0, 1.0], [0.3, 0.4]]])
    distances = token_distances(agents, nodes, torch.tensor([4]))
    far = (0.3**2 + 0.6**2) ** 0.5
    expected = 2 * torch.tensor([[0, 1, 1, 0.5], [1, 0, far + 0.5, 0.5], [1, far + 0.5, 0, far], [0.5, 0.5, far, 0]])
    assert torch.allclose(distances[0], expected)


def test_polar_coordinates_of_a_case_solved_by_hand():
    """The decider is two units east of the depot."""
    positions = torch.tensor([[[-2.0, 0.0], [0.0, 0.0], [-2.0, -3.0], [1.0, 4.0]]])
    expected = torch.tensor([[2, 0, 0, 0], [0, 2, 1, 0], [13**0.5, 3, 0, -1], [17**0.5, 5, 0.6, 0.8]])
    assert torch.allclose(polar_coordinates(positions, positions[:, :1])[0], expected)


def test_without_slopes_distances_have_no_effect():
    torch.manual_seed(0)
    plain, network = JointDAN(SMALL), JointDAN(replace(SMALL, distances=True))
    network.load_state_dict(network.state_dict() | plain.state_dict())
    assert not torch.allclose(network(*observation()), plain(*observation()), atol=1e-3)
    slopes = [parameter for name, parameter in network.named_parameters() if "slope" in name]
    assert len(slopes) == 3
    for parameter in slopes:
        torch.nn.init.zeros_(parameter)
    for ours, theirs in zip(network.forward_dense(*observation()), plain.forward_dense(*observation()), strict=True):
        assert torch.allclose(ours, theirs, atol=1e-5)


def test_logits_stay_within_the_clip(network):
    cities, agents, visited, agent = observation()
    assert network(cities * 100, agents * 100, visited, agent).abs().max() <= network.config.tanh_clip


def test_dense_gradients_reach_every_parameter_and_the_policys_all_but_the_assignments(network):
    dense = network.forward_dense(*observation())
    (dense.next.square().sum() + dense.assignment.square().sum()).backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name
    network.zero_grad()
    network(*observation()).square().sum().backward()
    unused = {name for name, parameter in network.named_parameters() if parameter.grad is None}
    slope = {"assignment_slope"} if network.config.distances else set()
    assert unused == {"assignment_query.weight", "assignment_key.weight"} | slope


def test_the_default_has_about_a_million_parameters():
    assert sum(p.numel() for p in JointDAN().parameters()) == pytest.approx(1.06e6, rel=0.03)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_heads": 3}, "n_heads must divide embed_dim=128, got 3"),
        ({"n_layers": 0}, "n_layers must be a whole number from 1 to 1000, got 0"),
        ({"tanh_clip": 0.0}, r"tanh_clip must be a number above 0 and at most 1e\+06, got 0.0"),
        ({"view": 0}, "view must be None or at least 1 city, got 0"),
        ({"distances": 1}, "distances must be True or False, got 1"),
        ({"confidence": 0.0}, "confidence must be None, or above 0 and at most 1, got 0.0"),
        ({"confidence": True}, "confidence must be None, or above 0 and at most 1, got True"),
        ({"polar": "yes"}, "polar must be True or False, got 'yes'"),
        ({"reads": ("moon",)}, r"reads must be different keys of \['agent_speeds', .*\], got \('moon',\)"),
        ({"reads": ("service", "service")}, r"reads must be different keys"),
    ],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        JointConfig(**kwargs)
