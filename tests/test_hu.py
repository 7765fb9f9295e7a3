"""The allocation network of Hu et al. and its solver: symmetries, gradients, allocations, tours."""

import numpy as np
import pytest
import torch

from benchmarks.policies.hu import HuAllocator
from benchmarks.policies.nearest import nearest
from benchmarks.solvers import Unavailable, find, hu
from dan_policy import make_actor, solve
from dan_policy.registry import save
from mtsp_env import Instance, check_tours, makespan


@pytest.fixture
def network():
    torch.manual_seed(0)
    return HuAllocator(3, embed_dim=16, n_layers=2).eval()


def observation(batch=5, n=9, m=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    cities = torch.rand(batch, n, 2, generator=generator) * 2 - 1
    agents = torch.rand(batch, m, 3, generator=generator)
    visited = torch.rand(batch, n, generator=generator) < 0.4
    visited[:, 0] = False
    return cities, agents, visited, torch.randint(m, (batch,), generator=generator)


def test_permuting_cities_permutes_scores_and_logits(network):
    cities, agents, visited, agent = observation()
    order = torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(8) + 1])
    dense = network.forward_dense(cities, agents, visited, agent)
    permuted = network.forward_dense(cities[:, order], agents, visited[:, order], agent)
    torch.testing.assert_close(permuted.assignment, dense.assignment[:, :, order], atol=1e-5, rtol=0)
    torch.testing.assert_close(permuted.policy, dense.policy[:, order], atol=1e-5, rtol=0)
    assert permuted.next is None


def test_an_allocation_is_the_same_at_every_decision_of_a_game(network):
    """It depends neither on the position of the deciding agent nor on what is visited."""
    cities, agents, visited, agent = observation()
    scores = network.forward_dense(cities, agents, visited, agent).assignment
    later = network.forward_dense(cities + 0.3, agents + 1, ~visited, agent).assignment
    torch.testing.assert_close(later, scores, atol=1e-5, rtol=0)


def test_a_batch_equals_its_rows_alone_and_leading_dimensions_are_free(network):
    together = network.forward_dense(*observation(batch=6))
    for row in range(6):
        alone = network.forward_dense(*(part[row : row + 1] for part in observation(batch=6)))
        torch.testing.assert_close(alone.assignment[0], together.assignment[row], atol=1e-5, rtol=0)
    shaped = network.forward_dense(*(part.unflatten(0, (2, 3)) for part in observation(batch=6)))
    torch.testing.assert_close(shaped.assignment, together.assignment.unflatten(0, (2, 3)))
    torch.testing.assert_close(shaped.policy, together.policy.unflatten(0, (2, 3)))


def test_as_a_policy_an_agent_prefers_its_own_cities_nearest_first_then_the_depot(network):
    cities, agents, visited, agent = observation()
    dense = network.forward_dense(cities, agents, visited, agent)
    owner = dense.assignment.argmax(1)
    for row in range(len(cities)):
        ranked = dense.policy[row].argsort(descending=True).tolist()
        depot = ranked.index(0)
        own, others = ranked[:depot], ranked[depot + 1 :]
        assert all(owner[row, city] == agent[row] for city in own)
        assert all(owner[row, city] != agent[row] for city in others)
        distances = cities[row, own].norm(dim=1)
        assert torch.equal(distances, distances.sort().values)


def test_gradients_of_the_scores_reach_every_parameter(network):
    network.forward_dense(*observation()).assignment[:, :, 1:].square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_agents_have_networks_of_their_own(network):
    scores = network.allocate(observation()[0])
    assert not torch.allclose(scores[:, 0], scores[:, 1], atol=1e-3)


def test_bad_numbers_are_named(network):
    with pytest.raises(ValueError, match="the network is for 3 agents, got 4"):
        network(*observation(m=4))
    with pytest.raises(ValueError, match="n_agents must be at least 1, got 0"):
        HuAllocator(0)
    with pytest.raises(ValueError, match="n_heads must divide embed_dim=12, got 8"):
        HuAllocator(2, embed_dim=12)


# The solver


@pytest.fixture
def instance():
    return Instance(np.random.default_rng(0).random((14, 2)), 3)


@pytest.fixture
def shipped(network, tmp_path, monkeypatch):
    """The small network as the shipped one for 3 agents."""
    save(
        tmp_path / "hu-3.safetensors",
        network,
        "benchmarks.policies.hu:HuAllocator",
        {"n_agents": 3, "embed_dim": 16, "n_layers": 2},
    )
    monkeypatch.setattr(hu, "WEIGHTS", tmp_path)
    return network


def test_every_agent_visits_the_cities_that_are_allocated_to_it(instance, shipped):
    pytest.importorskip("ortools")
    tours = hu.solve(instance, 10.0, 0)
    check_tours(instance, tours)
    owner = shipped.allocate(torch.as_tensor(instance.nodes.copy(), dtype=torch.float32)).argmax(0)
    for agent, tour in enumerate(tours):
        assert sorted(tour[1:-1]) == [city for city in range(1, 14) if owner[city] == agent]


def test_a_tour_of_few_cities_is_the_shortest():
    """OR-Tools finds the optimum of a problem of six nodes, which is found here by trying every order."""
    pytest.importorskip("ortools")
    from itertools import permutations

    nodes = np.random.default_rng(1).random((6, 2))
    distance = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
    tour = hu.shortest_tour(distance, [1, 3, 4, 5], seconds=5.0)
    assert tour[0] == tour[-1] == 0 and sorted(tour[1:-1]) == [1, 3, 4, 5]

    def length(order):
        return sum(distance[a, b] for a, b in zip([0, *order], [*order, 0], strict=True))

    assert length(tour[1:-1]) == pytest.approx(min(map(length, permutations([1, 3, 4, 5]))))
    assert hu.shortest_tour(distance, [], seconds=5.0) == [0, 0]
    assert hu.shortest_tour(distance, [2], seconds=5.0) == [0, 2, 0]


def test_the_best_of_the_likeliest_and_the_drawn_allocations_counts(instance, shipped):
    pytest.importorskip("ortools")
    tours = hu.solve(instance, 10.0, 0, samples=8)
    check_tours(instance, tours)
    assert hu.solve(instance, 10.0, 0, samples=8) == tours
    owners = hu.allocations(instance, 0, 8)
    assert owners.shape == (8, 13) and len(np.unique(owners, axis=0)) > 1
    assert np.array_equal(owners[:1], hu.allocations(instance, 0, 1))
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)
    every = [
        [hu.shortest_tour(distance, tuple(1 + np.flatnonzero(owner == agent)), 10.0) for agent in range(3)]
        for owner in owners
    ]
    costs = [makespan(instance, one) for one in every]
    assert makespan(instance, tours) == min(costs) < costs[-1]


def test_drawn_allocations_follow_the_probabilities(instance, shipped):
    owners = hu.allocations(instance, 1, 2001)[1:]
    share = np.stack([(owners == agent).mean(0) for agent in range(3)])  # (m, n - 1)
    nodes = torch.as_tensor(instance.nodes.copy(), dtype=torch.float32)
    expected = shipped.allocate(nodes)[:, 1:].softmax(0).detach().numpy()
    np.testing.assert_allclose(share, expected, atol=0.05)  # over four standard errors


def test_a_team_without_weights_is_unavailable(instance, shipped):
    pytest.importorskip("ortools")
    with pytest.raises(Unavailable, match="no weights for 2 agents; there are some for \\[3\\]"):
        hu.solve(Instance(instance.nodes, 2), 1.0, 0)
    with pytest.raises(ValueError, match="samples must be a whole number of at least 1, got 0"):
        hu.solve(instance, 1.0, 0, samples=0)


def test_it_plans_tours_like_any_policy(instance, network):
    check_tours(instance, solve(instance, make_actor(network)).tours)


@pytest.mark.parametrize("name", ["hu-greedy", "hu-s64"])
@pytest.mark.slow
def test_the_shipped_weights_solve_the_teams_they_were_trained_for(name):
    pytest.importorskip("ortools")
    for m in (5, 10):
        team = Instance(np.random.default_rng(m).random((51, 2)), m)
        tours = find(name)(team, 30.0, 0)
        check_tours(team, tours)
        assert makespan(team, tours) < makespan(team, solve(team, nearest, device="cpu").tours)
