"""The attention model of Kool et al. 2019 ("Attention, Learn to Solve Routing Problems!"), one of the paper's rows.

It was designed for one vehicle and does not see other agents, which DAN adds. It has a graph encoder over all nodes; a
context of the mean node, the agent's own node and the depot; a glimpse under the mask; and a single-head pointer.

>>> actor = make_actor(AttentionModel())
>>> # python -m train imitate --policy benchmarks.policies.attention_model:AttentionModel
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

TANH_CLIP = 10.0  # C: logits lie in [-C, C]


class AttentionModel(nn.Module):
    """A network from an observation to logits.

    The paper's batch normalisation would mix the decisions of a batch, and a single game has no batch to normalise
    with. Layer normalisation takes its place.
    """

    def __init__(self, embed_dim: int = 128, feedforward_dim: int = 512, n_heads: int = 8, layers: int = 3):
        super().__init__()
        self.embed_dim, self.n_heads = embed_dim, n_heads
        self.embed_depot = nn.Linear(2, embed_dim)
        self.embed_city = nn.Linear(2, embed_dim)
        layer = nn.TransformerEncoderLayer(embed_dim, n_heads, feedforward_dim, dropout=0.0, batch_first=True)
        self.encoder = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.context = nn.Linear(3 * embed_dim, embed_dim, bias=False)
        self.glimpse_key, self.glimpse_value, self.pointer_key = (
            nn.Linear(embed_dim, embed_dim, bias=False) for _ in range(3)
        )
        self.glimpse_out = nn.Linear(embed_dim, embed_dim, bias=False)

    def forward(self, cities: Tensor, agents: Tensor, visited: Tensor) -> Tensor:
        """Logits (..., n).

        Args:
            cities: (..., n, 2) relative to the deciding agent. The network uses them relative to the depot, where they
                do not change during a game, as in the original.
            agents: (..., m, 3), ignored.
            visited: (..., n), bool.
        """
        lead, n = cities.shape[:-2], cities.shape[-2]
        cities, visited = cities.reshape(-1, n, 2), visited.reshape(-1, n)
        here = cities.square().sum(-1).argmin(1)  # (B,) the agent's own node, at distance 0
        nodes = cities - cities[:, :1]  # (B, n, 2)
        h = self.encoder(torch.cat([self.embed_depot(nodes[:, :1]), self.embed_city(nodes[:, 1:])], 1))  # (B, n, d)

        # Kool et al., Sec. 3.2, Decoder: context, glimpse over the unvisited nodes, single-head pointer
        own = h[torch.arange(len(h), device=h.device), here]
        query = self.context(torch.cat([h.mean(1), own, h[:, 0]], 1))[:, None]  # (B, 1, d)
        q, k, v = (self._heads(x) for x in (query, self.glimpse_key(h), self.glimpse_value(h)))
        glimpse = F.scaled_dot_product_attention(q, k, v, ~visited[:, None, None])  # (B, heads, 1, d / heads)
        glimpse = self.glimpse_out(glimpse.transpose(1, 2).flatten(2))  # (B, 1, d)
        u = (glimpse @ self.pointer_key(h).transpose(1, 2))[:, 0] / self.embed_dim**0.5  # (B, n)
        return (TANH_CLIP * torch.tanh(u.float())).reshape(*lead, n)

    def _heads(self, h: Tensor) -> Tensor:
        return h.unflatten(-1, (self.n_heads, -1)).transpose(1, 2)
