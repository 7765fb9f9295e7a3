"""Building blocks that the networks share: the attention layer of the paper, the choice of nodes to encode, and dense
outputs."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

Norm = Literal["pre", "post"]


GREATEST = {"dim": 16_384, "heads": 1024, "layers": 1000}
"""Greatest widths, numbers of heads and numbers of layers: larger networks take hours or all memory to build."""

GREATEST_CLIP = 1e6


def check_sizes(config: object, *names: str, minimum: int = 1) -> None:
    """Raise ValueError unless these fields of a configuration are whole numbers from ``minimum`` to their GREATEST."""
    for name in names:
        value, maximum = getattr(config, name), GREATEST[name.rpartition("_")[2]]
        if type(value) is not int or not minimum <= value <= maximum:
            raise ValueError(f"{name} must be a whole number from {minimum} to {maximum}, got {value!r}")


def check_clip(value: float) -> None:
    """Raise ValueError unless ``value`` can be the tanh_clip of a network."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= GREATEST_CLIP:
        raise ValueError(f"tanh_clip must be a number above 0 and at most {GREATEST_CLIP:g}, got {value!r}")


def check_confidence(value: float | None) -> None:
    """Raise ValueError unless ``value`` can be the confidence of a network: None, or a probability above 0."""
    if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value <= 1):
        raise ValueError(f"confidence must be None, or above 0 and at most 1, got {value!r}")


class DenseLogits(NamedTuple):
    """Logits of the policy and, for dense supervision, of what all agents do. None: the network has no such output.

    Leading dimensions are those of the observation. A network that returns them from ``forward_dense``, with the
    arguments of ``forward``, names its outputs besides ``policy`` in ``dense_outputs``.
    """

    policy: Tensor  # (..., n) logits over the nodes: where the deciding agent goes next
    next: Tensor | None  # (..., m, n) logits over the nodes: where each agent goes next
    assignment: Tensor | None  # (..., m, n) logits over the agents: which of them visits each city


class AttentionLayer(nn.Module):
    """Multi-head attention and a feed-forward sublayer, each with a residual connection and a layer norm.

    Paper, Sec. 5, Attention Layer. It is self-attention if query and source are the same tensor, else cross-attention.

    Args:
        embed_dim: width d of queries, sources and outputs; ``n_heads`` divides it.
        feedforward_dim: width of the hidden layer of the feed-forward sublayer.
        norm: "pre" normalises what enters a sublayer, "post" what leaves it (Vaswani et al. 2017).
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

    def forward(self, query: Tensor, source: Tensor, mask: Tensor | None = None, bias: Tensor | None = None) -> Tensor:
        """Embeddings (B, q, d) of the queries.

        Args:
            query: (B, q, d).
            source: (B, k, d).
            mask: (B, k) bool, True at the keys to attend to; None: all of them.
            bias: (B, heads, q, k), added to the attention scores.
        """
        if self.norm == "post":
            h = self.norm_attention(query + self._attend(query, source, mask, bias))
            return self.norm_feedforward(h + self.feedforward(h))
        normed = self.norm_attention(query)
        h = query + self._attend(normed, normed if source is query else self.norm_attention(source), mask, bias)
        return h + self.feedforward(self.norm_feedforward(h))

    def _attend(self, query: Tensor, source: Tensor, mask: Tensor | None, bias: Tensor | None) -> Tensor:
        q = self._heads(self.query(query))  # (B, heads, q, d / heads)
        k, v = (self._heads(h) for h in self.key_value(source).chunk(2, dim=-1))
        h = attention(q, k, v, None if mask is None else mask[:, None, None, :], bias)
        return self.out(h.transpose(1, 2).flatten(2))

    def _heads(self, h: Tensor) -> Tensor:
        return h.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None, bias: Tensor | None = None) -> Tensor:
    """softmax(q k' / sqrt(width) + bias) v for q, k, v of shape (B, heads, length, width).

    ``mask`` is bool, True at the keys to attend to, and ``bias`` float. Both broadcast to (B, heads, q, k).
    """
    bias = None if bias is None else bias.to(q.dtype)
    if q.requires_grad and q.dtype == torch.bfloat16 and q.device.type == "cpu":
        # On CPUs the fused kernel's backward pass in bfloat16 takes five times as long as these products
        u = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
        u = u if bias is None else u + bias
        u = u if mask is None else u.masked_fill(~mask, -torch.inf)
        return torch.softmax(u, dim=-1) @ v
    if bias is not None:
        mask = bias if mask is None else bias.masked_fill(~mask, -torch.inf)
    return F.scaled_dot_product_attention(q, k, v, mask)


def masked_mean(h: Tensor, mask: Tensor | None = None) -> Tensor:
    """The mean of h (B, k, d) over the entries at which ``mask`` (B, k) is True, by default all -> (B, 1, d)."""
    if mask is None:
        return h.mean(1, keepdim=True)
    weight = (mask / mask.sum(1, keepdim=True)).to(h.dtype)
    return weight[:, None, :] @ h


def open_nodes(
    cities: Tensor, visited: Tensor, view: int | None = None, other_tokens: int = 0
) -> tuple[Tensor, Tensor | None]:
    """The nodes to encode if visited cities are dropped: each row's unvisited ones, the depot first.

    Args:
        cities: (B, n, 2), coordinates relative to the deciding agent.
        visited: (B, n) bool, False at the depot.
        view: keep at most this many cities per row, the nearest ones; None keeps all.
        other_tokens: number of tokens that are encoded in one sequence with the nodes; under autocast the length of
            the whole sequence is one of ``padded_length``'s.

    Returns:
        Their indices (B, k) int64, padded to the longest row, and a mask (B, k) bool that is False at the padding;
        None if there is no padding.
    """
    is_open = ~visited
    longest = int(is_open.sum(1).max())
    if view is not None and longest > 1 + view:
        distance = cities.square().sum(2).masked_fill(visited, torch.inf)
        distance[:, 0] = -1.0  # the depot is always in view, and first
        in_view = distance.topk(1 + view, dim=1, largest=False).indices  # (B, k)
    else:
        if torch.is_autocast_enabled(cities.device.type):
            longest = min(padded_length(other_tokens + longest) - other_tokens, visited.shape[1])
        in_view = torch.argsort(visited.to(torch.uint8), dim=1, stable=True)[:, :longest]  # (B, k)
    real = is_open.gather(1, in_view)
    return in_view, None if bool(real.all()) else real


def padded_length(length: int) -> int:
    """``length`` rounded up to one of a few values, by at most an eighth from 64 on.

    On CPUs, bfloat16 kernels are built once per shape, and building one takes longer than using it once.
    """
    step = max(8, 1 << (length - 1).bit_length() >> 4)
    return -(-length // step) * step


def pointer_logits(query: Tensor, key: Tensor) -> Tensor:
    """q.k / sqrt(d) of (B, m, d) and (B, k, d) -> (B, m, k), at least float32: bfloat16 is too coarse for logits."""
    u = (query @ key.transpose(1, 2)) / query.shape[-1] ** 0.5
    return u.to(torch.promote_types(u.dtype, torch.float32))


def scatter_nodes(logits: Tensor, in_view: Tensor, visited: Tensor, fill: float) -> Tensor:
    """Put logits (B, m, k) at their nodes ``in_view`` (B, k) -> (B, m, n), with ``fill`` at visited and other nodes."""
    shape = (*logits.shape[:2], visited.shape[1])
    whole = logits.new_full(shape, fill).scatter(2, in_view[:, None].expand(-1, logits.shape[1], -1), logits)
    return whole.masked_fill(visited[:, None], fill)
