"""Flat observations: PettingZoo's own tests, nothing lost, and the mask where it was asked for."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from helpers.games import over
from pettingzoo import AECEnv
from pettingzoo.test import api_test, seed_test

from mtsp_env import mtsp_v0
from mtsp_env.wrappers import flatten

SETTINGS = [
    {"n_nodes": 12, "n_agents": 3, "depot": "open"},
    {"n_nodes": 9, "n_agents": 1, "depot": "final", "reward": "shaped"},
    {"n_nodes": 30, "n_agents": 4, "max_decisions": 9},
]
PLACES: list[dict[str, Any]] = [
    {},
    {"observation_key": "observations"},
    {"mask_key": "mask", "mask_in_infos": True},
    {"mask_key": None, "mask_in_infos": True},
]
on_settings = pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: f"{s['n_nodes']}-{s['n_agents']}")
on_places = pytest.mark.parametrize("places", PLACES, ids=str)


def mask_of(env: AECEnv) -> np.ndarray:
    return env.unwrapped.observe(env.agent_selection)["action_mask"]


@on_settings
@pytest.mark.parametrize("places", [{}, {"mask_key": None, "mask_in_infos": True}], ids=str)
def test_pettingzoo_api(settings: dict, places: dict, capsys: pytest.CaptureFixture) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        api_test(flatten(mtsp_v0.env(**settings), **places), num_cycles=200)
    dict_warnings = {
        "Observation is not a NumPy array",
        "Observation space for each agent probably should be gymnasium.spaces.box or gymnasium.spaces.discrete",
    }
    assert {str(w.message) for w in caught} <= (dict_warnings if places == {} else set())
    assert "Passed API test" in capsys.readouterr().out


def test_pettingzoo_seed() -> None:
    seed_test(lambda: flatten(mtsp_v0.env(n_nodes=10, n_agents=3)), num_cycles=100)


@on_settings
@on_places
def test_every_observation_is_the_nested_one_and_lies_in_its_space(settings: dict, places: dict) -> None:
    env, rng = flatten(mtsp_v0.env(**settings), **places), np.random.default_rng(0)
    raw = env.unwrapped
    env.reset(seed=1)
    n, m = settings["n_nodes"], settings["n_agents"]
    while not over(env):
        for agent in env.agents:
            seen, nested = env.observe(agent), raw.observe(agent)
            assert env.observation_space(agent).contains(seen)
            mask_key, vector_key = places.get("mask_key", "action_mask"), places.get("observation_key", "observation")
            vector = seen if mask_key is None else seen[vector_key]
            assert (vector.dtype, vector.shape) == (np.float32, (3 * n + 4 * m,))
            back = spaces.unflatten(raw.observation_space(agent)["observation"], vector)
            assert back.keys() == nested["observation"].keys()
            assert all(np.array_equal(back[key], value) for key, value in nested["observation"].items())
            if mask_key is not None:
                assert seen.keys() == {vector_key, mask_key}
                assert np.array_equal(seen[mask_key], nested["action_mask"])
            info = env.infos[agent]
            if places.get("mask_in_infos"):
                assert np.array_equal(info["action_mask"], nested["action_mask"])
            else:
                assert "action_mask" not in info
        env.step(int(rng.choice(np.flatnonzero(mask_of(env)))))


def test_last_returns_what_the_selected_agent_sees() -> None:
    env = flatten(mtsp_v0.env(n_nodes=8, n_agents=2), mask_key=None, mask_in_infos=True)
    env.reset(seed=0)
    for _ in env.agent_iter():
        seen, reward, terminated, truncated, info = env.last()
        assert np.array_equal(seen, env.observe(env.agent_selection))
        assert np.array_equal(info["action_mask"], mask_of(env))
        assert env.last(observe=False)[0] is None
        if terminated or truncated:
            assert reward == -info["makespan"]
            env.step(None)
        else:
            env.step(int(np.argmax(info["action_mask"])))
    assert env.agents == []


def test_the_environments_own_infos_stay_as_they_are() -> None:
    env = flatten(mtsp_v0.env(n_nodes=8, n_agents=2), mask_in_infos=True)
    env.reset(seed=0)
    assert env.infos["agent_0"].keys() == {"action_mask"}
    assert env.unwrapped.infos == {"agent_0": {}, "agent_1": {}}


@pytest.mark.parametrize(
    ("places", "message"),
    [
        ({"mask_key": None}, "mask_key=None needs mask_in_infos=True"),
        ({"mask_key": "observation"}, "must differ, got 'observation' for both"),
    ],
)
def test_a_mask_without_a_place_is_refused(places: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        flatten(mtsp_v0.env(n_nodes=8, n_agents=2), **places)


def test_other_environments_are_refused() -> None:
    flat = flatten(mtsp_v0.env(n_nodes=8, n_agents=2), mask_key=None, mask_in_infos=True)
    with pytest.raises(ValueError, match=r"expected the observations of mtsp_v0\.env, got Box"):
        flatten(flat)
