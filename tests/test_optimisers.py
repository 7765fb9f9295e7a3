"""Muon moves the matrices of hidden layers, AdamW all other parameters; both follow one schedule and resume bit for
bit."""

import copy
from dataclasses import replace

import pytest
import torch
from helpers.states import same
from tiny import TINY_PLANS as TINY
from tiny import interrupt_after
from torch import nn
from torch.optim.lr_scheduler import LambdaLR

from dan_policy.dan import DAN, DANConfig
from dan_policy.joint import JointConfig, JointDAN
from train import checkpoint
from train.imitate import ImitationLearner, imitate
from train.optimisers import hidden_matrices, make_optimiser

NETWORKS = {
    "joint": lambda: JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=2)),
    "dan": lambda: DAN(DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1)),
    "torch": lambda: nn.Sequential(
        nn.Linear(2, 16), nn.TransformerEncoderLayer(16, 2, 32, batch_first=True), nn.Linear(16, 1)
    ),
}
MATRICES_PER_LAYER = {"joint": 5, "dan": 5, "torch": 4}  # query, key_value, out, two of the feed-forward sublayer
LAYERS = {"joint": 2, "dan": 5, "torch": 1}


@pytest.fixture(params=sorted(NETWORKS))
def kind(request):
    return request.param


@pytest.fixture
def network(kind):
    torch.manual_seed(0)
    return NETWORKS[kind]()


def give_gradients(network, seed):
    generator = torch.Generator().manual_seed(seed)
    for parameter in network.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_hidden_matrices_are_those_of_the_layers(network, kind):
    matrices = hidden_matrices(network)
    assert len(matrices) == LAYERS[kind] * MATRICES_PER_LAYER[kind]
    assert all(min(matrix.shape) >= 16 for matrix in matrices)  # no embedding of coordinates


def test_muon_steps_are_orthogonal_and_the_others_are_adamws(network):
    """Without decay, Muon's first step is 0.2 sqrt(longer side) lr times a matrix with singular values near 1."""
    reference = copy.deepcopy(network)
    before = [parameter.detach().clone() for parameter in network.parameters()]
    muon = make_optimiser("muon", network, 0.01, 0.0)
    adamw = make_optimiser("adamw", reference, 0.01, 0.0)
    for one, optimiser in ((network, muon), (reference, adamw)):
        give_gradients(one, 1)
        optimiser.step()
    matrices = set(hidden_matrices(network))
    for old, new, by_adamw in zip(before, network.parameters(), reference.parameters(), strict=True):
        if new in matrices:
            scale = 0.01 * 0.2 * max(new.shape) ** 0.5
            singular = torch.linalg.svdvals((new - old) / scale)
            assert singular.max() < 1.3 and singular.mean() > 0.6
        else:
            assert torch.equal(new, by_adamw)


def test_one_schedule_reaches_all_parameters(network):
    """A learning rate of 0 moves nothing, also after the state was loaded."""
    optimiser = make_optimiser("muon", network, 0.01, 0.1)
    factors = [1.0, 0.0, 1.0]
    schedule = LambdaLR(optimiser, lambda step: factors[step])
    give_gradients(network, 1)
    optimiser.step()
    schedule.step()
    optimiser.load_state_dict(copy.deepcopy(optimiser.state_dict()))
    still = [parameter.detach().clone() for parameter in network.parameters()]
    optimiser.step()
    assert all(map(torch.equal, still, network.parameters()))
    schedule.step()
    optimiser.step()
    assert not any(map(torch.equal, still, network.parameters()))


def test_a_loaded_state_continues_bit_for_bit(network, kind):
    optimiser = make_optimiser("muon", network, 0.01, 0.1)
    for seed in range(3):
        give_gradients(network, seed)
        optimiser.step()
    copied = copy.deepcopy(network)
    other = make_optimiser("muon", copied, 0.01, 0.1)
    other.load_state_dict(copy.deepcopy(optimiser.state_dict()))
    fresh = copy.deepcopy(network)
    for one, its_optimiser in (
        (network, optimiser),
        (copied, other),
        (fresh, make_optimiser("muon", fresh, 0.01, 0.1)),
    ):
        give_gradients(one, 9)
        its_optimiser.step()
        its_optimiser.zero_grad()
        assert all(parameter.grad is None for parameter in one.parameters())
    assert all(map(torch.equal, network.parameters(), copied.parameters()))
    assert not all(map(torch.equal, network.parameters(), fresh.parameters()))


def test_muon_needs_hidden_layers():
    with pytest.raises(ValueError, match=r"optimiser='muon' needs .* layers of .*'AttentionLayer'.*got Linear"):
        make_optimiser("muon", nn.Linear(2, 2), 0.01, 0.0)


@pytest.mark.slow
def test_imitation_with_muon_resumes_bit_for_bit(tmp_path, monkeypatch):
    muon = replace(TINY, optimiser="muon")
    imitate(replace(muon, out=tmp_path / "whole"))

    interrupt_after(5, ImitationLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        imitate(replace(muon, out=tmp_path / "parts"))
    monkeypatch.undo()
    assert checkpoint.read(tmp_path / "parts" / "checkpoint.pt")["progress"]["step"] == 5
    assert imitate(replace(muon, out=tmp_path / "parts", resume=True)).step == 12
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "buffer"):
        assert same(whole[key], parts[key]), key
    imitate(replace(TINY, out=tmp_path / "adamw"))
    assert not same(whole["network"], checkpoint.read(tmp_path / "adamw" / "checkpoint.pt")["network"])
