"""Any network, function and actor can plan, and nothing outside changes, whatever threads do."""

import random
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import exploration_type

from dan_policy import DAN, DANConfig, load, make_actor, planning, save, solve
from mtsp_env import check_tours, uniform

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


@dataclass(frozen=True)
class OwnConfig:
    scale: float = 1.0
    tanh_clip: float = 2.0
    prune_visited: bool = False
    view: int | None = None


class Own(nn.Module):
    """A network of one's own: an observation of its own, a dataclass as its config, and dropout."""

    in_keys = ("cities", ("game", "visits"), "agent")

    def __init__(self, config=None):
        super().__init__()
        self.config, self.seen = config or OwnConfig(), []
        self.layer, self.dropout = nn.Linear(2, 1), nn.Dropout(0.5)

    def forward(self, cities, visits, agent):
        self.seen.append(self.config)
        distance = torch.stack([cities.norm(dim=-1), visits.to(cities.dtype)], dim=-1)  # (B, n, 2)
        return self.config.tanh_clip * torch.tanh(self.dropout(self.layer(distance))[..., 0] + agent[:, None])


def own_function(cities, visits):
    return -cities.norm(dim=-1) - visits


own_function.in_keys = ("cities", ("game", "visits"))


@pytest.mark.parametrize("options", [{}, {"decode": "sample", "samples": 5}, {"augment": True}])
@pytest.mark.parametrize("policy", [Own(), own_function, make_actor(own_function), make_actor(Own())])
def test_any_network_and_any_actor_can_plan(policy, options):
    instance = uniform(np.random.default_rng(3), 20, 4)
    solution = solve(instance, policy, **options)
    check_tours(instance, solution.tours)
    assert solve(instance, policy, **options).tours == solution.tours


def test_a_network_and_its_actor_plan_the_same_tours(network):
    instance = uniform(np.random.default_rng(9), 20, 4)
    for options in ({}, {"decode": "sample", "samples": 5, "clip": None}, {"augment": True}):
        tours = [solve(instance, policy, **options).tours for policy in (own_function, make_actor(own_function))]
        assert tours[0] == tours[1]


def test_the_options_of_a_network_of_ones_own_are_fields_of_its_config():
    instance, own = uniform(np.random.default_rng(0), 60, 3), Own().eval()
    solve(instance, own, device="cpu", decode="sample", samples=2)
    solve(instance, own, device="cpu", view=7, prune_visited=True)
    seen = [config for number, config in enumerate(own.seen) if config not in own.seen[:number]]
    assert seen == [OwnConfig(tanh_clip=2.4), OwnConfig(prune_visited=True, view=7)]
    assert own.config == OwnConfig()


@dataclass(frozen=True)
class ViewConfig:
    view: int | None = None


@pytest.mark.slow
def test_a_network_that_always_drops_visited_cities_has_the_default_view():
    seen = []

    class Near(nn.Module):
        config = ViewConfig()

        def forward(self, cities, agents, visited):
            seen.append(self.config.view)
            return -cities.norm(dim=-1)

    near = Near().eval()
    for n_nodes, options in ((399, {}), (400, {}), (400, {"view": 7})):
        solve(uniform(np.random.default_rng(0), n_nodes, 3), near, device="cpu", **options)
    assert list(dict.fromkeys(seen)) == [None, 100, 7]


def test_a_network_of_ones_own_plans_from_its_file(tmp_path):
    instance, own = uniform(np.random.default_rng(0), 12, 3), Own()
    save(tmp_path / "own.safetensors", own, "somewhere:Own")
    loaded = load(tmp_path / "own.safetensors", network=Own())
    assert solve(instance, loaded).tours == solve(instance, own).tours
    with pytest.raises(ValueError, match="names the factory 'somewhere:Own': give the network"):
        solve(instance, tmp_path / "own.safetensors")


def test_an_actor_may_decide_by_itself():
    """Without a distribution, whatever it writes is its action, and must be legal."""
    instance = uniform(np.random.default_rng(3), 9, 2)
    first = TensorDictModule(lambda mask: mask.to(torch.uint8).argmax(-1), ["action_mask"], ["action"])
    for decode in ("greedy", "sample"):
        check_tours(instance, solve(instance, first, decode=decode, samples=2).tours)
    depot = TensorDictModule(lambda mask: torch.zeros(len(mask), dtype=torch.int64), ["action_mask"], ["action"])
    with pytest.raises(ValueError, match=r"the policy chose an illegal action, got \[0\]"):
        solve(instance, depot)


def reads_what_does_not_exist(weather):
    return weather


reads_what_does_not_exist.in_keys = ("weather",)


@pytest.mark.parametrize(
    ("policy", "message"),
    [
        (lambda cities, agents, visited: cities, r"logits of shape \(1, 6\), got \(1, 6, 2\)"),
        (lambda cities, agents, visited: cities[..., 0] * torch.nan, "logits must be finite, got nan"),
        (lambda cities, agents, visited: cities[..., 0] - torch.inf, "logits must be finite .*, got -inf"),
        (reads_what_does_not_exist, "the network reads 'weather'; choose from .*'cities'.*'visits'"),
    ],
)
def test_policies_that_make_no_sense_are_named(policy, message):
    with pytest.raises(ValueError, match=message):
        solve(uniform(np.random.default_rng(3), 6, 2), policy)


# Nothing outside changes


def test_the_callers_network_stays_as_it_is():
    """Neither device nor mode, configuration, values, places in memory nor layout."""
    instance = uniform(np.random.default_rng(3), 10, 2)
    for network in (DAN(SMALL), Own(), DAN(SMALL).eval(), make_actor(Own())):
        with torch.no_grad():
            for parameter in network.parameters():
                if parameter.ndim == 2:  # a layout of its own
                    parameter.data = parameter.data.t().contiguous().t()

        def facts(network=network):
            tensors = [
                (name, value.data_ptr(), value.stride(), value.device, value.requires_grad, value.grad, value._version)
                for name, value in network.named_parameters()
            ]
            modes = [module.training for module in network.modules()]
            return tensors, modes, getattr(network, "config", None)

        before, values = facts(), deepcopy(network.state_dict())
        solve(instance, network, decode="sample", samples=2, augment=True, precision="bfloat16")
        solve(instance, network)
        assert facts() == before
        assert all(torch.equal(value, values[name]) for name, value in network.state_dict().items())


CALLS = [
    {"decode": "greedy"},
    {"decode": "greedy", "augment": True},
    {"reconstruct": 3, "seed": 5},
    {"decode": "sample", "samples": 6, "seed": 1},
    {"decode": "sample", "samples": 5, "seed": 2, "augment": True},
    {"decode": "sample", "samples": 8, "seed": 3, "precision": "bfloat16"},
    {"decode": "sample", "samples": 4, "seed": 4, "precision": "float32"},
]


def process_state():
    """Generators and settings that belong to the whole process, or to the calling thread."""
    return (
        torch.get_rng_state().tolist(),
        [part.tolist() if isinstance(part, np.ndarray) else part for part in np.random.get_state()],  # noqa: NPY002
        random.getstate(),
        torch.get_num_threads(),
        torch.is_grad_enabled(),
        torch.is_autocast_enabled("cpu"),
        torch.is_autocast_cache_enabled(),
        torch.get_default_dtype(),
        exploration_type(),
    )


@pytest.mark.slow
def test_eight_threads_plan_what_one_does_and_change_nothing(network):
    """Every way to search and greedy games, shipped weights, networks, actors and functions, all at once."""
    instances = [uniform(np.random.default_rng(k), 12 + k, 3) for k in range(3)]
    policies = ["default", network, Own(), own_function, make_actor(own_function), make_actor(network)]
    calls = [(instance, policy, call) for instance in instances for policy in policies for call in CALLS]
    before = process_state()
    serial = [solve(instance, policy, **call).tours for instance, policy, call in calls]
    planning._read.cache_clear()  # the threads meet without weights in memory
    with ThreadPoolExecutor(8) as threads:
        solutions = threads.map(lambda call: solve(call[0], call[1], **call[2]), calls)
        assert [solution.tours for solution in solutions] == serial
    assert process_state() == before


def test_a_network_that_foresees_needs_no_configuration():
    class Foreseeing(nn.Module):
        in_keys = ("visited", "agents")

        def forward(self, visited, agents):
            return self.forward_next(visited, agents)[:, 0]

        def forward_next(self, visited, agents):
            return torch.zeros(len(visited), agents.shape[1], visited.shape[1])

    instance = uniform(np.random.default_rng(0), 9, 2)
    for decode in ("greedy", "sample"):
        check_tours(instance, solve(instance, Foreseeing(), decode=decode, samples=2, device="cpu").tours)
