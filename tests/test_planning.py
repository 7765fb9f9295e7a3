"""Plans: tours always solve the instance, whatever the options; bad options are named before anything is planned."""

import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

import mtsp_env
from benchmarks.policies.nearest import nearest
from dan_policy import DAN, DANConfig, JointConfig, JointDAN, SolveOptions, heuristics, make_actor, planning, solve
from mtsp_env import Instance, check_tours, makespan, uniform

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


@pytest.mark.slow
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


@pytest.mark.slow
def test_more_samples_are_never_worse_than_the_first_of_them(network):
    instance = uniform(np.random.default_rng(2), 15, 3)
    costs = [solve(instance, network, decode="sample", samples=64, seed=seed).makespan for seed in range(3)]
    singles = [solve(instance, network, decode="sample", samples=1, seed=seed).makespan for seed in range(8)]
    assert max(costs) < np.mean(singles)


@pytest.mark.slow
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


@pytest.mark.slow
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
@pytest.mark.slow
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


def test_a_confident_network_looks_less_often_and_its_own_config_says_how_often(monkeypatch):
    looks = []
    forward_next, forward = JointDAN.forward_next, JointDAN.forward
    monkeypatch.setattr(JointDAN, "forward_next", lambda self, *seen: looks.append(1) or forward_next(self, *seen))
    monkeypatch.setattr(JointDAN, "forward", lambda self, *seen: looks.append(1) or forward(self, *seen))
    torch.manual_seed(0)
    network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=16, n_heads=2, n_layers=1))
    instance = uniform(np.random.default_rng(0), 15, 3)

    def tours_and_looks(policy, **options):
        looks.clear()
        return solve(instance, policy, device="cpu", precision="float32", **options).tours, len(looks)

    tours, every_decision = tours_and_looks(network)
    assert tours_and_looks(network, confidence=1.0) == (tours, every_decision)
    hasty = tours_and_looks(network, confidence=1e-6)
    assert hasty[1] < every_decision
    network.config = replace(network.config, confidence=1e-6)
    assert tours_and_looks(network) == hasty
    assert tours_and_looks(network, confidence=1.0) == (tours, every_decision)
    with pytest.raises(ValueError, match=r"confidence must be None, or above 0 and at most 1, got 1\.5"):
        solve(instance, network, confidence=1.5)
    with pytest.raises(ValueError, match="confidence needs a network whose config has the field 'confidence'"):
        solve(instance, nearest, confidence=0.9)


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
