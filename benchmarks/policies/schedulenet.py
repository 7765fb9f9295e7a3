"""ScheduleNet (Park, Bakhtiyar & Park 2021, arXiv:2106.03051), one of the paper's rows.

At every decision it encodes a complete graph of agents and tasks with two layers of type-aware graph attention. An MLP
scores each task from the embeddings of the deciding agent, of the task and of the edge between them (Eq. 6).

>>> actor = make_actor(ScheduleNet())
>>> # python -m train imitate --policy benchmarks.policies.schedulenet:ScheduleNet

From the article: the five types of nodes (App. C.1.2), the layer (App. A) and the widths of the MLPs (Table 3). Visited
cities are not in the graph. The article leaves these choices open, or they follow from the observation used here:

- An observation holds where the other agents are going and how far they still have to go, not where they are. An agent
  stands at its destination. Its remaining distance is a feature of its node, and is added to the length of its edges,
  which then say how far it is from being there.
- The features of a node are its coordinates relative to the deciding agent, its remaining distance and whether it is
  assigned. The flag "active" is left out, because only active nodes are in the graph.
- An agent is assigned if it is under way, and so is the city to which it travels. An agent at home for good looks like
  one that has not left, as it does for DAN.
- The depot can be chosen like a task. In the article, agents return when no task is left; here an agent may return
  earlier, as the teacher's agents do.
- Every node has an edge to itself. A node that has no neighbour of a type gets a message of zeros from that type.
- The multiplicative interaction is that of Jayakumar et al. 2020: z'Wx + Uz + Vx + b, 32 wide. A context z depends on a
  node's type alone, so one matrix for each type is computed.
- The logits are not clipped. Weights are initialised as by He et al. 2015: nothing normalises the embeddings, and with
  PyTorch's defaults a dozen layers would leave hardly any signal.
- It is trained by imitation of this project's reference solver, not by the article's Clip-REINFORCE.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from dan_policy.layers import open_nodes

ASSIGNED_AGENT, UNASSIGNED_AGENT, ASSIGNED_TASK, UNASSIGNED_TASK, DEPOT = range(5)
N_TYPES = 5
NODE_FEATURES = 4


@dataclass(frozen=True)
class ScheduleNetConfig:
    """The architecture of a ScheduleNet.

    Raises:
        ValueError: a size or a view below 1.
    """

    width: int = 32  # of the embeddings of nodes and edges, and of the hidden layers
    actor_widths: tuple[int, int] = (256, 128)  # hidden layers of the MLP that scores a task
    n_layers: int = 2
    view: int | None = None  # see at most this many cities, the nearest unvisited ones; None: all of them

    def __post_init__(self) -> None:
        sizes = {"width": self.width, "n_layers": self.n_layers, "view": 1 if self.view is None else self.view}
        for name, value in sizes.items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value!r}")


class Graph(NamedTuple):
    """A batch of complete graphs with N nodes, those of a type side by side.

    Both types of agents share their slice; ``members`` says which of them an agent belongs to.
    """

    slices: tuple[slice, ...]  # the nodes of each type
    members: tuple[Tensor, ...]  # (B, length of the slice) bool for each type: False at padding and at other types
    types: Tensor  # (B, N) int64


class ScheduleNet(nn.Module):
    """A network from an observation to logits.

    Args:
        width: width of the embeddings and of the hidden layers.
        n_layers: number of layers of type-aware graph attention.
        view: number of nearest unvisited cities that are in the graph; None: all of them.
    """

    in_keys = ("cities", "agents", "visited", "agent")
    supports_bfloat16 = True  # the MLP that scores tasks stays in float32

    def __init__(self, width: int = 32, n_layers: int = 2, view: int | None = None):
        super().__init__()
        self.config = config = ScheduleNetConfig(width=width, n_layers=n_layers, view=view)
        inputs = [(NODE_FEATURES, 1)] + [(width, width)] * (n_layers - 1)
        self.layers = nn.ModuleList(TypeAwareAttention(nodes, edges, width) for nodes, edges in inputs)
        self.actor = mlp([3 * width, *config.actor_widths, 1])

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor) -> Tensor:
        """Logits over the nodes for one observation per row. Any number of leading dimensions is fine.

        Args:
            cities: (..., n, 2) float, relative to the deciding agent; row 0 is the depot.
            agents: (..., m, 3) float, destinations relative to the deciding agent, and remaining travel distances.
            visited: (..., n) bool, False at the depot.
            agent: (...) int64, the deciding agent's index.

        Returns:
            (..., n) float; the lowest logit of the row, less 10, at visited nodes and out of view.
        """
        lead, n, m = visited.shape[:-1], visited.shape[-1], agents.shape[-2]
        cities, agents = cities.reshape(-1, n, 2), agents.reshape(-1, m, 3)
        visited, agent = visited.reshape(-1, n), agent.reshape(-1)
        in_view, real = open_nodes(cities, visited, self.config.view)  # (B, k), the depot first
        seen = cities.gather(1, in_view[:, :, None].expand(-1, -1, 2))  # (B, k, 2)
        nodes, edges, graph = agent_task_graph(seen, real, agents)
        for layer in self.layers:
            nodes, edges = layer(nodes, edges, graph)

        # Eq. 6: h_i, h_j and h_ij of the deciding agent i and each task j
        row = torch.arange(len(agent), device=agent.device)
        own, from_tasks = nodes[row, agent], edges[row, agent][:, 2 * m :]  # (B, d), (B, k, d)
        tasks = nodes[:, 2 * m :]  # (B, k, d), the depot first
        h = torch.cat([own[:, None].expand_as(tasks), tasks, from_tasks.to(tasks.dtype)], dim=-1)  # (B, k, 3 d)
        with torch.autocast(h.device.type, enabled=False):  # bfloat16 is too coarse for logits
            logits = self.actor(h.to(torch.promote_types(h.dtype, torch.float32)))[..., 0]  # (B, k)
        if real is not None:
            logits = logits.masked_fill(~real, torch.inf)
        lowest = logits.detach().amin(1, keepdim=True) - 10  # (B, 1)
        logits = torch.where(logits.isinf(), lowest, logits)
        return lowest.repeat(1, n).scatter(1, in_view, logits).reshape(*lead, n)


class TypeAwareAttention(nn.Module):
    """One layer of type-aware graph attention (App. A).

    Args:
        node_width: width of the nodes' inputs.
        edge_width: width of the edges' inputs.
        width: width of both outputs, of the contexts and of the hidden layers.
    """

    def __init__(self, node_width: int, edge_width: int, width: int):
        super().__init__()
        self.input_widths = (node_width, node_width, edge_width)
        self.edge_interaction = TypeInteraction(sum(self.input_widths), width)
        self.edge, self.attention = mlp([width, width, width, width]), mlp([width, width, width, 1])
        self.node_interaction = TypeInteraction(N_TYPES * width, width)
        self.node = mlp([node_width + width, width, width, width])

    def forward(self, nodes: Tensor, edges: Tensor, graph: Graph) -> tuple[Tensor, Tensor]:
        """Nodes (B, N, f) and edges (B, N, N, e), from column j to row i -> both with d features instead."""
        u = self._edge_encoding(nodes, edges, graph)  # (B, N, N, d)
        edges, z = self.edge(u), self.attention(u)[..., 0]  # Eqs. 12 and 13
        messages = []  # Eqs. 14 to 16
        for part, members in zip(graph.slices, graph.members, strict=True):
            is_member = members[:, None]  # (B, 1, length)
            alpha = z[:, :, part].masked_fill(~is_member, -1e9).softmax(2) * is_member  # (B, N, length)
            messages.append((alpha[:, :, None] @ edges[:, :, part])[:, :, 0])  # (B, N, d)
        weights, bias = self.node_interaction()
        by_type = torch.einsum("bni,tid->bntd", torch.cat(messages, dim=-1), weights) + bias  # (B, N, types, d)
        index = graph.types[:, :, None, None].expand(-1, -1, 1, by_type.shape[-1])
        message = by_type.gather(2, index)[:, :, 0]  # (B, N, d)
        return self.node(torch.cat([nodes, message], dim=-1)), edges  # Eq. 18

    def _edge_encoding(self, nodes: Tensor, edges: Tensor, graph: Graph) -> Tensor:
        """Eq. 11: the interaction of [h_i, h_j, h_ij] with the type of the source j -> (B, N, N, d)."""
        weights, bias = self.edge_interaction()
        of_target, of_source, of_edge = weights.split(self.input_widths, dim=1)  # (types, inputs, d) each
        target = torch.einsum("bni,tid->bntd", nodes, of_target) + bias  # (B, N, types, d)
        source = torch.einsum("bni,tid->bntd", nodes, of_source)  # (B, N, types, d)
        encodings: dict[int, Tensor] = {}  # by the first node of their slice
        for kind, (part, members) in enumerate(zip(graph.slices, graph.members, strict=True)):
            u = edges[:, :, part] @ of_edge[kind] + target[:, :, None, kind] + source[:, None, part, kind]
            if part.start in encodings:  # the agents' slice, which two types share
                u = torch.where(members[:, None, :, None], u, encodings[part.start])
            encodings[part.start] = u  # (B, N, length, d)
        return torch.cat([encodings[start] for start in sorted(encodings)], dim=2)


class TypeInteraction(nn.Module):
    """A multiplicative interaction with the type of a node: one affine map for each type.

    Args:
        n_inputs: width of the input x.
        width: width of the output and of the contexts z.
    """

    def __init__(self, n_inputs: int, width: int):
        super().__init__()
        self.context = mlp([N_TYPES, width, width])  # MLP_etype or MLP_ntype
        self.bilinear = nn.Parameter(_uniform(width, n_inputs, width) * (3 / (width * n_inputs)) ** 0.5)
        self.linear = nn.Parameter(_uniform(n_inputs, width) * (3 / n_inputs) ** 0.5)
        self.bias = nn.Linear(width, width)

    def forward(self) -> tuple[Tensor, Tensor]:
        """For each type, the matrix z'W + V (types, n_inputs, width) and the bias Uz + b (types, width)."""
        z = self.context(torch.eye(N_TYPES, device=self.linear.device, dtype=self.linear.dtype))  # (types, width)
        return torch.einsum("tc,cid->tid", z, self.bilinear) + self.linear, self.bias(z)


def _uniform(*shape: int) -> Tensor:
    """Uniform on [-1, 1), whose variance is 1/3."""
    return torch.rand(shape) * 2 - 1


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """A multilayer perceptron with these widths, ReLU between its layers and none at its end (Table 3)."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
        nn.init.kaiming_uniform_(layers[-2].weight, nonlinearity="relu")
    return nn.Sequential(*layers[:-1])


def agent_task_graph(seen: Tensor, real: Tensor | None, agents: Tensor) -> tuple[Tensor, Tensor, Graph]:
    """The graph of agents, their m tasks, the depot and the unassigned tasks, in this order.

    Args:
        seen: (B, k, 2), the depot and the unvisited cities.
        real: (B, k) bool, False at padding; None if there is no padding.
        agents: (B, m, 3), destinations and remaining travel distances.

    Returns:
        The features of its N = 2m + k nodes (B, N, 4) and of its edges (B, N, N, 1), and the graph. The place of the
        task of an agent without one is not a node: ``members`` is False there.
    """
    m, k = agents.shape[1], seen.shape[1]
    destination, remaining = agents[..., :2], agents[..., 2]
    assigned = remaining > 0  # (B, m)
    to_depot = (destination - seen[:, :1]).abs().amax(2) < 1e-6  # (B, m)
    has_task = assigned & ~to_depot  # (B, m)
    free = seen.new_zeros(seen.shape[:2])  # (B, k)
    place = torch.cat([destination, destination, seen], dim=1)  # (B, N, 2)
    left = torch.cat([remaining, torch.zeros_like(remaining), free], dim=1)  # (B, N)
    flag = torch.cat([assigned, has_task, free], dim=1)  # (B, N)
    real = torch.ones_like(free, dtype=torch.bool) if real is None else real
    cities = slice(2 * m + 1, 2 * m + k)
    slices = (slice(0, m), slice(0, m), slice(m, 2 * m), cities, slice(2 * m, 2 * m + 1))
    members = (assigned, ~assigned, has_task, real[:, 1:], real[:, :1])
    types = torch.full(flag.shape, UNASSIGNED_TASK, device=seen.device)
    types[:, :m] = torch.where(assigned, ASSIGNED_AGENT, UNASSIGNED_AGENT)
    types[:, m : 2 * m] = ASSIGNED_TASK
    types[:, 2 * m] = DEPOT
    nodes = torch.cat([place, left[..., None], flag[..., None].to(seen.dtype)], dim=-1)  # (B, N, 4)
    distance = torch.cdist(place, place, compute_mode="donot_use_mm_for_euclid_dist")  # (B, N, N)
    edges = (distance + left[:, :, None] + left[:, None])[..., None]  # (B, N, N, 1)
    return nodes, edges, Graph(slices, members, types)
