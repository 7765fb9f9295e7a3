"""DAN, the decentralised attention-based network (paper, Sec. 5): one agent's observation -> logits over the nodes.

It knows no environment: it takes tensors and returns tensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dan_policy.layers import (
    AttentionLayer,
    DenseLogits,
    Norm,
    check_clip,
    check_sizes,
    masked_mean,
    open_nodes,
    pointer_logits,
    scatter_nodes,
)


@dataclass(frozen=True)
class DANConfig:
    """The architecture of a DAN; presets ``DANConfig.paper()`` and ``DANConfig.official()``.

    Raises:
        ValueError: a size below 1 (agent layers: below 0) or beyond ``layers.GREATEST``, a number of heads that does
            not divide the width, an unknown norm, a clip that is not above 0 or beyond ``layers.GREATEST_CLIP``, or a
            view without ``prune_visited``.
    """

    embed_dim: int = 128  # d
    feedforward_dim: int = 512
    n_heads: int = 8
    city_layers: int = 3
    agent_layers: int = 1  # 0: no agent encoder, an ablation
    city_agent_layers: int = 1  # 0: cities do not attend to agents, an ablation
    encoder_norm: Norm = "pre"
    decoder_norm: Norm = "post"
    tanh_clip: float = 10.0  # C: logits lie in [-C, C]
    prune_visited: bool = False  # drop visited cities before the encoders: faster, not in the paper
    view: int | None = None  # with prune_visited: see at most this many cities, the nearest unvisited ones
    assignment: bool = False  # also predict which agent visits each city, for dense supervision; not in the paper

    def __post_init__(self) -> None:
        check_sizes(self, "embed_dim", "feedforward_dim", "n_heads", "city_layers")
        check_sizes(self, "agent_layers", "city_agent_layers", minimum=0)
        if self.embed_dim % self.n_heads:
            raise ValueError(f"n_heads must divide embed_dim={self.embed_dim}, got {self.n_heads}")
        for norm in (self.encoder_norm, self.decoder_norm):
            if norm not in ("pre", "post"):
                raise ValueError(f"unknown norm {norm!r}; choose from ['pre', 'post']")
        check_clip(self.tanh_clip)
        for name in ("prune_visited", "assignment"):
            if type(getattr(self, name)) is not bool:
                raise ValueError(f"{name} must be True or False, got {getattr(self, name)!r}")
        if self.view is not None and not (type(self.view) is int and self.view >= 1 and self.prune_visited):
            raise ValueError(f"view must be None, or with prune_visited at least 1 city, got {self.view!r}")

    @classmethod
    def paper(cls) -> DANConfig:
        """The paper's text (Sec. 5): one single-head attention layer per encoder, norms as in Vaswani et al. 2017."""
        return cls(n_heads=1, city_layers=1, encoder_norm="post")

    @classmethod
    def official(cls) -> DANConfig:
        """The authors' code: three layers in the city encoder, eight heads, pre-norm encoders; 1.4 M parameters."""
        return cls()


class DAN(nn.Module):
    """City encoder, agent encoder, city-agent encoder, decoder (paper, Sec. 5, Fig. 2)."""

    in_keys = ("cities", "agents", "visited")
    supports_bfloat16 = True  # trained and tested under autocast: logits stay float32

    def __init__(self, config: DANConfig | None = None):
        super().__init__()
        self.config = config = config or DANConfig.official()

        def layer(norm: Norm) -> AttentionLayer:
            return AttentionLayer(config.embed_dim, config.feedforward_dim, config.n_heads, norm)

        def encoder(layers: int) -> nn.ModuleList:
            return nn.ModuleList(layer(config.encoder_norm) for _ in range(layers))

        self.embed_depot = nn.Linear(2, config.embed_dim)
        self.embed_city = nn.Linear(2, config.embed_dim)
        self.embed_agent = nn.Linear(3, config.embed_dim)
        self.city_encoder = encoder(config.city_layers)
        self.agent_encoder = encoder(config.agent_layers)
        self.city_agent_encoder = encoder(config.city_agent_layers)
        self.state_layer = layer(config.decoder_norm)
        self.glimpse_layer = layer(config.decoder_norm)
        self.pointer_query = nn.Linear(config.embed_dim, config.embed_dim, bias=False)
        self.pointer_key = nn.Linear(config.embed_dim, config.embed_dim, bias=False)
        if config.assignment:
            self.assignment_query = nn.Linear(config.embed_dim, config.embed_dim, bias=False)
            self.assignment_key = nn.Linear(config.embed_dim, config.embed_dim, bias=False)

    @property
    def dense_outputs(self) -> tuple[str, ...]:
        """What ``forward_dense`` returns besides the policy."""
        return ("assignment",) if self.config.assignment else ()

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
        """Logits over the nodes for one observation per row. Any number of leading dimensions is fine.

        Args:
            cities: (..., n, 2) float, node coordinates relative to the deciding agent; row 0 is the depot.
            agents: (..., m, 3) float, destinations relative to it, and remaining travel distances.
            visited: (..., n) bool, the global mask M, False at the depot.

        Returns:
            (..., n) float, in [-C, C]; -C out of view. A visited node's logit means nothing: the actor masks it.
        """
        policy, *_ = self._decide(cities, agents, visited)
        return policy.reshape(visited.shape)

    def forward_dense(self, cities: Tensor, agents: Tensor, visited: Tensor) -> DenseLogits:
        """Logits of the policy and, with ``config.assignment``, of each city's visitor; arguments as in ``forward``.

        The visitors are read from the city-agent embeddings, which are meant to predict who may take which city (Sec.
        5, City-agent Encoder). They are 0 at visited nodes and out of view.
        """
        policy, h_a, h_ca, in_view = self._decide(cities, agents, visited)
        policy = policy.reshape(visited.shape)
        if not self.config.assignment:
            return DenseLogits(policy, None, None)
        scores = pointer_logits(self.assignment_query(h_a), self.assignment_key(h_ca))  # (B, m, k)
        assignment = scatter_nodes(scores, in_view, visited.reshape(-1, visited.shape[-1]), 0.0)  # (B, m, n)
        return DenseLogits(policy, None, assignment.reshape(*agents.shape[:-1], visited.shape[-1]))

    def _decide(self, cities: Tensor, agents: Tensor, visited: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Logits (B, n), embeddings of agents (B, m, d) and of nodes in view (B, k, d), and those nodes (B, k)."""
        n = cities.shape[-2]
        cities, visited = cities.reshape(-1, n, 2), visited.reshape(-1, n)
        agents = agents.reshape(-1, *agents.shape[-2:])
        if not self.config.prune_visited:
            logits, h_a, h_ca = self._logits(cities, agents, real=None, unvisited=~visited)
            return logits, h_a, h_ca, torch.arange(n, device=visited.device).expand_as(visited)
        in_view, real = open_nodes(cities, visited, self.config.view)  # (B, k)
        seen = cities.gather(1, in_view[:, :, None].expand(-1, -1, 2))  # (B, k, 2)
        logits, h_a, h_ca = self._logits(seen, agents, real, unvisited=real)
        return logits.new_full(visited.shape, -self.config.tanh_clip).scatter(1, in_view, logits), h_a, h_ca, in_view

    def _logits(
        self, cities: Tensor, agents: Tensor, real: Tensor | None, unvisited: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """cities (B, k, 2), agents (B, m, 3) -> logits (B, k), embeddings of agents (B, m, d) and nodes (B, k, d).

        ``real`` (B, k) is False at padding, ``unvisited`` (B, k) at what may not be picked; None if there is neither.
        """
        # Sec. 5, City Encoder
        h_c = torch.cat([self.embed_depot(cities[:, :1]), self.embed_city(cities[:, 1:])], dim=1)  # (B, k, d)
        for layer in self.city_encoder:
            h_c = layer(h_c, h_c, real)
        # Sec. 5, Agent Encoder
        h_a = self.embed_agent(agents)  # (B, m, d)
        for layer in self.agent_encoder:
            h_a = layer(h_a, h_a)
        # Sec. 5, City-agent Encoder: cities attend to agents, which predicts who may take which city
        h_ca = h_c
        for layer in self.city_agent_encoder:
            h_ca = layer(h_ca, h_a)
        # Sec. 5, Decoder: the mean city embedding is the deciding agent's state; first the agents, then a glimpse
        h_s = masked_mean(h_c, real)  # (B, 1, d)
        h_s = self.state_layer(h_s, h_a)
        h_f = self.glimpse_layer(h_s, h_ca, unvisited)
        # Sec. 5, Decoder: single-head pointer
        q, k = self.pointer_query(h_f), self.pointer_key(h_ca)
        u = (q @ k.transpose(1, 2))[:, 0] / self.config.embed_dim**0.5  # (B, k)
        u = u.to(torch.promote_types(u.dtype, torch.float32))  # bfloat16 is too coarse for probabilities
        return self.config.tanh_clip * torch.tanh(u), h_a, h_ca
