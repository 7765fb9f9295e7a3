"""Compiled layers compute what the layers compute, for batches of any shape, and a run trains with them."""

import math
from dataclasses import replace

import pytest
import torch
from tiny import TINY, TINY_PLANS
from torch import nn

from dan_policy import JointConfig
from dan_policy.joint import JointDAN
from train.imitate import ImitationLearner
from train.network import compile_layers
from train.reinforce import ReinforceLearner

SIZES = [(3, 2, 6), (5, 3, 9), (4, 2, 12)]  # rows, agents and nodes of a batch


def observation(rows: int, n_agents: int, n_nodes: int) -> tuple[torch.Tensor, ...]:
    visited = torch.rand(rows, n_nodes) < 0.4  # rows of different lengths, so that some are padded
    visited[:, 0] = False
    return torch.randn(rows, n_nodes, 2), torch.rand(rows, n_agents, 3), visited, torch.randint(n_agents, (rows,))


@pytest.mark.slow
@pytest.mark.parametrize("distances", [False, True])
def test_compiled_layers_have_the_same_outputs_and_gradients(distances):
    torch.manual_seed(0)
    options = {"embed_dim": 16, "feedforward_dim": 32, "n_heads": 2, "n_layers": 2, "distances": distances}
    eager, compiled = JointDAN(JointConfig(**options)), JointDAN(JointConfig(**options))
    compiled.load_state_dict(eager.state_dict())
    compile_layers(compiled)
    assert list(compiled.state_dict()) == list(eager.state_dict())
    for size in SIZES:
        seen = observation(*size)
        for network in (eager, compiled):
            network.zero_grad()
            policy, following, assignment = network.forward_dense(*seen)  # reaches all parameters
            (policy.square().sum() + following.square().sum() + assignment.square().sum()).backward()
        torch.testing.assert_close(compiled(*seen), eager(*seen))
        for (name, one), other in zip(compiled.named_parameters(), eager.parameters(), strict=True):
            difference = (one.grad - other.grad).abs().max()
            assert difference <= 1e-4 * (1.0 + other.grad.abs().max()), name  # sums in another order


@pytest.mark.slow
def test_a_compiled_run_takes_the_same_steps(tmp_path):
    runs = {}
    for name in ("eager", "compiled"):
        learner = ImitationLearner(replace(TINY_PLANS, out=tmp_path / name, compile=name == "compiled"))
        runs[name] = [learner.train_step()["loss"] for _ in range(3)]
        learner.validate()  # with the average, which is not compiled
        learner.close()
    torch.testing.assert_close(torch.tensor(runs["compiled"]), torch.tensor(runs["eager"]), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("asked", [False, True])
def test_a_run_compiles_every_layer_for_any_shape_but_not_the_average(asked, tmp_path, monkeypatch):
    compiled = []
    monkeypatch.setattr(nn.Module, "compile", lambda self, **options: compiled.append((self, options)))
    learner = ImitationLearner(replace(TINY_PLANS, out=tmp_path, joint=JointConfig(n_layers=3), compile=asked))
    learner.close()
    assert isinstance(learner.network, JointDAN)
    assert compiled == [(layer, {"dynamic": True}) for layer in learner.network.layers if asked]


@pytest.mark.slow
@pytest.mark.parametrize("baseline", ["rollout", "shared"])
def test_reinforce_trains_with_compiled_layers(baseline, tmp_path):
    """Its baseline is a copy of the network, and it plays games with the network that it trains."""
    config = replace(
        TINY, policy="joint", joint=TINY_PLANS.joint, baseline=baseline, samples=2, compile=True, out=tmp_path
    )
    learner = ReinforceLearner(config)
    logs = [learner.train_step() for _ in range(2)]
    learner.validate()
    learner.close()
    assert all(math.isfinite(one["cost"]) and one["grad_norm"] > 0 for one in logs)


def test_compiling_needs_layers():
    with pytest.raises(ValueError, match=r"compile=True needs .* layers of .*'AttentionLayer'.*got Linear"):
        compile_layers(nn.Linear(2, 2))
