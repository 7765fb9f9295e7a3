"""Plans: tours always solve the instance, by any policy, and nothing outside changes, whatever threads do."""

import random
import sys
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import exploration_type

import mtsp_env
from benchmarks.policies.nearest import nearest
from dan_policy import DAN, DANConfig, SolveOptions, heuristics, load, make_actor, planning, save, solve
from mtsp_env import Instance, check_tours, makespan, uniform

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


@settings(max_examples=30, deadline=None)
@given(
    st.integers(2, 12), st.integers(1, 15), st.integers(0, 2**31), st.sampled_from(["greedy", "sample"]), st.booleans()
)
def test_a_plan_always_solves_the_instance(n_nodes, n_agents, seed, decode, coincide):
    torch.manual_seed(seed)
    nodes = np.random.default_rng(seed).random((n_nodes, 2))
    instance = Instance(np.full_like(nodes, 0.5) if coincide else nodes, n_agents)
    solution = solve(instance, DAN(SMALL), decode=decode, samples=3, seed=seed)
    check_tours(instance, solution.tours)
    assert solution.makespan == makespan(instance, solution.tours)
    assert solution.seconds > 0


def test_seeded_plans_repeat(network):
    instance = uniform(np.random.default_rng(1), 15, 3)
    first, again, other = (solve(instance, network, decode="sample", samples=4, seed=s) for s in (1, 1, 2))
    assert first.tours == again.tours and first.tours != other.tours
    assert (first.method, solve(instance, network).method) == ("dan(s.4)", "dan(g.)")


def test_more_samples_are_never_worse_than_the_first_of_them(network):
    instance = uniform(np.random.default_rng(2), 15, 3)
    costs = [solve(instance, network, decode="sample", samples=64, seed=seed).makespan for seed in range(3)]
    singles = [solve(instance, network, decode="sample", samples=1, seed=seed).makespan for seed in range(8)]
    assert max(costs) < np.mean(singles)


def test_augmented_plans_are_the_best_of_the_eight_views(network):
    instance = uniform(np.random.default_rng(7), 14, 3)
    centred = [instance.nodes - 0.5, (instance.nodes - 0.5) * [-1, 1]]
    turned = [part @ np.linalg.matrix_power([[0, -1], [1, 0]], k) + 0.5 for part in centred for k in range(4)]
    alone = [solve(Instance(nodes, 3), network).makespan for nodes in turned]
    best = solve(instance, network, augment=True)
    assert best.makespan == pytest.approx(min(alone), abs=1e-9) and len({round(cost, 6) for cost in alone}) > 1
    assert best.method == "dan(g.x8)"
    check_tours(instance, best.tours)

    seen = []

    def uniform_logits(cities, visited):
        seen.append(cities)
        return torch.zeros(visited.shape)

    drawn = solve(
        instance, make_actor(uniform_logits, ["cities", "visited"]), decode="sample", samples=11, augment=True
    )
    assert drawn.method == "ProbabilisticActor(s.11x8)"
    views = {tuple(view.flatten().tolist()) for view in seen[0].round(decimals=5)}
    assert len(seen[0]) == 11 and len(views) == 8


def test_any_actor_can_plan():
    instance = uniform(np.random.default_rng(3), 20, 4)
    solution = solve(instance, make_actor(nearest))
    check_tours(instance, solution.tours)


# Improvement


@pytest.mark.parametrize(("decode", "name"), [("greedy", "(g.)+improve(0.05 s)"), ("sample", "(s.3)+improve(0.05 s)")])
def test_improved_plans_are_shorter_and_take_their_time(network, decode, name):
    pytest.importorskip("numba", reason="needs the extra reference")
    instance = uniform(np.random.default_rng(5), 40, 1)  # one agent: no search ends early at the farthest city
    for policy, owner in ((network, "dan"), (nearest, "nearest")):
        plain = solve(instance, policy, decode=decode, samples=3)
        improved = solve(instance, policy, decode=decode, samples=3, improve=0.05)
        check_tours(instance, improved.tours)
        assert improved.makespan == makespan(instance, improved.tours) < plain.makespan
        assert improved.method == owner + name
        assert improved.seconds >= 0.05


def test_the_policys_tours_are_what_is_improved(network, monkeypatch):
    reference = pytest.importorskip("mtsp_env.reference", reason="needs the extra reference")
    instance, calls = uniform(np.random.default_rng(6), 12, 3), []
    monkeypatch.setattr(reference, "improve", lambda *args, **options: calls.append((args, options)) or args[1])
    plain, improved = (
        solve(instance, network, decode="sample", samples=4, seed=9, improve=seconds) for seconds in (None, 2.5)
    )
    assert calls == [((instance, plain.tours), {"seconds": 2.5, "seed": 9, "prefixes": None})]
    assert improved.tours == plain.tours


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"improve": 0.0}, "improve must be a finite number of seconds above 0, got 0.0"),
        ({"improve": -1}, "improve must be a finite number of seconds above 0, got -1"),
        ({"improve": float("inf")}, "improve must be a finite number of seconds above 0, got inf"),
        ({"improve": True}, "improve must be a finite number of seconds above 0, got True"),
        ({"improve": "soon"}, "improve must be a finite number of seconds above 0, got 'soon'"),
        ({"clip": 0.0}, "clip must be above 0, got 0.0"),
        ({"decode": "beam"}, "unknown decode 'beam'; choose from \\['greedy', 'sample'\\]"),
        ({"samples": 0}, "samples must be a whole number of at least 1, got 0"),
        ({"view": 0}, "view must be a whole number of at least 1, got 0"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"seed": 2**63}, "seed must be below 2\\^63, got 9223372036854775808"),
        ({"precision": "float16"}, "unknown precision 'float16'; choose from \\['auto', 'float32', 'bfloat16'\\]"),
    ],
)
def test_bad_options_are_named_before_anything_is_planned(network, monkeypatch, kwargs, message):
    with pytest.raises(ValueError, match=message):
        SolveOptions(**kwargs)
    monkeypatch.setattr(planning, "play", None)  # calling it would be a TypeError
    with pytest.raises(ValueError, match=message):
        solve(uniform(np.random.default_rng(0), 5, 2), network, **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "n_nodes", "expected"),
    [
        ({"decode": "sample", "samples": 64}, 8, True),  # 512 nodes side by side
        ({"decode": "sample", "samples": 62}, 8, False),
        ({"decode": "sample", "samples": 64, "view": 3}, 8, False),
        ({"decode": "greedy"}, 8, False),
        ({"decode": "greedy", "precision": "bfloat16"}, 8, True),
        ({"decode": "sample", "samples": 64, "precision": "float32"}, 8, False),
    ],
)
@pytest.mark.parametrize("hardware", [True, False])
def test_bfloat16_is_for_hardware_and_sizes_that_gain(monkeypatch, kwargs, n_nodes, expected, hardware):
    seen = set()

    class Spy(DAN):
        def forward(self, *observation):
            seen.add(torch.is_autocast_enabled("cpu"))
            return super().forward(*observation)

    monkeypatch.setattr(heuristics, "multiplies_bfloat16", lambda device: hardware)
    instance = uniform(np.random.default_rng(0), n_nodes, 2)
    solve(instance, Spy(SMALL), device="cpu", **kwargs)
    assert seen == {expected and (hardware or "precision" in kwargs)}


def test_other_policies_keep_their_precision(monkeypatch):
    monkeypatch.setattr(heuristics, "multiplies_bfloat16", lambda device: True)

    def network(cities, agents, visited):
        assert not torch.is_autocast_enabled("cpu")
        return cities.sum(-1)

    solve(uniform(np.random.default_rng(0), 8, 2), network, decode="sample", samples=80, device="cpu")


def test_improvement_without_numba_names_the_extra_before_it_plans(network, monkeypatch):
    monkeypatch.delattr(mtsp_env, "reference", raising=False)
    for name in [name for name in sys.modules if name.startswith("mtsp_env.reference")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setattr(planning, "play", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'mtsp-env\[reference\]'"):
        solve(uniform(np.random.default_rng(0), 5, 2), network, improve=1.0)


def test_options_and_weights_that_do_not_exist_are_named(network):
    instance = uniform(np.random.default_rng(0), 5, 2)
    with pytest.raises(TypeError, match="sample"):
        solve(instance, network, sample=3)
    with pytest.raises(FileNotFoundError, match="no weights at nobody"):
        solve(instance, "nobody")


def test_keywords_replace_options(network):
    instance, options = uniform(np.random.default_rng(8), 12, 3), SolveOptions(decode="sample", samples=3, seed=5)
    plain = solve(instance, network, decode="sample", samples=3, seed=5)
    assert solve(instance, network, options).tours == plain.tours
    assert solve(instance, network, options, decode="greedy").method == "dan(g.)"
    assert options == SolveOptions(decode="sample", samples=3, seed=5)


@pytest.mark.parametrize(("decode", "clip"), [("sample", 12.0), ("greedy", 10.0)])
def test_a_sharper_clip_is_for_samples_alone(network, monkeypatch, decode, clip):
    clips = []
    forward = DAN.forward

    def watched(self, *args):
        clips.append(self.config.tanh_clip)
        return forward(self, *args)

    monkeypatch.setattr(DAN, "forward", watched)
    solve(uniform(np.random.default_rng(0), 60, 3), network, decode=decode, samples=2)
    assert set(clips) == {clip}
    assert network.config.tanh_clip == 10.0  # the given network stays as it is


@pytest.mark.parametrize(("n_nodes", "view", "seen"), [(399, None, 398), (420, None, 100), (60, 7, 7), (60, 90, 59)])
def test_large_instances_are_seen_in_part(monkeypatch, n_nodes, view, seen):
    """From n = 400 on the nearest 100 cities, or as many as the option says."""
    longest = []

    def watched(self, cities, *args, **kwargs):
        longest.append(cities.shape[1] - 1)
        return logits(self, cities, *args, **kwargs)

    logits = DAN._logits
    monkeypatch.setattr(DAN, "_logits", watched)
    torch.manual_seed(0)
    network = DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True))
    instance = uniform(np.random.default_rng(0), n_nodes, 3)
    solve(instance, network, device="cpu", precision="float32", view=view)
    assert max(longest) == seen and network.config.view is None


def test_a_view_is_for_networks_that_have_one(network):
    instance = uniform(np.random.default_rng(0), 10, 3)
    for policy in (make_actor(network), nearest, nn.Identity()):
        for option, field in (("view", "view"), ("clip", "tanh_clip"), ("prune_visited", "prune_visited")):
            with pytest.raises(ValueError, match=f"{option} needs a network whose config has the field '{field}'"):
                solve(instance, policy, **{option: 5})
    with pytest.raises(ValueError, match="with prune_visited"):
        solve(instance, DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2)), view=5)
    near = DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True, view=4))
    assert solve(instance, near, device="cpu").tours == solve(instance, near, device="cpu", view=4).tours


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
    """Sampling, augmentation and greedy games, shipped weights, networks, actors and functions, all at once."""
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
