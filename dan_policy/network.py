"""DAN, the decentralised attention-based network (paper, Sec. 5): one agent's observation -> logits over the nodes.

Knows no environment: it takes tensors and returns tensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Norm = Literal["pre", "post"]


@dataclass(frozen=True)
class DANConfig:
    """What a DAN looks like; presets ``DANConfig.paper()`` and ``DANConfig.official()``.

    Raises:
        ValueError: a size below 1 (agent layers: 0), heads that do not divide the width, an unknown norm, a view of
            visited cities.
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
    prune_visited: bool = False  # drop visited cities before the encoders: faster, not the paper
    view: int | None = None  # with prune_visited: see no more than so many cities, the nearest unvisited ones

    def __post_init__(self) -> None:
        for name in ("embed_dim", "feedforward_dim", "n_heads", "city_layers", "agent_layers", "city_agent_layers"):
            value, least = getattr(self, name), 0 if "agent" in name else 1
            if not isinstance(value, int) or value < least:
                raise ValueError(f"{name} must be a whole number of at least {least}, got {value!r}")
        if self.embed_dim % self.n_heads:
            raise ValueError(f"n_heads must divide embed_dim={self.embed_dim}, got {self.n_heads}")
        for norm in (self.encoder_norm, self.decoder_norm):
            if norm not in ("pre", "post"):
                raise ValueError(f"unknown norm {norm!r}; choose from ['pre', 'post']")
        if not self.tanh_clip > 0:
            raise ValueError(f"tanh_clip must be above 0, got {self.tanh_clip!r}")
        if self.view is not None and not (isinstance(self.view, int) and self.view >= 1 and self.prune_visited):
            raise ValueError(f"view must be None, or with prune_visited at least 1 city, got {self.view!r}")

    @classmethod
    def paper(cls) -> DANConfig:
        """The paper's text (Sec. 5): one single-head attention layer per encoder, norms as in Vaswani et al. 2017."""
        return cls(n_heads=1, city_layers=1, encoder_norm="post")

    @classmethod
    def official(cls) -> DANConfig:
        """The authors' code: 3 layers in the city encoder, 8 heads, pre-norm encoders; 1.4 M parameters."""
        return cls()


class AttentionLayer(nn.Module):
    """Multi-head attention and a feed-forward sublayer, each with a residual connection and a layer norm.

    Sec. 5, Attention Layer. Self-attention where query and key-value source are the same tensor, else cross-attention.
    """

    def __init__(self, embed_dim: int, feedforward_dim: int, n_heads: int, norm: Norm):
        super().__init__()
        self.n_heads, self.norm = n_heads, norm
        self.query = nn.Linear(embed_dim, embed_dim, bias=False)
        self.key_value = nn.Linear(embed_dim, 2 * embed_dim, bias=False)
        self.out = nn.Linear(embed_dim, embed_dim, bias=False)
        self.feedforward = nn.Sequential(
            nn.Linear(embed_dim, feedforward_dim), nn.ReLU(inplace=True), nn.Linear(feedforward_dim, embed_dim)
        )
        self.norm_attention = nn.LayerNorm(embed_dim)
        self.norm_feedforward = nn.LayerNorm(embed_dim)

    def forward(self, query: Tensor, source: Tensor, mask: Tensor | None = None) -> Tensor:
        """query (B, q, d), source (B, k, d), mask (B, k) bool of the keys to attend to -> (B, q, d)."""
        if self.norm == "post":
            h = self.norm_attention(query + self._attend(query, source, mask))
            return self.norm_feedforward(h + self.feedforward(h))
        normed = self.norm_attention(query)
        h = query + self._attend(normed, normed if source is query else self.norm_attention(source), mask)
        return h + self.feedforward(self.norm_feedforward(h))

    def _attend(self, query: Tensor, source: Tensor, mask: Tensor | None) -> Tensor:
        q = self._heads(self.query(query))  # (B, heads, q, d / heads)
        k, v = (self._heads(h) for h in self.key_value(source).chunk(2, dim=-1))
        h = _attention(q, k, v, None if mask is None else mask[:, None, None, :])
        return self.out(h.transpose(1, 2).flatten(2))

    def _heads(self, h: Tensor) -> Tensor:
        return h.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)


class DAN(nn.Module):
    """City encoder, agent encoder, city-agent encoder, decoder (paper, Sec. 5, Fig. 2)."""

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

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
        """One observation per row -> logits. Leading dimensions are free.

        Args:
            cities: (..., n, 2) float, node coordinates relative to the deciding agent; row 0 is the depot.
            agents: (..., m, 3) float, destinations relative to it, and remaining travel distances.
            visited: (..., n) bool, the global mask M, False at the depot.

        Returns:
            (..., n) float, in [-C, C]; -C out of view; a visited node's logit means nothing: the actor masks it.
        """
        lead, n = cities.shape[:-2], cities.shape[-2]
        cities, agents, visited = (
            cities.reshape(-1, n, 2),
            agents.reshape(-1, *agents.shape[-2:]),
            visited.reshape(-1, n),
        )
        if self.config.prune_visited:
            logits = self._pruned_logits(cities, agents, visited)
        else:
            logits = self._logits(cities, agents, real=None, open_nodes=~visited)
        return logits.reshape(*lead, n)

    def _pruned_logits(self, cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
        """Gather each row's nodes in view to the front, padded to the longest row; scatter their logits back."""
        is_open = ~visited
        longest, view = int(is_open.sum(1).max()), self.config.view
        if view is not None and longest > 1 + view:
            distance = cities.square().sum(2).masked_fill(visited, torch.inf)
            distance[:, 0] = -1.0  # the depot always is in view, and first
            kept = distance.topk(1 + view, dim=1, largest=False).indices  # (B, k)
        else:
            if torch.is_autocast_enabled(cities.device.type):
                longest = min(_round_up(longest), visited.shape[1])
            kept = torch.argsort(visited.to(torch.uint8), dim=1, stable=True)[:, :longest]  # (B, k), the depot first
        real = is_open.gather(1, kept)  # (B, k) False at the padding
        logits = self._logits(
            cities.gather(1, kept[:, :, None].expand(-1, -1, 2)),
            agents,
            real=None if bool(real.all()) else real,
            open_nodes=real,
        )
        return logits.new_full(visited.shape, -self.config.tanh_clip).scatter(1, kept, logits)

    def _logits(self, cities: Tensor, agents: Tensor, real: Tensor | None, open_nodes: Tensor) -> Tensor:
        """cities (B, k, 2), agents (B, m, 3) -> (B, k); ``real`` (B, k) is False at padding, None: there is none."""
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
        h_s = _mean(h_c, real)  # (B, 1, d)
        h_s = self.state_layer(h_s, h_a)
        h_f = self.glimpse_layer(h_s, h_ca, open_nodes)
        # Sec. 5, Decoder: single-head pointer
        q, k = self.pointer_query(h_f), self.pointer_key(h_ca)
        u = (q @ k.transpose(1, 2))[:, 0] / self.config.embed_dim**0.5  # (B, k)
        u = u.to(torch.promote_types(u.dtype, torch.float32))  # bfloat16 is too coarse for probabilities
        return self.config.tanh_clip * torch.tanh(u)


def _attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None) -> Tensor:
    """softmax(q k' / sqrt(d)) v; (B, heads, length, d / heads) each, ``mask`` True at the keys to attend to."""
    if q.requires_grad and q.dtype == torch.bfloat16 and q.device.type == "cpu":
        # On CPUs the fused kernel's backward pass in bfloat16 takes five times as long as these products
        u = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        u = u if mask is None else u.masked_fill(~mask, -torch.inf)
        return torch.softmax(u, dim=-1) @ v
    return F.scaled_dot_product_attention(q, k, v, mask)


def _round_up(length: int) -> int:
    """To the next of a few lengths, at most an eighth longer from 64 on: bfloat16 kernels are built once per shape.

    On CPUs building them takes longer than using them once.
    """
    step = max(8, 1 << (length - 1).bit_length() >> 4)
    return -(-length // step) * step


def _mean(h: Tensor, real: Tensor | None) -> Tensor:
    """(B, 1, d): the mean over the nodes that are not padding."""
    if real is None:
        return h.mean(1, keepdim=True)
    weight = (real / real.sum(1, keepdim=True)).to(h.dtype)
    return weight[:, None, :] @ h
