"""JointDAN: one transformer over agents, depot and unvisited cities, beyond the paper.

In DAN, the agents' embeddings do not depend on the cities, and cities do not attend to each other once they have
attended to the agents. Here all tokens attend to each other in every layer, at the same cost.
The policy stays decentralised: one agent's observation in, logits of that agent's next node out.

A transformer that is given coordinates has to learn what is near. With ``JointConfig.distances``, each head adds a
learned multiple of the distance between two tokens to its attention scores, as ALiBi does along a text (Press et al.
2022) and ICAM for routing (Zhou et al. 2024). The logits get such a term as well. With ``JointConfig.polar``, each
token is also given its distance from the decider, and its distance and direction from the depot.

Dense supervision teaches it where every agent goes next, not only the decider. With ``JointConfig.confidence``,
``dan_policy.solve`` lets the agents after the decider act on what is foreseen for them, if that is as good as certain:
fewer forward passes give the same tours.

In worlds it can read further keys (``JointConfig.reads``). Each adds a learned vector to some tokens, times how far the
value is from its neutral one. The vectors begin as zero, so that weights without them go on as they are; a key that an
observation does not have counts as neutral.

This module knows no environment: it takes tensors and returns tensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import repeat

import torch
from torch import Tensor, nn

from dan_policy.layers import (
    AttentionLayer,
    DenseLogits,
    check_clip,
    check_confidence,
    check_sizes,
    open_nodes,
    pointer_logits,
    scatter_nodes,
)

AGENT_KEYS = {"agent_speeds": 1.0, "agent_alive": 1.0, "agent_known": 1.0}
"""What can be read of each agent (..., m), with its neutral value; it goes to the agent's token."""

NODE_KEYS = {"service": 0.0}
"""What can be read of each node (..., n), with its neutral value; it goes to the node's token."""

SHARE_KEYS = {"city_known": 1.0}
"""What can be read of all nodes (..., n), with its neutral value; its mean goes to the depot's token. Unknown nodes
have no token of their own."""

READABLE = {**AGENT_KEYS, **NODE_KEYS, **SHARE_KEYS}


@dataclass(frozen=True)
class JointConfig:
    """The architecture of a JointDAN.

    Raises:
        ValueError: a size below 1 or beyond ``layers.GREATEST``, a number of heads that does not divide the width, a
            clip that is not above 0 or beyond ``layers.GREATEST_CLIP``, a view below 1, a confidence that is not above
            0 and at most 1, distances or polar that are not a bool, or keys to read that are unknown or named twice.
    """

    embed_dim: int = 128  # d
    feedforward_dim: int = 512
    n_heads: int = 4
    n_layers: int = 5
    tanh_clip: float = 10.0  # C: logits lie in [-C, C]
    view: int | None = None  # see at most this many cities, the nearest unvisited ones; None: all of them
    distances: bool = False  # attention scores and logits depend on the distances between tokens
    polar: bool = False  # tokens know their distance from the decider, and their distance and direction from the depot
    reads: tuple[str, ...] = ()  # keys of observations in worlds that it reads as well, of READABLE
    confidence: float | None = None  # see ``SolveOptions.confidence``; it needs a network taught what all agents do

    def __post_init__(self) -> None:
        check_sizes(self, "embed_dim", "feedforward_dim", "n_heads", "n_layers")
        if self.embed_dim % self.n_heads:
            raise ValueError(f"n_heads must divide embed_dim={self.embed_dim}, got {self.n_heads}")
        check_clip(self.tanh_clip)
        if self.view is not None and not (type(self.view) is int and self.view >= 1):
            raise ValueError(f"view must be None or at least 1 city, got {self.view!r}")
        check_confidence(self.confidence)
        for name in ("distances", "polar"):
            if type(getattr(self, name)) is not bool:
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        keys = list(self.reads) if isinstance(self.reads, (list, tuple)) else [self.reads]
        if not all(key in READABLE for key in map(str, keys)) or len(set(keys)) < len(keys):
            raise ValueError(f"reads must be different keys of {list(READABLE)}, got {self.reads!r}")
        object.__setattr__(self, "reads", tuple(keys))  # JSON has lists only


class JointDAN(nn.Module):
    """One pre-norm transformer over all tokens, then a single-head pointer from each agent to the nodes."""

    in_keys: tuple[str, ...] = ("cities", "agents", "visited", "agent")
    supports_bfloat16 = True  # trained and tested under autocast: logits stay float32
    dense_outputs = ("next", "assignment")

    def __init__(self, config: JointConfig | None = None):
        super().__init__()
        self.config = config = config or JointConfig()
        self.in_keys = (*JointDAN.in_keys, *config.reads)
        d = config.embed_dim
        self.embed_depot = nn.Linear(2, d)
        self.embed_city = nn.Linear(2, d)
        self.embed_agent = nn.Linear(3, d)
        if config.polar:
            self.embed_polar = nn.Linear(4, d, bias=False)
        self.decider = nn.Parameter(torch.empty(d))  # added to the deciding agent's token
        if not self.decider.is_meta:  # ``load`` builds it without memory first: drawing then takes seconds of imports
            nn.init.normal_(self.decider, std=0.5)
        self.layers = nn.ModuleList(
            AttentionLayer(d, config.feedforward_dim, config.n_heads, "pre") for _ in range(config.n_layers)
        )
        self.norm = nn.LayerNorm(d)
        self.next_query = nn.Linear(d, d, bias=False)
        self.next_key = nn.Linear(d, d, bias=False)
        self.assignment_query = nn.Linear(d, d, bias=False)
        self.assignment_key = nn.Linear(d, d, bias=False)
        if config.distances:  # from one head that sees everything alike to one that sees little but its neighbours
            slopes = [-3.0 * (head / max(config.n_heads - 1, 1)) ** 2 for head in range(config.n_heads)]
            self.distance_slopes = nn.Parameter(torch.tensor([slopes] * config.n_layers))  # (layers, heads)
            self.next_slope = nn.Parameter(torch.tensor(-0.1))
            self.assignment_slope = nn.Parameter(torch.tensor(-0.5))
        self.effect = nn.ParameterDict({key: torch.zeros(d) for key in config.reads})  # of each key, see the module

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor, *extra: Tensor | None) -> Tensor:
        """Logits over the nodes for one observation per row. Any number of leading dimensions is fine.

        Args:
            cities: (..., n, 2) float, node coordinates relative to the deciding agent; row 0 is the depot.
            agents: (..., m, 3) float, destinations relative to the deciding agent, and remaining travel times.
            visited: (..., n) bool, the global mask M, False at the depot.
            agent: (...) int64, the deciding agent's index; other agents may stand at the same place.
            *extra: (..., m) or (..., n), what ``config.reads`` names, in that order; None, or left out at the end: the
                observation does not have it.

        Returns:
            (..., n) float, in [-C, C]; -C at visited nodes and out of view.
        """
        lead, n = visited.shape[:-1], visited.shape[-1]
        cities, agents, visited, agent = _rows(cities, agents, visited, agent)
        h_agents, h_nodes, in_view, distances = self._encode(cities, agents, visited, agent, extra)
        h_decider = _gather(h_agents, agent[:, None])  # (B, 1, d)
        distances = None if distances is None else _gather(distances, agent[:, None])  # (B, 1, k)
        logits = self._next(h_decider, h_nodes, distances)  # (B, 1, k)
        return scatter_nodes(logits, in_view, visited, -self.config.tanh_clip).reshape(*lead, n)

    def forward_next(
        self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor, *extra: Tensor | None
    ) -> Tensor:
        """Logits (..., m, n) of where each agent goes next; the decider's row is the policy.

        Arguments as in ``forward``. At visited nodes and out of view they are -C.
        """
        lead, m, n = visited.shape[:-1], agents.shape[-2], visited.shape[-1]
        cities, agents, visited, agent = _rows(cities, agents, visited, agent)
        h_agents, h_nodes, in_view, distances = self._encode(cities, agents, visited, agent, extra)
        logits = self._next(h_agents, h_nodes, distances)  # (B, m, k)
        return scatter_nodes(logits, in_view, visited, -self.config.tanh_clip).reshape(*lead, m, n)

    def forward_dense(
        self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor, *extra: Tensor | None
    ) -> DenseLogits:
        """Logits of the policy, of all agents' next nodes and of each city's visitor; arguments as in ``forward``.

        The policy is the deciding agent's row of ``next``. At visited nodes and out of view, ``next`` is -C and
        ``assignment`` is 0.
        """
        lead, m, n = visited.shape[:-1], agents.shape[-2], visited.shape[-1]
        cities, agents, visited, agent = _rows(cities, agents, visited, agent)
        h_agents, h_nodes, in_view, distances = self._encode(cities, agents, visited, agent, extra)
        next_logits = self._next(h_agents, h_nodes, distances)  # (B, m, k)
        assignment = pointer_logits(self.assignment_query(h_agents), self.assignment_key(h_nodes))  # (B, m, k)
        if distances is not None:
            assignment = assignment + self.assignment_slope * distances
        next_logits = scatter_nodes(next_logits, in_view, visited, -self.config.tanh_clip)  # (B, m, n)
        assignment = scatter_nodes(assignment, in_view, visited, 0.0)  # (B, m, n)
        policy = _gather(next_logits, agent[:, None])  # (B, 1, n)
        return DenseLogits(policy.reshape(*lead, n), next_logits.reshape(*lead, m, n), assignment.reshape(*lead, m, n))

    def _encode(
        self, cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor, extra: Sequence[Tensor | None] = ()
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """Embeddings of the agents (B, m, d) and of the nodes in view (B, k, d), those nodes' indices (B, k), and the
        distances from agents to nodes (B, m, k); None if the network does not use them."""
        m = agents.shape[1]
        in_view, real = open_nodes(cities, visited, self.config.view, other_tokens=m)  # (B, k), the depot first
        seen = _gather(cities, in_view)  # (B, k, 2)
        decides = torch.arange(m, device=agent.device) == agent[:, None]  # (B, m)
        h_agents = self.embed_agent(agents) + decides[:, :, None] * self.decider
        h = torch.cat([h_agents, self.embed_depot(seen[:, :1]), self.embed_city(seen[:, 1:])], dim=1)  # (B, m + k, d)
        if self.config.polar:
            h = h + self.embed_polar(polar_coordinates(torch.cat([agents[:, :, :2], seen], dim=1), seen[:, :1]))
        for key, values in zip(self.config.reads, extra, strict=False):
            if values is not None:
                h = h + self._effect(key, values.reshape(len(h), -1), in_view, m)
        mask = None if real is None else torch.cat([torch.ones_like(decides), real], dim=1)  # (B, m + k)
        distances = None
        if self.config.distances:  # scaled by the nodes in view: large instances then look like those of training
            distances = token_distances(agents, seen, (~visited).sum(1).clamp(max=in_view.shape[1]))
        biases: Iterable[Tensor | None] = repeat(None)
        if distances is not None:
            slopes = self.distance_slopes[:, :, None, None]
            if mask is None:
                biases = (distances[:, None] * slope for slope in slopes)
            else:  # hide the padding in the same pass over memory
                hidden = torch.zeros_like(mask, dtype=distances.dtype).masked_fill(~mask, -torch.inf)[:, None, None]
                biases = (torch.addcmul(hidden, distances[:, None], slope) for slope in slopes)
                mask = None
        for layer, bias in zip(self.layers, biases, strict=False):
            h = layer(h, h, mask, bias)  # (B, m + k, d); the bias (B, heads, m + k, m + k)
        h = self.norm(h)
        return h[:, :m], h[:, m:], in_view, None if distances is None else distances[:, :m, m:]

    def _effect(self, key: str, values: Tensor, in_view: Tensor, m: int) -> Tensor:
        """What ``values`` (B, m) or (B, n) of ``key`` add to the tokens of m agents and k nodes: (B, m + k, d)."""
        amount = values.to(self.effect[key].dtype) - READABLE[key]
        added = amount.new_zeros(len(amount), m + in_view.shape[1])
        if key in AGENT_KEYS:
            added[:, :m] = amount
        elif key in NODE_KEYS:
            added[:, m:] = amount.gather(1, in_view)
        else:
            added[:, m] = amount.mean(1)  # the depot's token
        return added[:, :, None] * self.effect[key]

    def _next(self, h_agents: Tensor, h_nodes: Tensor, distances: Tensor | None) -> Tensor:
        """(B, m, d), (B, k, d) and (B, m, k) -> (B, m, k) logits in [-C, C]."""
        u = pointer_logits(self.next_query(h_agents), self.next_key(h_nodes))
        if distances is not None:
            u = u + self.next_slope * distances
        return self.config.tanh_clip * torch.tanh(u)


def token_distances(agents: Tensor, nodes: Tensor, n_nodes: Tensor) -> Tensor:
    """Distances between agents' destinations and nodes, in multiples of the typical distance between neighbours.

    An agent's remaining travel time is added: what is between an agent and a node is the time until the agent can be
    there, at speed 1, if it goes there next.

    Args:
        agents: (B, m, 3), destinations and remaining travel times.
        nodes: (B, k, 2).
        n_nodes: (B,), how many of the nodes are real. n points in the unit square lie about 1 / sqrt(n) apart.

    Returns:
        (B, m + k, m + k), symmetric, 0 on the diagonal.
    """
    m = agents.shape[1]
    x = torch.cat([agents[:, :, 0], nodes[:, :, 0]], dim=1)  # (B, m + k)
    y = torch.cat([agents[:, :, 1], nodes[:, :, 1]], dim=1)
    dx, dy = x[:, :, None] - x[:, None], y[:, :, None] - y[:, None]
    between = (dx.square() + dy.square()).sqrt()  # a third of what torch.linalg.vector_norm of (..., 2) takes
    remaining = agents[:, :, 2]
    between[:, :m] += remaining[:, :, None]
    between[:, :, :m] += remaining[:, None]
    between.diagonal(dim1=1, dim2=2).zero_()
    return between * n_nodes.to(between.dtype).sqrt()[:, None, None]


def polar_coordinates(positions: Tensor, depot: Tensor) -> Tensor:
    """Distances from the decider, and distances and directions from the depot.

    Args:
        positions: (B, k, 2), relative to the decider.
        depot: (B, 1, 2), likewise.

    Returns:
        (B, k, 4): the distance from the decider, that from the depot, and the cosine and sine of the direction in which
        the depot sees the position; both 0 at the depot itself.
    """
    away = positions - depot
    from_depot = away.square().sum(2, keepdim=True).sqrt()
    direction = away / from_depot.clamp(min=1e-9)
    return torch.cat([positions.square().sum(2, keepdim=True).sqrt(), from_depot, direction], dim=2)


def _rows(cities: Tensor, agents: Tensor, visited: Tensor, agent: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The observations with one leading dimension B."""
    n, m = visited.shape[-1], agents.shape[-2]
    return cities.reshape(-1, n, 2), agents.reshape(-1, m, 3), visited.reshape(-1, n), agent.reshape(-1)


def _gather(h: Tensor, indices: Tensor) -> Tensor:
    """Entries ``indices`` (B, k) of h (B, n, d) -> (B, k, d)."""
    return h.gather(1, indices[:, :, None].expand(-1, -1, h.shape[2]))
