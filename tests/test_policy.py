"""Actors, episodes and plans: any network plugs in, whole episodes come out, tours always solve the instance."""

import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import ExplorationType, set_exploration_type

import mtsp_env
from benchmarks.policies.nearest import nearest
from dan_policy import DAN, DANConfig, make_actor, rollout, single, solution, solve
from mtsp_env import Instance, check_tours, makespan, mtsp_v0, uniform
from mtsp_env.batched import BatchedMTSP

SMALL = DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True)


@pytest.fixture(scope="module")
def network():
    torch.manual_seed(0)
    return DAN(SMALL).eval()


def test_visited_cities_get_probability_zero(network):
    env = BatchedMTSP(12, 3, [8], seed=0)
    actor, td = make_actor(network), env.reset()
    for _ in range(6):
        probability = actor.get_dist(td).probs
        assert (probability[~td["action_mask"]] == 0).all()
        assert torch.allclose(probability.sum(-1), torch.ones(8), atol=1e-6)
        td = env.step(actor(td))["next"]


def test_greedy_takes_the_likeliest_and_sampling_follows_the_softmax():
    logits = torch.tensor([0.0, 2.0, 1.0, 9.0])
    actor = make_actor(lambda cities, agents, visited: logits.expand(cities.shape[:-1]))
    td = TensorDict(
        {
            "cities": torch.zeros(20_000, 4, 2),
            "agents": torch.zeros(20_000, 1, 3),
            "visited": torch.zeros(20_000, 4, dtype=torch.bool),
            "action_mask": torch.tensor([True, True, True, False]).expand(20_000, 4),
        },
        batch_size=[20_000],
    )
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert (actor(td.clone())["action"] == 1).all()
    torch.manual_seed(0)
    drawn = torch.bincount(actor(td)["action"], minlength=4) / 20_000
    assert torch.allclose(drawn, torch.cat([logits[:3].softmax(0), torch.zeros(1)]), atol=0.02)


@pytest.mark.parametrize("depot", ["open", "final"])
def test_an_episode_holds_each_decision_once_and_nothing_after_its_end(network, depot):
    env = BatchedMTSP(9, 3, [16], speed=0.1, depot=depot, seed=0)
    torch.manual_seed(0)
    episode = rollout(make_actor(network), env, "sample", keep=("visited", "action_mask"))
    steps, batch = episode.valid.shape
    assert episode.decisions.shape == (steps, batch)
    assert episode.valid[0].all() and episode.valid[-1].any()
    assert (episode.valid[:-1] | ~episode.valid[1:]).all()  # once over, always over
    legal = episode.decisions["action_mask"].gather(2, episode.decisions["action"][..., None])[..., 0]
    assert legal[episode.valid].all()
    cities_taken = ((episode.decisions["action"] > 0) & episode.valid).sum(0)
    assert (cities_taken == 8).all()
    assert torch.allclose(episode.reward.double(), -env.makespan(episode.last), rtol=1e-6)


def test_rollout_agrees_with_the_pettingzoo_environment(network):
    """The same network, greedily, agent by agent in the AEC loop."""
    instance = uniform(np.random.default_rng(0), 10, 3)
    env = mtsp_v0.env(n_nodes=10, n_agents=3)
    env.reset(options={"instance": instance})
    for _ in env.agent_iter():
        seen, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            break
        cities, agents, visited = (
            torch.as_tensor(seen["observation"][k])[None] for k in ("cities", "agents", "visited")
        )
        logits = network(cities, agents, visited.bool())[0]
        env.step(int(logits.masked_fill(~torch.as_tensor(seen["action_mask"]).bool(), float("-inf")).argmax()))
    batched = BatchedMTSP(10, 3, [1])
    episode = rollout(make_actor(network), batched, "greedy", torch.as_tensor(instance.nodes.copy())[None])
    assert batched.tours(episode.last)[0] == env.unwrapped.tours


@settings(max_examples=30, deadline=None)
@given(
    st.integers(2, 12), st.integers(1, 15), st.integers(0, 2**31), st.sampled_from(["greedy", "sample"]), st.booleans()
)
def test_a_plan_always_solves_the_instance(n_nodes, n_agents, seed, decode, coincide):
    torch.manual_seed(seed)
    nodes = np.random.default_rng(seed).random((n_nodes, 2))
    instance = Instance(np.full_like(nodes, 0.5) if coincide else nodes, n_agents)
    solution = solve(instance, DAN(SMALL), decode, samples=3, seed=seed)
    check_tours(instance, solution.tours)
    assert solution.makespan == makespan(instance, solution.tours)
    assert solution.seconds > 0


def test_seeded_plans_repeat_and_leave_the_global_generator_alone(network):
    instance = uniform(np.random.default_rng(1), 15, 3)
    before = torch.get_rng_state()
    first, again, other = (solve(instance, network, "sample", samples=4, seed=s) for s in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert first.tours == again.tours and first.tours != other.tours
    assert (first.method, solve(instance, network).method) == ("dan(s.4)", "dan(g.)")


def test_more_samples_are_never_worse_than_the_first_of_them(network):
    instance = uniform(np.random.default_rng(2), 15, 3)
    costs = [solve(instance, network, "sample", samples=64, seed=seed).makespan for seed in range(3)]
    singles = [solve(instance, network, "sample", samples=1, seed=seed).makespan for seed in range(8)]
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

    drawn = solve(instance, make_actor(uniform_logits, ["cities", "visited"]), "sample", samples=11, augment=True)
    assert drawn.method == "dan(s.11x8)"
    views = {tuple(view.flatten().tolist()) for view in seen[0].round(decimals=5)}
    assert len(seen[0]) == 11 and len(views) == 8


def test_any_actor_can_plan():
    instance = uniform(np.random.default_rng(3), 20, 4)
    solution = solve(instance, make_actor(nearest))
    check_tours(instance, solution.tours)


def test_nearest_goes_to_the_nearest_in_both_faces():
    """The plug-in of the README: a plain function as an actor, and the same rule in the AEC loop."""
    instance = uniform(np.random.default_rng(4), 25, 3)
    env = mtsp_v0.env(n_nodes=25, n_agents=3)
    env.reset(options={"instance": instance})
    for _ in env.agent_iter():
        seen, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            break
        distance = np.linalg.norm(seen["observation"]["cities"], axis=1)
        distance[(seen["action_mask"] == 0) | (np.arange(25) == 0)] = np.inf
        env.step(int(distance.argmin()))
    batched = BatchedMTSP(25, 3, [1])
    episode = rollout(make_actor(nearest), batched, "greedy", torch.as_tensor(instance.nodes.copy())[None])
    assert batched.tours(episode.last)[0] == env.unwrapped.tours
    check_tours(instance, env.unwrapped.tours)


# Improvement


@pytest.mark.parametrize(
    ("decode", "name"), [("greedy", "dan(g.)+improve(0.05 s)"), ("sample", "dan(s.3)+improve(0.05 s)")]
)
def test_improved_plans_are_shorter_and_take_their_time(network, decode, name):
    pytest.importorskip("numba", reason="needs the extra reference")
    instance = uniform(np.random.default_rng(5), 40, 1)  # one agent: no search ends early at the farthest city
    for policy in (network, make_actor(nearest)):
        plain = solve(instance, policy, decode, samples=3)
        improved = solve(instance, policy, decode, samples=3, improve=0.05)
        check_tours(instance, improved.tours)
        assert improved.makespan == makespan(instance, improved.tours) < plain.makespan
        assert improved.method == name
        assert improved.seconds >= 0.05


def test_the_policys_tours_are_what_is_improved(network, monkeypatch):
    reference = pytest.importorskip("mtsp_env.reference", reason="needs the extra reference")
    instance, calls = uniform(np.random.default_rng(6), 12, 3), []
    monkeypatch.setattr(reference, "improve", lambda *args, **options: calls.append((args, options)) or args[1])
    plain, improved = (solve(instance, network, "sample", 4, seed=9, improve=seconds) for seconds in (None, 2.5))
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
        ({"precision": "float16"}, "unknown precision 'float16'; choose from \\['auto', 'float32', 'bfloat16'\\]"),
        ({"improve": 1.0, "seed": -1}, "seed must be a whole number of at least 0, got -1"),
    ],
)
def test_what_cannot_be_improved_is_not_planned(network, monkeypatch, kwargs, message):
    pytest.importorskip("numba", reason="needs the extra reference")
    monkeypatch.setattr(solution, "rollout", None)  # calling it would be a TypeError
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

    monkeypatch.setattr(solution, "_multiplies_bfloat16", lambda device: hardware)
    instance = uniform(np.random.default_rng(0), n_nodes, 2)
    solve(instance, Spy(SMALL), device="cpu", **kwargs)
    assert seen == {expected and (hardware or "precision" in kwargs)}


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [
        ({"amx_bf16": True}, True),
        ({"avx512_bf16": True}, True),
        ({"amx_bf16": False, "avx512_f": True}, False),
        ({}, False),
    ],
)
def test_matrix_units_are_what_the_cpu_says(monkeypatch, capabilities, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    asked = solution._multiplies_bfloat16.__wrapped__  # what it said of this machine stays cached
    assert asked(torch.device("cpu")) is expected
    monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert asked(torch.device("cpu")) is False  # an older torch does not say


def test_other_policies_keep_their_precision(monkeypatch):
    monkeypatch.setattr(solution, "_multiplies_bfloat16", lambda device: True)

    def network(cities, agents, visited):
        assert not torch.is_autocast_enabled("cpu")
        return cities.sum(-1)

    solve(uniform(np.random.default_rng(0), 8, 2), make_actor(network), "sample", samples=80, device="cpu")


def test_improvement_without_numba_names_the_extra_before_it_plans(network, monkeypatch):
    for name in ("reference", "_sisr"):
        monkeypatch.delattr(mtsp_env, name, raising=False)
        monkeypatch.delitem(sys.modules, f"mtsp_env.{name}", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.setattr(solution, "rollout", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'mtsp-env\[reference\]'"):
        solve(uniform(np.random.default_rng(0), 5, 2), network, improve=1.0)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"decode": "beam"}, "unknown decode 'beam'"),
        ({"samples": 0}, "samples must be a whole number of at least 1, got 0"),
    ],
)
def test_bad_arguments_are_named(network, kwargs, message):
    with pytest.raises(ValueError, match=message):
        solve(uniform(np.random.default_rng(0), 5, 2), network, **kwargs)
    with pytest.raises(FileNotFoundError, match="no weights at nobody"):
        solve(uniform(np.random.default_rng(0), 5, 2), "nobody")


def test_torchrls_collector_gathers_whole_episodes(network):
    """Each batch starts from resets and is as long as the cap of the rule "final", n - 1 + m decisions."""
    cap = 8 - 1 + 3
    collector = Collector(
        BatchedMTSP(8, 3, [4], depot="final", seed=0),
        make_actor(network),
        frames_per_batch=4 * cap,
        total_frames=2 * 4 * cap,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 2
    for batch in batches:
        assert batch.shape == (4, cap)
        assert (batch["game", "decisions"][:, 0] == 0).all() and batch["next", "done"].any(1).all()
        assert batch["action_mask"].gather(2, batch["action"][..., None]).all()


def test_samples_are_sharper_the_longer_the_game():
    """Sec. 6.1: C = 10, and 100 from n = 500 on; between them, in proportion."""
    assert [solution.sample_clip(10.0, n) for n in (2, 50, 100, 200, 500, 5000)] == [10, 10, 20, 40, 100, 100]
    assert [solution.sample_clip(200.0, n) for n in (20, 1000)] == [200.0, 200.0]  # never flatter than it was trained
    assert solution.sample_clip(5.0, 100) == 10.0
    assert [solution.sample_clip(10.0, n, augment=True) for n in (10, 50, 100, 400)] == [10, 30, 60, 100]


@pytest.mark.parametrize(("decode", "clip"), [("sample", 12.0), ("greedy", 10.0)])
def test_a_sharper_clip_is_for_samples_alone(network, monkeypatch, decode, clip):
    clips = []
    forward = DAN.forward

    def watched(self, *args):
        clips.append(self.config.tanh_clip)
        return forward(self, *args)

    monkeypatch.setattr(DAN, "forward", watched)
    monkeypatch.setattr(single, "can_play", lambda *_: False)
    solve(uniform(np.random.default_rng(0), 60, 3), network, decode, samples=2)
    assert set(clips) == {clip}
    assert network.config.tanh_clip == 10.0  # the given network stays as it is


@pytest.mark.parametrize(("n_nodes", "told", "seen"), [(399, None, 398), (420, None, 100), (60, 7, 7), (60, 90, 59)])
@pytest.mark.parametrize("alone", [True, False])
def test_large_instances_are_seen_in_part(monkeypatch, n_nodes, told, seen, alone):
    """From n = 400 on the nearest 100 cities, or as many as one is told; each decision's observation is cut alike."""
    longest = []

    def watched(self, cities, *args, **kwargs):
        longest.append(cities.shape[1] - 1)
        return logits(self, cities, *args, **kwargs)

    def watched_alone(*args):
        kept = in_view(*args)
        longest.append(len(kept) - 1)
        return kept

    logits, in_view = DAN._logits, single._in_view
    monkeypatch.setattr(DAN, "_logits", watched)
    monkeypatch.setattr(single, "_in_view", watched_alone)
    if not alone:
        monkeypatch.setattr(single, "can_play", lambda *_: False)
    torch.manual_seed(0)
    network = DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True))
    instance = uniform(np.random.default_rng(0), n_nodes, 3)
    solve(instance, network, device="cpu", precision="float32", view=told)
    assert max(longest) == seen and network.config.view is None


def test_a_view_is_for_a_dan_that_forgets_visited_cities(network):
    instance = uniform(np.random.default_rng(0), 10, 3)
    with pytest.raises(ValueError, match="view must be a whole number of at least 1, got 0"):
        solve(instance, view=0)
    with pytest.raises(ValueError, match="view must be None for a policy that is no DAN, got 5"):
        solve(instance, make_actor(network), view=5)
    with pytest.raises(ValueError, match="with prune_visited"):
        solve(instance, DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2)), view=5)
    told = DAN(DANConfig(embed_dim=16, feedforward_dim=16, n_heads=2, prune_visited=True, view=4))
    assert solve(instance, told, device="cpu").tours == solve(instance, told, device="cpu", view=4).tours
