"""The PettingZoo environment in every scenario: PettingZoo's own tests, spaces, copies, instances of other worlds."""

from __future__ import annotations

import copy
import pickle
import warnings

import numpy as np
import pytest
from helpers.future import long_everything, long_traffic, other_future
from helpers.games import over, play, random_action
from pettingzoo.test import api_test, seed_test
from pettingzoo.test.state_test import test_state as check_state
from pettingzoo.test.state_test import test_state_space as check_state_space
from pettingzoo.utils import BaseWrapper

from mtsp_env import SCENARIOS, Instance, check_log, mtsp_v0

SIZE = {"n_nodes": 9, "n_agents": 3, "speed": 0.1}
EXTRA = {
    "plain": set(),
    "arrivals": {"city_known"},
    "breakdowns": {"agent_alive"},
    "traffic": set(),
    "team": {"agent_speeds"},
    "service": {"service"},
    "everything": {"agent_speeds", "agent_alive", "service", "city_known"},
}
OPTIONS = [{}, {"view": 2}, {"hearing": 0.3}, {"view": 3, "hearing": 0.5, "distribution": "clustered"}]
in_every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


class LegalActions(BaseWrapper):
    """Swaps an illegal action for the first legal one, for tests that sample without the mask."""

    def step(self, action: int | None) -> None:
        mask = self.observe(self.agent_selection)["action_mask"]
        super().step(action if action is None or mask[action] else int(np.argmax(mask)))


@in_every_scenario
@pytest.mark.parametrize("depot", ["open", "wait"])
def test_pettingzoos_own_tests(scenario: str, depot: str) -> None:
    settings = {**SIZE, "scenario": scenario, "depot": depot}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of observations that are a Dict
        api_test(mtsp_v0.env(**settings), num_cycles=200)
        api_test(mtsp_v0.env(**settings, view=3, hearing=0.4), num_cycles=200)
    seed_test(lambda: mtsp_v0.env(**settings), num_cycles=100)
    env = LegalActions(mtsp_v0.env(**settings))
    check_state_space(env)
    check_state(env, num_cycles=50)
    assert env.state_space.contains(env.state())


@in_every_scenario
@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_every_agent_observes_within_its_space_at_any_time(scenario: str, options: dict) -> None:
    env, rng = mtsp_v0.raw_env(**SIZE, scenario=scenario, **options), np.random.default_rng(0)
    env.reset(seed=0)
    keys = {"cities", "agents", "visited", "agent"} | EXTRA[scenario]
    keys |= {"city_known"} if "view" in options else set()
    keys |= {"agent_known"} if "hearing" in options else set()
    while True:
        for agent in env.possible_agents:
            seen = env.observe(agent)
            assert env.observation_space(agent).contains(seen) and seen["observation"].keys() == keys
            assert seen["action_mask"].any()
            assert not (seen["action_mask"][1:] & seen["observation"]["visited"][1:]).any()
            if "view" in options:
                assert seen["observation"]["city_known"][1:].sum() <= options["view"]
        if over(env):
            break
        env.step(random_action(env, rng))


@in_every_scenario
def test_copies_of_a_running_game_go_on_as_it_does(scenario: str) -> None:
    env = mtsp_v0.raw_env(**SIZE, scenario=scenario, depot="wait")
    env.reset(seed=3)
    for _ in range(4):
        env.step(int(np.argmax(env.observe(env.agent_selection)["action_mask"])))
    twins = [pickle.loads(pickle.dumps(env)), copy.deepcopy(env)]
    play(env, seed=1)
    for twin in twins:
        play(twin, seed=1)
        assert (twin.infos, twin.log, twin.tours) == (env.infos, env.log, env.tours)


@in_every_scenario
def test_rewards_sum_to_the_judged_makespan(scenario: str) -> None:
    for reward in ("sparse", "shaped"):
        env = mtsp_v0.raw_env(**SIZE, scenario=scenario, depot="wait", reward=reward, max_decisions=5000)
        env.reset(seed=4)
        paid = sum(rewards["agent_0"] for *_, rewards in play(env))
        assert paid == pytest.approx(-check_log(env.instance, env.log, 0.1), abs=1e-9)
        assert paid == pytest.approx(-env.infos["agent_2"]["makespan"], abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "depot"),
    [(long_everything, "open"), (long_everything, "wait"), (long_traffic, "wait"), (long_traffic, "final")],
)
def test_nothing_that_anybody_sees_depends_on_the_future(scenario, depot: str) -> None:
    """Bit for bit, for every agent at every decision until the moment from which the future differs, and state()."""
    differ = 0
    for seed in range(15):
        rng = np.random.default_rng(seed)
        env = mtsp_v0.raw_env(9, 3, speed=0.05, depot=depot, scenario=scenario)
        env.reset(seed=seed)
        play(env, seed)
        instance, log, actions = env.instance, env.log, list(env._decisions)
        change = int(rng.integers(1, env.now)) * env.rules.speed
        other = other_future(instance, log, change, rng)
        env.reset(options={"instance": instance})
        twin = mtsp_v0.raw_env(9, 3, speed=0.05, depot=depot, scenario=scenario)
        twin.reset(options={"instance": other})
        for action in actions:
            if over(twin) or max(env.now, twin.now) * env.rules.speed > change:
                break
            assert np.array_equal(env.state(), twin.state())
            for agent in env.possible_agents:
                seen, again = env.observe(agent), twin.observe(agent)
                assert np.array_equal(seen["action_mask"], again["action_mask"])
                for key, value in seen["observation"].items():
                    assert np.array_equal(value, again["observation"][key]), key
            env.step(action)
            twin.step(action)
        differ += not np.array_equal(env.game.own_time, twin.game.own_time)
    assert differ > 5


def test_own_times_are_those_announced_until_a_delay_shows() -> None:
    """By hand: agent 1 drives 0.4 in traffic that triples it, while agent 0 decides at ticks 1, 2, 5 and 9."""
    nodes = [[0.5, 0.5], [0.6, 0.5], [0.5, 0.9], [0.5, 0.2], [0.9, 0.2], [0.5, 0.1], [0.1, 0.1]]
    env = mtsp_v0.raw_env(7, 2, speed=0.1, scenario=lambda rng, batch, n, m: {"traffic": np.ones((batch, m, 1))})
    env.reset(options={"instance": Instance(nodes, 2, traffic=[[1.0], [3.0]])})
    known = []
    for node in (1, 2, 0, 3, 4, 5, 0):
        known.append((env.now, env.agent_selection, *env.state()[3 * 7 :].reshape(2, 4)[:, 3].round(6).tolist()))
        env.step(node)
    assert [(tick, agent) for tick, agent, *_ in known] == [
        (0, "agent_0"), (0, "agent_1"), (1, "agent_0"), (2, "agent_0"), (5, "agent_0"), (9, "agent_0"), (12, "agent_1")
    ]  # fmt: skip
    assert [own for *_, own, _ in known] == pytest.approx([0.0, 0.1, 0.1, 0.2, 0.5, 0.9, 0.9 + 0.17**0.5])
    assert [own for *_, own in known] == pytest.approx([0.0, 0.0, 0.4, 0.4, 0.5, 0.9, 1.2])


def test_an_instance_of_another_world_is_refused() -> None:
    nodes = np.random.default_rng(0).random((9, 2))
    plain, team = Instance(nodes, 3), Instance(nodes, 3, speeds=[1.0, 2.0, 0.5])
    for scenario, instance in (("team", plain), ("plain", team), ("service", team)):
        env = mtsp_v0.raw_env(**SIZE, scenario=scenario)
        env.reset(seed=0)
        before = env.instance
        with pytest.raises(ValueError, match="plays instances with the world fields"):
            env.reset(seed=1, options={"instance": instance})
        assert env.instance is before
    env = mtsp_v0.raw_env(**SIZE, scenario="team")
    env.reset(options={"instance": team})
    assert env.instance is team
    assert env.observe("agent_1")["observation"]["agent_speeds"].tolist() == [1.0, 2.0, 0.5]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scenario": "rain"}, "unknown scenario 'rain'"),
        ({"scenario": "arrivals", "depot": "final"}, "cannot be played in a world with .'appears'."),
        ({"scenario": "traffic", "reference": True}, "tours cannot be planned in advance in a world with .'traffic'."),
        ({"view": 0}, "view must be a whole number of at least 1, got 0"),
        ({"hearing": -1.0}, "hearing must be a finite distance"),
    ],
)
def test_bad_arguments(change: dict, message: str) -> None:
    if "reference" in change:
        pytest.importorskip("numba")
    with pytest.raises(ValueError, match=message):
        mtsp_v0.env(**change)


def test_an_illegal_choice_of_an_unknown_city_says_so() -> None:
    env = mtsp_v0.raw_env(9, 1, scenario="arrivals")
    env.reset(seed=0)
    unknown = int(np.argmin(env.observe("agent_0")["observation"]["city_known"]))
    with pytest.raises(ValueError, match=f"agent_0 may not go to node {unknown}: it is not open to it now"):
        env.step(unknown)
