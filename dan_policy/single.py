"""One greedy game on a CPU, as soon as can be.

``network.DAN`` takes batches, trains, and runs anywhere. With one row of a few nodes most of its time goes into calling
operators, not into them; here is the same forward pass for a single observation with fewer of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dan_policy.network import DAN, AttentionLayer
from mtsp_env import rules
from mtsp_env.instance import Tours

Logits = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Attention = Callable[[Tensor, Tensor, int, "Tensor | None"], Tensor]
MANY, STEP = 64, 16  # rows from which oneDNN's products pay, where they do, and what their number is a multiple of


def can_play(policy: nn.Module, device: torch.device) -> bool:
    """Whether ``play`` is for this policy: a DAN, whose forward pass no subclass has changed, on a CPU."""
    return type(policy) is DAN and device.type == "cpu"


def play(network: DAN, state: rules.State, game: rules.Rules) -> Tours:
    """The likeliest actions from ``state``, one row of NumPy arrays, to the end: what a batched rollout would do.

    Until it returns, PyTorch has one thread in this process.
    """
    logits = forward_pass(network)
    with _one_thread():
        while not rules.all_visited(state)[0]:
            seen = rules.observe(state, game)
            u = logits(seen.cities[0], seen.agents[0], seen.visited[0])
            state = rules.depart(state, game, np.where(seen.action_mask[0], u, -np.inf).argmax(keepdims=True))
    return rules.tours(state.visits[0], state.destination[0])


@contextmanager
def _one_thread() -> Iterator[None]:
    """PyTorch with one thread: to share matrices of so few rows takes longer than to multiply them."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@torch.inference_mode()
def forward_pass(network: DAN) -> Logits:
    """The network, float32 on a CPU, as a function of NumPy arrays: cities (n, 2), agents (m, 3) float32, visited (n,)
    bool -> logits (n,) float32, those of ``DAN.forward`` up to rounding, where they mean something."""
    config, d = network.config, network.config.embed_dim
    encode_cities, encode_agents, attend_agents = (
        [_layer(layer, _of_many) for layer in layers]
        for layers in (network.city_encoder, network.agent_encoder, network.city_agent_encoder)
    )
    state_layer, glimpse_layer = _layer(network.state_layer, _of_one), _layer(network.glimpse_layer, _of_one)
    (depot_w, depot_b), (city_w, city_b), (agent_w, agent_b) = (
        (_columns(embed.weight), embed.bias) for embed in (network.embed_depot, network.embed_city, network.embed_agent)
    )
    # The pointer has one query, too: it is carried to what its keys are made of (see _of_one)
    pointer = network.pointer_query.weight.t() @ network.pointer_key.weight * d**-0.5

    def logits(cities: np.ndarray, agents: np.ndarray, visited: np.ndarray) -> np.ndarray:
        kept = _in_view(cities, visited, config.view) if config.prune_visited else np.arange(len(visited))
        closed = None if config.prune_visited else torch.from_numpy(visited)
        x, k, m = _padded(torch.from_numpy(cities[kept])), len(kept), len(agents)
        h_c = torch.cat([torch.addmm(depot_b, x[:1], depot_w), torch.addmm(city_b, x[1:], city_w)])  # (at least k, d)
        for layer in encode_cities:
            h_c = layer(h_c, h_c, k, None)
        h_a = torch.addmm(agent_b, torch.from_numpy(agents), agent_w)  # (m, d)
        for layer in encode_agents:
            h_a = layer(h_a, h_a, m, None)
        h_ca = h_c
        for layer in attend_agents:
            h_ca = layer(h_ca, h_a, m, None)
        h_s = state_layer(h_c[:k].mean(0, keepdim=True), h_a, m, None)  # (1, d)
        h_f = glimpse_layer(h_s, h_ca, k, closed)
        u = torch.mm(torch.mm(h_f, pointer), h_ca[:k].t())  # (1, k)
        found = np.full(len(visited), -config.tanh_clip, dtype=np.float32)
        found[kept] = torch.tanh(u)[0].numpy() * config.tanh_clip
        return found

    return torch.inference_mode()(logits)


def _in_view(cities: np.ndarray, visited: np.ndarray, view: int | None) -> np.ndarray:
    """(k,) Open nodes, the depot first; of more than ``view`` cities the nearest."""
    kept = np.flatnonzero(~visited)
    if view is None or len(kept) <= 1 + view:
        return kept
    distance = np.square(cities[kept[1:]]).sum(1)
    return np.append(0, kept[1:][np.argpartition(distance, view - 1)[:view]])


def _padded(x: Tensor) -> Tensor:
    """x (k, 2), and below it rows that nobody looks at: oneDNN builds a kernel for each shape, so there must be few."""
    short = -len(x) % STEP
    return F.pad(x, (0, 0, 0, short)) if short and len(x) >= MANY and _onednn_is_faster() else x


def _layer(layer: AttentionLayer, attention: Callable[[AttentionLayer], Attention]) -> Attention:
    """Query (q, d), source (at least k, d), how many keys there are, and which (k,) bool not to attend to -> (q, d)."""
    d, pre = layer.query.in_features, layer.norm == "pre"
    mix, out = attention(layer), _product(layer.out.weight)
    widen, narrow = layer.feedforward[0], layer.feedforward[2]
    up, down = _product(widen.weight, widen.bias, "relu"), _product(narrow.weight, narrow.bias)
    first, second = ((norm.weight, norm.bias) for norm in (layer.norm_attention, layer.norm_feedforward))

    def forward(h: Tensor, source: Tensor, count: int, closed: Tensor | None) -> Tensor:
        if pre:
            x = torch.layer_norm(h, (d,), *first)
            source = x if source is h else torch.layer_norm(source, (d,), *first)
            h = out(mix(x, source, count, closed)).add_(h)
            return down(up(torch.layer_norm(h, (d,), *second))).add_(h)
        h = torch.layer_norm(out(mix(h, source, count, closed)).add_(h), (d,), *first)
        return torch.layer_norm(down(up(h)).add_(h), (d,), *second)

    return forward


def _of_many(layer: AttentionLayer) -> Attention:
    """softmax(q k' / sqrt(width)) v, heads side by side: (q, d) before the output projection."""
    heads, d = layer.n_heads, layer.query.in_features
    width = d // heads
    query, key_value = _product(layer.query.weight * width**-0.5), _product(layer.key_value.weight)

    def mix(x: Tensor, source: Tensor, count: int, closed: Tensor | None) -> Tensor:
        q = query(x).view(-1, heads, width).transpose(0, 1)  # (heads, q, width)
        k, v = key_value(source)[:count].view(-1, 2 * heads, width).transpose(0, 1).split(heads)
        u = torch.bmm(q, k.transpose(1, 2))  # two products: the fused kernel is slower for so few rows
        if closed is not None:
            u.masked_fill_(closed, -torch.inf)
        return torch.bmm(torch.softmax(u, 2), v).transpose(0, 1).reshape(-1, d)

    return mix


def _of_one(layer: AttentionLayer) -> Attention:
    """The same for one query (1, d), without keys and values: q (s K)' is (q K') s', and p (s V) is (p s) V."""
    heads, d = layer.n_heads, layer.query.in_features
    width = d // heads
    query = _columns(layer.query.weight) * width**-0.5
    key, value = layer.key_value.weight.reshape(2, heads, width, d)
    value = value.transpose(1, 2).contiguous()  # (heads, d, width)

    def mix(x: Tensor, source: Tensor, count: int, closed: Tensor | None) -> Tensor:
        source = source[:count]
        q = torch.bmm(torch.mm(x, query).view(heads, 1, width), key)  # (heads, 1, d)
        u = torch.mm(q[:, 0], source.t())  # (heads, k)
        if closed is not None:
            u.masked_fill_(closed, -torch.inf)
        mixed = torch.mm(torch.softmax(u, 1), source)  # (heads, d)
        return torch.bmm(mixed[:, None], value).view(1, d)

    return mix


def _product(weight: Tensor, bias: Tensor | None = None, then: str = "none") -> Callable[[Tensor], Tensor]:
    """x (k, in) -> (k, out), by whichever library is faster for so many rows; ``then`` "relu" or nothing."""
    columns = _columns(weight)
    onednn, packed = _onednn_is_faster(), None

    def product(x: Tensor) -> Tensor:
        nonlocal packed
        if onednn and len(x) >= MANY:
            if packed is None:
                packed = torch.ops.mkldnn._reorder_linear_weight(weight.contiguous(), MANY)
            return torch.ops.mkldnn._linear_pointwise(x, packed, bias, then, [], "")
        found = torch.mm(x, columns) if bias is None else torch.addmm(bias, x, columns)
        return found.relu_() if then == "relu" else found

    return product


@cache
def _onednn_is_faster() -> bool:
    """Whether oneDNN multiplies many float32 rows faster than MKL, PyTorch's choice: up to twice, with AVX-512 on
    processors that are not Intel's, where MKL makes do with AVX2."""
    cpu = getattr(torch.cpu, "get_capabilities", dict)()
    foreign = cpu.get("avx512_f", False) and "intel" not in cpu.get("cpu_name", "intel").lower()
    return foreign and torch.backends.mkl.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


def _columns(weight: Tensor) -> Tensor:
    """(out, in) -> (in, out), contiguous: nothing to copy where it lies in memory by columns already."""
    return weight.t().contiguous()
