"""A single greedy game on a CPU: the same as the general way's, of any DAN."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dan_policy import DAN, DANConfig, make_actor, single, solve
from mtsp_env import Instance, uniform

SMALL = DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True)


@pytest.mark.parametrize(("n_nodes", "n_agents"), [(2, 1), (3, 5), (12, 3), (40, 6)])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_a_game_alone_is_the_same_game(monkeypatch, n_nodes, n_agents, precision):
    """The quick way of a single greedy game, in float32, and the general one of any actor."""
    played, play = [], single.play
    monkeypatch.setattr(single, "play", lambda *given: played.append(1) or play(*given))
    torch.manual_seed(n_nodes)
    network = DAN(SMALL)
    instance = Instance(np.random.default_rng(n_nodes).random((n_nodes, 2)), n_agents)
    alone, among = (
        solve(instance, policy, device="cpu", precision=precision).tours for policy in (network, make_actor(network))
    )
    assert alone == among
    assert len(played) == (precision == "float32")


def test_a_game_alone_takes_one_thread_and_gives_the_others_back(monkeypatch):
    threads, during = torch.get_num_threads(), []

    def broken(*_):
        during.append(torch.get_num_threads())
        raise RuntimeError("lost")

    monkeypatch.setattr(single, "_in_view", broken)
    torch.set_num_threads(3)
    try:
        with pytest.raises(RuntimeError, match="lost"):
            solve(uniform(np.random.default_rng(0), 8, 2), DAN(SMALL), device="cpu")
        assert during == [1] and torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(threads)


@given(
    st.integers(1, 3),
    st.integers(0, 2),
    st.integers(0, 2),
    st.sampled_from([1, 2, 8]),
    st.sampled_from(["pre", "post"]),
    st.sampled_from(["pre", "post"]),
    st.sampled_from([(False, None), (True, None), (True, 1), (True, 4)]),
    st.integers(2, 12),
    st.integers(1, 5),
    st.integers(0, 2**31),
)
@settings(max_examples=150, deadline=None)
def test_a_forward_pass_of_one_row_is_the_networks(
    cities, agents, crossed, heads, encoder, decoder, seeing, n_nodes, n_agents, seed
):
    """Of any architecture, on any observation, at the nodes that may be picked."""
    torch.manual_seed(seed)
    prune, view = seeing
    config = DANConfig(16, 24, heads, cities, agents, crossed, encoder, decoder, 10.0, prune, view)
    network = DAN(config).eval()
    for norm in network.modules():
        if isinstance(norm, torch.nn.LayerNorm):  # 1 and 0 would hide an exchange
            torch.nn.init.uniform_(norm.weight, 0.5, 1.5)
            torch.nn.init.uniform_(norm.bias, -0.5, 0.5)
    seen, team, visited = torch.rand(n_nodes, 2) - 0.5, torch.rand(n_agents, 3), torch.rand(n_nodes) < 0.5
    visited[0] = False
    expected = network(seen, team, visited).detach().numpy()
    found = single.forward_pass(network)(seen.numpy(), team.numpy(), visited.numpy())
    is_open = ~visited.numpy()
    np.testing.assert_allclose(found[is_open], expected[is_open], rtol=0, atol=2e-4)


@pytest.mark.skipif(not hasattr(torch.ops.mkldnn, "_linear_pointwise"), reason="this PyTorch has no oneDNN")
@pytest.mark.parametrize("norm", ["pre", "post"])
@pytest.mark.parametrize("prune", [False, True])
@pytest.mark.parametrize("n_nodes", [3, 4, 5, 8, 9, 23])
def test_products_of_onednn_and_their_padding_change_nothing(monkeypatch, norm, prune, n_nodes):
    rows, linear = [], torch.ops.mkldnn._linear_pointwise

    def counted(x, *others):
        rows.append(len(x))
        return linear(x, *others)

    monkeypatch.setattr(single, "_onednn_is_faster", lambda: True)
    monkeypatch.setattr(single, "MANY", 4)
    monkeypatch.setattr(single, "STEP", 4)
    monkeypatch.setattr(torch.ops.mkldnn, "_linear_pointwise", counted)
    torch.manual_seed(n_nodes)
    network = DAN(DANConfig(16, 24, 2, 2, 1, 1, norm, norm, 10.0, prune)).eval()
    seen, team, visited = torch.rand(n_nodes, 2) - 0.5, torch.rand(3, 3), torch.rand(n_nodes) < 0.3
    visited[0] = False
    expected = network(seen, team, visited).detach().numpy()
    found = single.forward_pass(network)(seen.numpy(), team.numpy(), visited.numpy())
    is_open = ~visited.numpy()
    np.testing.assert_allclose(found[is_open], expected[is_open], rtol=0, atol=2e-4)
    k = int(is_open.sum()) if prune else n_nodes
    assert set(rows) == ({-(-k // 4) * 4} if k >= 4 else set())


@pytest.mark.parametrize(
    ("cpu", "faster"),
    [
        ({"avx512_f": True, "cpu_name": "AMD EPYC"}, True),
        ({"avx512_f": True, "cpu_name": "Intel(R) Xeon(R) Processor"}, False),
        ({"avx512_f": False, "cpu_name": "AMD EPYC"}, False),
        ({"avx512_f": True}, False),
        ({}, False),
    ],
)
def test_onednn_is_for_processors_whose_wide_units_mkl_leaves_alone(monkeypatch, cpu, faster):
    asked = single._onednn_is_faster.__wrapped__  # what it said of this machine stays cached
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: True)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: cpu, raising=False)
    assert asked() == (faster and hasattr(torch.ops.mkldnn, "_linear_pointwise"))
    monkeypatch.setattr(torch.backends.mkl, "is_available", lambda: False)
    assert not asked()  # another library multiplies, of which nothing is known
