"""Kool et al.'s attention model: used like DAN, it ignores other agents and the order of the cities."""

import pytest
import torch

from benchmarks.policies.attention_model import AttentionModel
from dan_policy import make_actor, solve
from mtsp_env import check_tours
from mtsp_env.instance import Instance


@pytest.fixture
def network():
    torch.manual_seed(0)
    return AttentionModel(embed_dim=16, feedforward_dim=32, n_heads=2, layers=2).eval()


@pytest.fixture
def observation():
    nodes, at = torch.rand(5, 9, 2), torch.tensor([0, 3, 8, 5, 1])
    visited = torch.zeros(5, 9, dtype=torch.bool)
    visited[torch.arange(1, 5), at[1:]] = True
    return nodes - nodes[torch.arange(5), at][:, None], torch.rand(5, 3, 3), visited


def test_leading_dimensions_are_free(network, observation):
    flat = network(*observation)
    deep = network(*(part[None].expand(2, *part.shape) for part in observation))
    assert flat.shape == (5, 9) and deep.shape == (2, 5, 9)
    torch.testing.assert_close(deep[1], flat)


def test_it_ignores_other_agents_and_the_order_of_cities(network, observation):
    cities, agents, visited = observation
    logits = network(cities, agents, visited)
    torch.testing.assert_close(network(cities, agents + 1, visited), logits)
    order = torch.cat([torch.zeros(1, dtype=torch.long), torch.randperm(8) + 1])
    torch.testing.assert_close(network(cities[:, order], agents, visited[:, order]), logits[:, order])


def test_the_context_is_the_agents_own_node(network, observation):
    """The same map seen from another node gives other logits; the encoder sees the same map."""
    cities, agents, visited = observation
    elsewhere = cities - cities[:, 4:5]
    assert not torch.allclose(network(elsewhere, agents, visited), network(cities, agents, visited), atol=1e-4)


def test_it_plans_tours_like_any_policy(network):
    instance = Instance(torch.rand(12, 2, dtype=torch.float64).numpy(), 3)
    check_tours(instance, solve(instance, make_actor(network)).tours)
