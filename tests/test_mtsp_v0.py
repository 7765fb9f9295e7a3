"""The PettingZoo face: PettingZoo's own tests, and what a user of AEC environments and of TorchRL expects."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Callable
from importlib.util import find_spec
from itertools import combinations

import numpy as np
import pettingzoo
import pytest
import torch
from helpers.games import over, play, random_action
from pettingzoo.test import api_test, render_test, seed_test
from pettingzoo.test.state_test import test_state as check_state
from pettingzoo.test.state_test import test_state_space as check_state_space
from pettingzoo.utils import BaseWrapper

from mtsp_env import Instance, check_tours, makespan, mtsp_v0, uniform

GRID = [
    {"n_nodes": 2, "n_agents": 1, "speed": 0.1, "depot": "open"},
    {"n_nodes": 2, "n_agents": 5, "speed": 0.01, "depot": "final"},
    {"n_nodes": 12, "n_agents": 1, "speed": 0.01, "depot": "open"},
    {"n_nodes": 20, "n_agents": 3, "speed": 0.1, "depot": "final", "reward": "shaped"},
    {"n_nodes": 20, "n_agents": 3, "speed": 0.1, "depot": "open", "reward": "shaped"},
    {"n_nodes": 50, "n_agents": 5, "speed": 0.01, "depot": "open"},
    {"n_nodes": 30, "n_agents": 12, "speed": 0.01, "depot": "final", "distribution": "clustered"},
    {"n_nodes": 30, "n_agents": 4, "speed": 0.01, "depot": "open", "max_decisions": 9},
]
if find_spec("numba"):  # the extra reference
    GRID.append({"n_nodes": 7, "n_agents": 3, "speed": 0.1, "depot": "open", "reference": True})
on_grid = pytest.mark.parametrize(
    "settings", GRID, ids=lambda s: "-".join(map(str, (s["n_nodes"], s["n_agents"], s["speed"], s["depot"])))
)

# api_test warns of these if observations are a Dict, as in PettingZoo's chess and go, and the environment is not on its
# own list.
DICT_WARNINGS = {
    "Observation is not a NumPy array",
    "Observation space for each agent probably should be gymnasium.spaces.box or gymnasium.spaces.discrete",
}


def same(one: object, other: object) -> bool:
    """Whether two values are equal; arrays within them must be equal bit for bit and have the same dtype."""
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


class LegalActions(BaseWrapper):
    """Swaps an illegal action for the first legal one, for tests that sample without the mask."""

    def step(self, action: int | None) -> None:
        mask = self.observe(self.agent_selection)["action_mask"]
        super().step(action if action is None or mask[action] else int(np.argmax(mask)))


# PettingZoo's own tests


@on_grid
def test_pettingzoo_api(settings: dict, capsys: pytest.CaptureFixture) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        api_test(mtsp_v0.env(**settings), num_cycles=200)
        api_test(mtsp_v0.raw_env(**settings), num_cycles=200)
    assert {str(w.message) for w in caught} <= DICT_WARNINGS
    assert "Passed API test" in capsys.readouterr().out


@on_grid
def test_pettingzoo_seed(settings: dict) -> None:
    seed_test(lambda: mtsp_v0.env(**settings), num_cycles=100)


@pytest.mark.slow
@on_grid
def test_pettingzoo_state(settings: dict) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = LegalActions(mtsp_v0.env(**settings))
        check_state_space(env)
        check_state(env, num_cycles=50)
    assert env.state().shape == (3 * settings["n_nodes"] + 4 * settings["n_agents"],)
    assert env.state_space.contains(env.state())


@pytest.mark.slow
def test_pettingzoo_render(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MPLBACKEND", "Agg")
    pytest.importorskip("matplotlib").use("Agg")
    render_test(lambda render_mode: mtsp_v0.env(n_nodes=8, n_agents=2, render_mode=render_mode))


def test_pettingzoo_make_creates_the_environment() -> None:
    assert pettingzoo.make("aec", "mtsp/mtsp-v0", n_nodes=7, n_agents=2).unwrapped.n_nodes == 7


# Seeds, instances, copies


@on_grid
def test_a_seed_fixes_all_episodes_after_it(settings: dict) -> None:
    env, traces = mtsp_v0.env(**settings), []
    for _ in range(2):
        episodes = []
        for seed in (7, None, None):
            env.reset(seed=seed)
            episodes.append(play(env))
        traces.append(episodes)
        assert not any(same(*pair) for pair in combinations(episodes, 2))  # each has an instance of its own
    assert same(*traces)


@on_grid
def test_pickles_and_copies_play_the_same(settings: dict) -> None:
    for make in (mtsp_v0.env, mtsp_v0.raw_env):
        env = make(**settings)
        twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
        env.reset(seed=3)
        trace = play(env)
        for twin in twins:
            twin.reset(seed=3)
            assert same(play(twin), trace)
            assert same(twin.infos, env.infos)


def test_a_given_instance_is_played() -> None:
    env, instance = mtsp_v0.env(n_nodes=9, n_agents=3), uniform(np.random.default_rng(5), 9, 3)
    env.reset(seed=1, options={"instance": instance})
    assert env.unwrapped.instance is instance
    trace = play(env, seed=2)
    env.reset(seed=8, options={"instance": instance})
    assert same(play(env, seed=2), trace)
    check_tours(instance, env.unwrapped.tours)
    env.reset(seed=8)
    assert env.unwrapped.instance != instance
    for unknown in (1, {"instances": instance}, {"instance": instance, "nodes": instance.nodes}):
        with pytest.raises(ValueError, match="options must be a dict with the key 'instance' at most, got"):
            env.reset(options=unknown)


@pytest.mark.parametrize("size", [(8, 3), (9, 2)])
def test_an_instance_of_another_size_is_refused(size: tuple[int, int]) -> None:
    env = mtsp_v0.raw_env(n_nodes=9, n_agents=3)
    env.reset(seed=0)
    before = env.instance
    with pytest.raises(ValueError, match=rf"n_nodes={size[0]}, n_agents={size[1]}.*n_nodes=9, n_agents=3"):
        env.reset(seed=1, options={"instance": uniform(np.random.default_rng(5), *size)})
    assert env.instance is before
    env.reset()
    fresh = mtsp_v0.raw_env(n_nodes=9, n_agents=3)
    fresh.reset(seed=0)
    fresh.reset()
    assert env.instance == fresh.instance  # the refused call has not touched the random numbers


@pytest.mark.parametrize("instance", [{"nodes": 3}, "berlin52", np.zeros((9, 2))], ids=["dict", "str", "array"])
def test_other_types_than_instance_are_refused(instance: object) -> None:
    with pytest.raises(ValueError, match="Instance"):
        mtsp_v0.raw_env(n_nodes=9, n_agents=3).reset(options={"instance": instance})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_nodes": 1}, "n_nodes must be .* at least 2, got 1"),
        ({"n_agents": 0}, "n_agents must be .* at least 1, got 0"),
        ({"speed": -1.0}, "speed must be .*, got -1.0"),
        ({"depot": "shut"}, "unknown depot rule 'shut'"),
        ({"distribution": "normal"}, "unknown distribution 'normal'; choose from .*'uniform'"),
        ({"reference": 1000}, "reference must be True or False, got 1000"),
        ({"render_mode": "ansi"}, "unknown render_mode 'ansi'; choose from .*'human'"),
    ],
)
def test_bad_arguments(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        mtsp_v0.env(**change)


# Episodes


@on_grid
def test_every_agent_observes_within_its_space_at_any_time(settings: dict) -> None:
    env, rng = mtsp_v0.raw_env(**settings), np.random.default_rng(0)
    env.reset(seed=0)
    while True:
        for agent in env.possible_agents:
            seen, space = env.observe(agent), env.observation_space(agent)
            assert space.contains(seen)
            dtypes = {"cities": np.float32, "agents": np.float32, "visited": np.bool_, "agent": np.int64}
            assert {key: x.dtype for key, x in seen["observation"].items()} == dtypes
            assert seen["observation"]["agent"] == env.possible_agents.index(agent)
            assert seen["action_mask"].dtype == np.int8 and seen["action_mask"].any()
        for flags in (env.terminations, env.truncations):
            assert {type(flag) for flag in flags.values()} <= {bool}
        if not env.agents:
            break
        env.step(None if over(env) else random_action(env, rng))


@on_grid
def test_the_last_infos_hold_makespan_and_tours(settings: dict) -> None:
    env = mtsp_v0.env(**settings)
    env.reset(seed=4)
    returns = dict.fromkeys(env.agents, 0.0)
    for _, _, _, rewards in play(env):
        returns = {agent: total + rewards[agent] for agent, total in returns.items()}
        assert env.agents == env.possible_agents  # all end at once
    truncated = "max_decisions" in settings
    assert env.terminations == dict.fromkeys(env.agents, not truncated)
    assert env.truncations == dict.fromkeys(env.agents, truncated)
    for agent in env.agent_iter():
        info = env.last()[4]
        assert returns[agent] == pytest.approx(-info["makespan"], abs=1e-9)
        assert all(tour[0] == tour[-1] == 0 and len(tour) >= 2 for tour in env.unwrapped.tours)
        if not truncated:
            check_tours(env.unwrapped.instance, env.unwrapped.tours)
            assert info["makespan"] == pytest.approx(makespan(env.unwrapped.instance, env.unwrapped.tours), abs=1e-9)
        env.step(None)
    assert env.agents == []


def test_an_illegal_action_changes_nothing() -> None:
    env, rng = mtsp_v0.raw_env(n_nodes=8, n_agents=2, depot="final"), np.random.default_rng(0)
    env.reset(seed=0)
    while not over(env):
        agent, game, seen = env.agent_selection, env.game, env.observe(env.agent_selection)
        rewards, tours = dict(env.rewards), env.tours
        illegal = np.flatnonzero(seen["action_mask"] == 0).tolist()
        for action in [*illegal, -1, 8, 1.5, float("nan"), float("inf"), None, "depot", [1], np.array([1, 2])]:
            with pytest.raises(ValueError, match=rf"{agent} (may not go to|must pick a node .*in 0\.\.7, got)"):
                env.step(action)
        assert env.agent_selection == agent and env.game is game and same(env.observe(agent), seen)
        assert env.rewards == rewards and env.tours == tours
        env.step(random_action(env, rng))


def test_actions_are_checked_without_an_observation() -> None:
    env = mtsp_v0.raw_env(n_nodes=5, n_agents=1)
    for _ in range(2):
        env.reset(seed=0)
        env.step(1)
        with pytest.raises(ValueError, match="node 1: it is visited already"):
            env.step(1)
        env.step(2)
        with pytest.raises(ValueError, match="node 2: it is visited already"):
            env.step(2)
        env.observe("agent_0")
        env.step(3)
        with pytest.raises(ValueError, match="node 3: it is visited already"):
            env.step(3)


@pytest.mark.parametrize("kind", [int, np.int64, np.int32, np.array, torch.tensor], ids=lambda kind: kind.__name__)
def test_any_whole_number_is_an_action(kind: type) -> None:
    env = mtsp_v0.env(n_nodes=5, n_agents=1)
    env.reset(seed=0)
    env.step(kind(3))
    assert env.unwrapped.tours == [[0, 3]]


@pytest.mark.parametrize("depot", ["open", "final"])
def test_nearest_city_in_the_aec_loop(depot: str) -> None:
    env = mtsp_v0.env(n_nodes=50, n_agents=5, depot=depot)
    env.reset(seed=42)
    for _ in env.agent_iter():
        seen, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
            continue
        distance = np.hypot(*seen["observation"]["cities"].T)
        cities = np.where(seen["action_mask"][1:], distance[1:], np.inf)
        env.step(1 + int(np.argmin(cities)))
    assert terminated
    check_tours(env.unwrapped.instance, env.unwrapped.tours)


# As a TorchRL environment


@pytest.mark.parametrize(("depot", "reward"), [("open", "sparse"), ("final", "shaped")])
@pytest.mark.parametrize("max_decisions", [None, 11])
def test_torchrl_wraps_it(depot: str, reward: str, max_decisions: int | None) -> None:
    """PettingZooWrapper with all agents in one group shows each decision as the raw environment does."""
    from torchrl.envs import MarlGroupMapType
    from torchrl.envs.libs.pettingzoo import PettingZooWrapper

    kwargs = {"n_nodes": 10, "n_agents": 3, "depot": depot, "reward": reward, "max_decisions": max_decisions}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested using version")
        wrapped = PettingZooWrapper(mtsp_v0.env(**kwargs), use_mask=True, group_map=MarlGroupMapType.ALL_IN_ONE_GROUP)
    raw, group, rng = mtsp_v0.raw_env(**kwargs), "agents", np.random.default_rng(0)
    td = wrapped.reset()
    raw.reset(options={"instance": Instance(wrapped._env.unwrapped.instance.nodes, 3)})
    while not over(raw):
        acting = raw.possible_agents.index(raw.agent_selection)
        check_torchrl_observation(td[group], raw, acting)
        action = random_action(raw, rng)
        raw.step(action)
        td[group, "action"] = torch.full((3,), action)
        td = wrapped.step(td)["next"]
        assert td[group, "reward"].tolist() == [[np.float32(raw.rewards[a])] for a in raw.possible_agents]
        assert td["done"].item() == over(raw)
        assert td["terminated"].item() == all(raw.terminations.values())
        assert td["truncated"].item() == all(raw.truncations.values())
    check_torchrl_observation(td[group], raw, None)


def check_torchrl_observation(td: object, raw: mtsp_v0.raw_env, acting: int | None) -> None:
    for i, agent in enumerate(raw.possible_agents):
        seen = raw.observe(agent)
        for key, value in seen["observation"].items():
            value = (
                np.eye(len(raw.possible_agents), dtype=int)[value] if key == "agent" else value
            )  # one-hot in TorchRL
            assert np.array_equal(td["observation", "observation", key][i].numpy(), value)
        if acting is not None:
            assert bool(td["mask"][i]) == (i == acting)
        if i == acting:
            assert td["action_mask"][i].tolist() == seen["action_mask"].astype(bool).tolist()


# Copies


def trace_of(env: pettingzoo.AECEnv) -> list[tuple]:
    """All observations and rewards until the episode ends, and the next instance; actions depend on observations."""
    trace = []
    while not over(env):
        agent, seen = env.agent_selection, env.observe(env.agent_selection)
        legal = np.flatnonzero(seen["action_mask"])
        env.step(int(legal[7 * len(legal) // 10]))
        trace.append((agent, seen, dict(env.rewards), env.unwrapped.tours, dict(env.infos)))
    env.reset()
    return [*trace, env.unwrapped.instance]


@pytest.mark.parametrize(
    "copy_of", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
)
@pytest.mark.parametrize("make", [mtsp_v0.env, mtsp_v0.raw_env])
@pytest.mark.parametrize("reward", ["sparse", "shaped"])
def test_a_copy_of_a_running_game_continues_as_the_game_does(make: Callable, copy_of: Callable, reward: str) -> None:
    env = make(n_nodes=8, n_agents=3, reward=reward)
    env.reset(seed=3)
    trace, copies = trace_of(copy_of(env)), []
    for agent, seen, *_ in trace[:-1]:
        copies.append(copy_of(env))
        assert env.agent_selection == agent and same(env.observe(agent), seen)
        legal = np.flatnonzero(seen["action_mask"])
        env.step(int(legal[7 * len(legal) // 10]))
    assert over(env) and len(copies) >= 7
    for passed, twin in enumerate(copies):
        assert same(trace_of(twin), trace[passed:])  # no copy has changed another


def test_agents_are_counted_before_the_first_reset() -> None:
    for env in (mtsp_v0.env(n_agents=4), mtsp_v0.raw_env(n_agents=4)):
        assert env.num_agents == env.max_num_agents == 4


def test_tours_are_in_the_infos_on_request() -> None:
    for info_tours in (False, True):
        env = mtsp_v0.env(n_nodes=6, n_agents=2, info_tours=info_tours)
        env.reset(seed=0)
        play(env)
        info = env.infos["agent_0"]
        assert info.get("tours", env.unwrapped.tours) == env.unwrapped.tours
        assert set(info) == {"makespan", "tours"} if info_tours else {"makespan"}


def test_a_distribution_may_be_a_function() -> None:
    def square(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict:
        return {"nodes": np.tile([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]], (batch, 1, 1))}

    env = mtsp_v0.env(n_nodes=4, n_agents=2, distribution=square)
    env.reset(seed=0)
    assert env.unwrapped.instance.nodes[2].tolist() == [1.0, 1.0] and env.unwrapped.instance.name == "square"
