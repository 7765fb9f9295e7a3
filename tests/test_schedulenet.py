"""ScheduleNet: symmetries, masks, types, gradients, and games like those of any policy."""

from dataclasses import replace

import pytest
import torch

from benchmarks.policies.schedulenet import (
    ASSIGNED_AGENT,
    ASSIGNED_TASK,
    DEPOT,
    N_TYPES,
    UNASSIGNED_AGENT,
    UNASSIGNED_TASK,
    ScheduleNet,
    TypeAwareAttention,
    TypeInteraction,
    agent_task_graph,
)
from dan_policy import make_actor, solve
from dan_policy.heuristics import default_view
from mtsp_env import Instance, check_tours


@pytest.fixture
def network():
    torch.manual_seed(0)
    return ScheduleNet(width=16).eval()


def observation(batch=5, n=9, m=4, seed=0, dtype=torch.float32):
    """Cities, agents, visited and agent. Agent 0 decides, agent 1 waits at the depot, the others are under way."""
    generator = torch.Generator().manual_seed(seed)
    cities = torch.rand(batch, n, 2, generator=generator, dtype=torch.float64) * 2 - 1
    agents = torch.rand(batch, m, 3, generator=generator, dtype=torch.float64)
    agents[:, 0] = 0.0
    agents[:, 1, :2], agents[:, 1, 2] = cities[:, 0], 0.0
    agents[:, 2, :2] = cities[:, 0]  # on its way home
    visited = torch.rand(batch, n, generator=generator) < 0.4
    visited[:, 0] = False
    return cities.to(dtype), agents.to(dtype), visited, torch.zeros(batch, dtype=torch.int64)


def test_permuting_cities_permutes_logits(network):
    cities, agents, visited, agent = observation()
    order = torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(8) + 1])
    logits = network(cities, agents, visited, agent)
    permuted = network(cities[:, order], agents, visited[:, order], agent)
    torch.testing.assert_close(permuted, logits[:, order], atol=1e-5, rtol=0)
    assert not torch.allclose(permuted, logits, atol=1e-3)


def test_permuting_agents_changes_nothing(network):
    cities, agents, visited, agent = observation()
    order = torch.tensor([3, 1, 0, 2])
    permuted = network(cities, agents[:, order], visited, torch.full_like(agent, 2))
    torch.testing.assert_close(permuted, network(cities, agents, visited, agent), atol=1e-5, rtol=0)


@pytest.mark.parametrize("other", [1, 2, 3])
def test_every_other_agent_matters(network, other):
    cities, agents, visited, agent = observation()
    moved = agents.clone()
    moved[:, other] += 0.3
    assert not torch.allclose(
        network(cities, moved, visited, agent), network(cities, agents, visited, agent), atol=1e-4
    )


def test_a_batch_equals_its_rows_alone(network):
    """Rows with fewer unvisited cities are padded in a batch."""
    together = network(*observation())
    for row in range(5):
        alone = network(*(part[row : row + 1] for part in observation()))
        open_nodes = ~observation()[2][row]
        torch.testing.assert_close(alone[0, open_nodes], together[row, open_nodes], atol=1e-5, rtol=0)


def test_leading_dimensions_are_free(network):
    flat = observation(batch=6)
    shaped = [part.unflatten(0, (2, 3)) for part in flat]
    assert torch.equal(network(*shaped), network(*flat).unflatten(0, (2, 3)))


def test_visited_cities_are_not_in_the_graph(network):
    cities, agents, visited, agent = observation()
    logits = network(cities, agents, visited, agent)
    moved = torch.where(visited[:, :, None], cities + 0.3, cities)
    torch.testing.assert_close(network(moved, agents, visited, agent), logits)
    for row in range(len(cities)):
        one, is_open = slice(row, row + 1), ~visited[row]
        alone = network(cities[one, is_open], agents[one], visited[one, is_open], agent[one])
        torch.testing.assert_close(logits[one, is_open], alone, atol=1e-5, rtol=0)
        assert (logits[row, visited[row]] < logits[row, is_open].min()).all()


def test_a_view_holds_the_nearest_unvisited_cities(network):
    cities, agents, visited, agent = observation(n=30)
    network.config = replace(network.config, view=6)
    logits = network(cities, agents, visited, agent)
    for row in range(len(cities)):
        distance = cities[row].square().sum(1).where(~visited[row], torch.inf)
        distance[0] = -1.0
        seen = distance.argsort()[:7].sort().values  # the depot and six cities
        one = slice(row, row + 1)
        alone = network(cities[one, seen], agents[one], visited[one, seen], agent[one])
        torch.testing.assert_close(logits[one, seen], alone, atol=1e-5, rtol=0)


def test_the_depot_alone_can_be_chosen(network):
    cities, agents, visited, agent = observation()
    visited[:, 1:] = True
    logits = network(cities, agents, visited, agent)
    assert logits.isfinite().all() and (logits.argmax(1) == 0).all()


def test_the_graph_by_hand():
    """Four agents: the one that decides, one at the depot, one on its way home and one on its way to a city."""
    seen = torch.tensor([[[0.3, 0.4], [1.0, 0.0]]])  # the depot and the last unvisited city
    agents = torch.tensor([[[0.0, 0.0, 0.0], [0.3, 0.4, 0.0], [0.3, 0.4, 0.2], [0.0, 2.0, 0.7]]])
    nodes, edges, graph = agent_task_graph(seen, None, agents)
    agent_types = [UNASSIGNED_AGENT, UNASSIGNED_AGENT, ASSIGNED_AGENT, ASSIGNED_AGENT]
    assert graph.types.tolist() == [agent_types + [ASSIGNED_TASK] * 4 + [DEPOT, UNASSIGNED_TASK]]
    members = [
        [part.start + i for i, is_member in enumerate(flags[0]) if is_member]
        for part, flags in zip(graph.slices, graph.members, strict=True)
    ]
    assert members == [[2, 3], [0, 1], [7], [9], [8]]  # the city of the last agent is the only assigned task
    torch.testing.assert_close(nodes[0, 3], torch.tensor([0.0, 2.0, 0.7, 1.0]))
    torch.testing.assert_close(nodes[0, 7], torch.tensor([0.0, 2.0, 0.0, 1.0]))
    torch.testing.assert_close(nodes[0, 9], torch.tensor([1.0, 0.0, 0.0, 0.0]))
    edges = edges[0, :, :, 0]
    assert edges[0, 8].item() == pytest.approx(0.5)  # from the deciding agent to the depot
    assert edges[9, 3].item() == pytest.approx(0.7 + 5**0.5)  # the last agent reaches its city, then goes on
    assert edges[2, 3].item() == pytest.approx(0.2 + 0.7 + (0.3**2 + 1.6**2) ** 0.5)


def test_a_layer_equals_its_definition_edge_by_edge():
    """App. A, Eqs. 10 to 18, as loops over the nodes of one graph."""
    torch.manual_seed(0)
    cities, agents, visited, _ = observation(batch=1)
    nodes, edges, graph = agent_task_graph(cities[:, ~visited[0]], None, agents)
    layer = TypeAwareAttention(nodes.shape[-1], 1, 8)
    new_nodes, new_edges = layer(nodes, edges, graph)
    types = graph.types[0].tolist()
    in_graph = {
        part.start + i: kind
        for kind, (part, flags) in enumerate(zip(graph.slices, graph.members, strict=True))
        for i, is_member in enumerate(flags[0])
        if is_member
    }
    weights, bias = layer.edge_interaction()
    node_weights, node_bias = layer.node_interaction()
    for i in in_graph:
        z, h = {}, {}
        for j, kind in in_graph.items():
            assert kind == types[j]
            u = torch.cat([nodes[0, i], nodes[0, j], edges[0, i, j]]) @ weights[kind] + bias[kind]
            h[j], z[j] = layer.edge(u), layer.attention(u)
            torch.testing.assert_close(new_edges[0, i, j], h[j])
        messages = []
        for kind in range(N_TYPES):
            of_kind = [j for j in in_graph if in_graph[j] == kind]
            total = sum(z[j].exp() for j in of_kind)
            messages.append(sum((z[j].exp() / total * h[j] for j in of_kind), torch.zeros(8)))
        u = torch.cat(messages) @ node_weights[types[i]] + node_bias[types[i]]
        torch.testing.assert_close(new_nodes[0, i], layer.node(torch.cat([nodes[0, i], u])))


def test_the_interaction_depends_on_the_type_alone_and_is_bilinear():
    torch.manual_seed(0)
    interaction = TypeInteraction(3, 4)
    weights, bias = interaction()
    assert weights.shape == (N_TYPES, 3, 4) and bias.shape == (N_TYPES, 4)
    x = torch.rand(3)
    for kind, z in enumerate(interaction.context(torch.eye(N_TYPES))):
        by_hand = torch.einsum("c,cid,i->d", z, interaction.bilinear, x) + x @ interaction.linear + interaction.bias(z)
        torch.testing.assert_close(x @ weights[kind] + bias[kind], by_hand)


def test_a_network_of_types_tells_an_assigned_agent_from_an_unassigned_one(network):
    """An agent that arrives in a moment and one that has just arrived differ by their type alone."""
    cities, agents, visited, agent = observation()
    near, there = agents.clone(), agents.clone()
    near[:, 3, 2], there[:, 3, 2] = 1e-7, 0.0
    assert not torch.allclose(network(cities, near, visited, agent), network(cities, there, visited, agent), atol=1e-4)


def test_gradients_reach_every_parameter(network):
    network(*observation()).square().sum().backward()
    for name, parameter in network.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 0, name


def test_float32_agrees_with_float64(network):
    single = network(*observation())
    double = network.double()(*observation(dtype=torch.float64))
    torch.testing.assert_close(single.double(), double, atol=1e-4, rtol=0)


def test_bfloat16_leaves_logits_in_float32_and_near(network):
    exact = network(*observation())
    with torch.autocast("cpu", torch.bfloat16):
        coarse = network(*observation())
    assert coarse.dtype == torch.float32
    torch.testing.assert_close(coarse, exact, atol=0.1 * exact.std().item(), rtol=0)


def test_it_plans_tours_like_any_policy(network):
    nodes = torch.rand(12, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).numpy()
    check_tours(Instance(nodes, 3), solve(Instance(nodes, 3), make_actor(network)).tours)
    assert network.config.view is None and default_view(1000) == 100  # ``solve`` shortens the view of large instances


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [({"width": 0}, "width must be at least 1, got 0"), ({"view": 0}, "view must be at least 1, got 0")],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ScheduleNet(**kwargs)
