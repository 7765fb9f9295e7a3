"""The Gymnasium view: Gymnasium's own checker, the same games as the AEC environment's, vector environments."""

from __future__ import annotations

import copy
import subprocess
import sys
import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mtsp_env  # noqa: F401  registers the environment
from mtsp_env import check_tours, mtsp_v0, uniform
from mtsp_env.single import ID, MinMaxMTSP

SETTINGS: list[dict[str, Any]] = [
    {"n_nodes": 12, "n_agents": 3},
    {"n_nodes": 9, "n_agents": 2, "depot": "final", "reward": "shaped"},
    {"n_nodes": 2, "n_agents": 5, "speed": 0.1},
    {"n_nodes": 30, "n_agents": 4, "max_decisions": 9},
    {"n_nodes": 12, "n_agents": 4, "scenario": "service"},
]
on_settings = pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: f"{s['n_nodes']}-{s['n_agents']}")


class LegalMinMaxMTSP(MinMaxMTSP):
    """Swaps an illegal action for the first legal one: Gymnasium's checker samples without a mask."""

    def step(self, action: int) -> tuple:
        mask = self.action_masks()
        return super().step(action if mask[action] else int(np.argmax(mask)))


@on_settings
@pytest.mark.slow
def test_gymnasiums_checker_passes_if_actions_are_legal(settings: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib", reason="the checker renders")
    specification = gymnasium.envs.registration.EnvSpec("LegalMinMaxMTSP-v0", entry_point=LegalMinMaxMTSP)
    monkeypatch.setitem(gymnasium.registry, specification.id, specification)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        if "scenario" in settings:  # times have no greatest value
            warnings.filterwarnings("ignore", ".*maximum value is infinity")
        check_env(gymnasium.make(specification.id, **settings).unwrapped)


def test_gymnasiums_checker_samples_illegal_actions_without_help() -> None:
    """The one thing that does not pass: a sample from the action space may be illegal, which is an error."""
    env = MinMaxMTSP(n_nodes=2, n_agents=1)  # one of two actions is illegal at each decision
    env.action_space.seed(0)
    with pytest.raises(ValueError, match="may not go to node 0: it is not open to it now; see action_mask"):
        for _ in range(20):
            check_env(env, skip_render_check=True)


@on_settings
def test_it_plays_the_games_of_the_aec_environment(settings: dict) -> None:
    env, aec, rng = gymnasium.make(ID, **settings), mtsp_v0.env(**settings), np.random.default_rng(0)
    for seed in (3, None, None):
        seen, info = env.reset(seed=seed)
        aec.reset(seed=seed)
        over, total = False, 0.0
        while not over:
            agent = aec.agent_selection
            truth = aec.observe(agent)
            assert seen.keys() == truth["observation"].keys()
            assert all(np.array_equal(seen[key], value) for key, value in truth["observation"].items())
            assert seen["agent"] == aec.possible_agents.index(agent)
            assert np.array_equal(info["action_mask"], truth["action_mask"])
            masks = env.get_wrapper_attr("action_masks")()
            assert masks.dtype == bool and np.array_equal(masks, truth["action_mask"])
            action = int(rng.choice(np.flatnonzero(masks)))
            seen, reward, terminated, truncated, info = env.step(action)
            aec.step(action)
            assert reward == aec.rewards[agent]
            assert (terminated, truncated) == (aec.terminations[agent], aec.truncations[agent])
            over, total = terminated or truncated, total + reward
        assert total == pytest.approx(-info["makespan"])
        if terminated:
            check_tours(env.unwrapped.aec.instance, env.unwrapped.aec.tours)


def test_a_given_instance_is_played() -> None:
    env, instance = gymnasium.make(ID, n_nodes=9, n_agents=2), uniform(np.random.default_rng(0), 9, 2)
    env.reset(options={"instance": instance})
    assert env.unwrapped.aec.instance is instance


def test_observations_are_the_callers_own() -> None:
    env = MinMaxMTSP(n_nodes=8, n_agents=2)
    seen, info = env.reset(seed=0)
    before = copy.deepcopy(env.aec.observe("agent_0"))
    for array in (seen["visited"], seen["cities"], seen["agents"], info["action_mask"]):
        array[...] = 1
    after = env.aec.observe("agent_0")
    assert np.array_equal(before["action_mask"], after["action_mask"])
    assert all(np.array_equal(value, after["observation"][key]) for key, value in before["observation"].items())


def test_an_illegal_action_changes_nothing() -> None:
    env = MinMaxMTSP(n_nodes=8, n_agents=2)
    env.reset(seed=0)
    env.step(3)
    game = env.aec.game
    for action in (3, 8, -1, 1.5):
        with pytest.raises(ValueError, match=r"agent_1 (may not go to|must pick a node)"):
            env.step(action)
    assert env.aec.game is game


@pytest.mark.parametrize("mode", ["sync", pytest.param("async", marks=pytest.mark.slow)])
def test_vector_environments(mode: str) -> None:
    """Each of the games is the one that a single environment with its seed plays; a finished one starts again."""
    envs = gymnasium.make_vec(ID, num_envs=3, vectorization_mode=mode, n_nodes=8, n_agents=2)
    singles = [MinMaxMTSP(n_nodes=8, n_agents=2) for _ in range(3)]
    rng, finished = np.random.default_rng(0), np.zeros(3, bool)
    seen, info = envs.reset(seed=5)
    truths = [env.reset(seed=5 + i) for i, env in enumerate(singles)]
    episodes = 0
    try:
        for _ in range(40):
            for i, (observation, single_info) in enumerate(truths):
                assert all(np.array_equal(seen[key][i], value) for key, value in observation.items())
                assert np.array_equal(info["action_mask"][i], single_info["action_mask"])
            actions = np.array([rng.choice(np.flatnonzero(mask)) for mask in info["action_mask"]])
            seen, rewards, terminated, truncated, info = envs.step(actions)
            for i, env in enumerate(singles):
                if finished[i]:  # Gymnasium resets a finished game with the step after, whatever the action
                    truths[i], finished[i] = env.reset(), False
                    episodes += 1
                    continue
                observation, reward, *over, single_info = env.step(int(actions[i]))
                truths[i], finished[i] = (observation, single_info), any(over)
                assert rewards[i] == reward and [terminated[i], truncated[i]] == over
    finally:
        envs.close()
    assert episodes >= 3


def test_flat_observations() -> None:
    env = gymnasium.wrappers.FlattenObservation(gymnasium.make(ID, n_nodes=8, n_agents=2))
    seen, _ = env.reset(seed=0)
    assert seen.shape == (3 * 8 + 4 * 2,)
    assert env.observation_space.contains(seen)


def test_rendering() -> None:
    pytest.importorskip("matplotlib", reason="needs the extra render")
    env = gymnasium.make(ID, n_nodes=8, n_agents=2, render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (600, 800, 3)
    env.close()


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"n_nodes": 1}, "n_nodes must be"), ({"render_mode": "ansi"}, "unknown render_mode 'ansi'")],
)
def test_bad_arguments(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MinMaxMTSP(**settings)


@pytest.mark.slow
def test_registration_imports_the_view_only_when_it_is_made() -> None:
    code = f"""
import sys, mtsp_env, gymnasium
gymnasium.spec({ID!r})
assert "mtsp_env.single" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
