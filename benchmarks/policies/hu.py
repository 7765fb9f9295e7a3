"""The allocation network of Hu, Yao & Lee 2020, one of the paper's rows: which agent visits each city.

"A reinforcement learning approach for optimizing multiple traveling salesman problems over graphs", Knowledge-Based
Systems 204. A graph network shared by all agents embeds the nodes. A policy network of each agent's own attends to them
and gives an embedding of that agent. The probability that an agent takes a city is a softmax over the agents. The tour
of each agent is then a problem of its own (``benchmarks/solvers/hu.py``).

>>> network = HuAllocator(n_agents=5)
>>> # python -m train imitate --policy benchmarks.policies.hu:HuAllocator --policy-options n_agents 5 --n-agents 5 5

The article's full text was not at hand. Its abstract, the paper's summary of it ("a shared graph neural network and
distributed attention mechanism networks to first allocate cities to agents"; at most 10 agents) and a public
reimplementation leave these choices:

- The graph network has three attention layers over the complete graph, pre-norm, like those of this project's networks.
- An agent's query comes from the mean embedding and the depot's, its keys and values from the cities'. Its matrices are
  its own, so that the number of agents is fixed: there are weights for each.
- Scores of agents and cities are C tanh(q.k / sqrt(d)) with C = 10 and matrices that the agents share.
- Coordinates are relative to the depot.
- It is trained by imitation of this project's reference solver, whose agents are in canonical order, not by REINFORCE
  on the lengths of the tours. The labels are the agents of the cities that are left at some decision of a game.

As a policy, which is how it is validated during training, an agent goes to the nearest of its cities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dan_policy.joint import DenseLogits
from dan_policy.layers import AttentionLayer

TANH_CLIP = 10.0  # C: scores lie in [-C, C]
NOT_OWN = 10.0  # penalty on another agent's city, larger than any distance
DEPOT = 5.0  # penalty on the depot: farther than the agent's own cities, nearer than the others


@dataclass(frozen=True)
class HuConfig:
    """The architecture of a HuAllocator.

    Raises:
        ValueError: a size below 1, or a number of heads that does not divide the width.
    """

    n_agents: int
    embed_dim: int = 96  # d
    key_dim: int = 64
    n_heads: int = 8
    n_layers: int = 3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value < 1:
                raise ValueError(f"{name} must be at least 1, got {value!r}")
        if self.embed_dim % self.n_heads:
            raise ValueError(f"n_heads must divide embed_dim={self.embed_dim}, got {self.n_heads}")


class HuAllocator(nn.Module):
    """A network that predicts the agent of each city.

    Args:
        n_agents: number of agents m of all instances.
        embed_dim: width d of the nodes' embeddings.
        n_layers: number of layers of the graph network.
    """

    in_keys = ("cities", "agents", "visited", "agent")
    dense_outputs = ("assignment",)  # what ``forward_dense`` returns besides the policy

    def __init__(self, n_agents: int, embed_dim: int = 96, n_layers: int = 3):
        super().__init__()
        self.config = config = HuConfig(n_agents, embed_dim, n_layers=n_layers)
        d, key = config.embed_dim, config.key_dim
        self.embed_city = nn.Linear(2, d)
        self.depot = nn.Parameter(torch.randn(d) / 2)  # the embedding of the depot, which is the origin
        self.layers = nn.ModuleList(AttentionLayer(d, 4 * d, config.n_heads, "pre") for _ in range(n_layers))
        self.norm = nn.LayerNorm(d)
        self.agent_query = nn.Parameter(_uniform(n_agents, 2 * d, key))
        self.agent_key, self.agent_value = (nn.Parameter(_uniform(n_agents, d, key)) for _ in range(2))
        self.query, self.key = nn.Linear(key, key, bias=False), nn.Linear(d, key, bias=False)

    def allocate(self, nodes: Tensor) -> Tensor:
        """Scores of agents and nodes (..., m, n) in [-C, C]; their softmax over the agents is a city's allocation.

        Args:
            nodes: (..., n, 2) float; row 0 is the depot, whose scores mean nothing.
        """
        lead, n = nodes.shape[:-2], nodes.shape[-2]
        nodes = (nodes - nodes[..., :1, :]).reshape(-1, n, 2)
        depot = self.depot.expand(len(nodes), 1, -1)  # (B, 1, d)
        h = torch.cat([depot, self.embed_city(nodes[:, 1:])], dim=1)  # (B, n, d)
        for layer in self.layers:
            h = layer(h, h)
        h = self.norm(h)
        context = torch.cat([h.mean(1), h[:, 0]], dim=-1)  # (B, 2 d)
        q = torch.einsum("bc,mck->bmk", context, self.agent_query)
        # q.(K'h) = (Kq).h and the sum of alpha V'h = V'(sum of alpha h) need no keys and values for each agent and city
        alpha = torch.einsum("bmk,mdk->bmd", q, self.agent_key) @ h[:, 1:].transpose(1, 2)  # (B, m, n - 1)
        alpha = (alpha / math.sqrt(self.config.key_dim)).softmax(-1)
        agents = torch.einsum("bmd,mdk->bmk", alpha @ h[:, 1:], self.agent_value)  # (B, m, key)
        u = self.query(agents) @ self.key(h).transpose(1, 2) / math.sqrt(self.config.key_dim)  # (B, m, n)
        return (TANH_CLIP * torch.tanh(u.float())).reshape(*lead, self.config.n_agents, n)

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor) -> Tensor:
        """Logits (..., n), without gradients: the agent's own cities, nearest first, then the depot, then the others.

        Args:
            cities: (..., n, 2) float, relative to the deciding agent; row 0 is the depot.
            agents: (..., m, 3) float, of which only m matters.
            visited: (..., n) bool, ignored: an allocation is for the whole instance.
            agent: (...) int64, the deciding agent's index.

        Raises:
            ValueError: another number of agents than the network's.
        """
        return self.forward_dense(cities, agents, visited, agent).policy

    def forward_dense(self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor) -> DenseLogits:
        """The logits of ``forward``, and the scores of agents and cities, which are trained; arguments as there."""
        if agents.shape[-2] != self.config.n_agents:
            raise ValueError(f"the network is for {self.config.n_agents} agents, got {agents.shape[-2]}")
        scores = self.allocate(cities)  # (..., m, n)
        is_own = scores.detach().argmax(-2) == agent[..., None]  # (..., n)
        policy = -cities.norm(dim=-1) - NOT_OWN * ~is_own  # (..., n)
        policy[..., 0] = -DEPOT
        return DenseLogits(policy, None, scores)


def _uniform(*shape: int) -> Tensor:
    """Like the weights of a linear layer with ``shape[-2]`` inputs."""
    return (torch.rand(shape) * 2 - 1) / math.sqrt(shape[-2])
