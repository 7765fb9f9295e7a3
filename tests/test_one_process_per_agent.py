"""Agents in processes of their own: what they believe is what the environment would show them, and so they decide."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mtsp_env import Instance, check_log, mtsp_v0
from mtsp_env.distributions import sample

pytest.importorskip("zmq", reason="needs pyzmq")
sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
from one_process_per_agent import Belief, Decision, make_policy, nearest, play, world_of_arrivals


def draw(seed: int, n: int, m: int, broken: dict[int, float] | None = None) -> Instance:
    instance = sample("uniform", np.random.default_rng(seed), 1, n, m, world_of_arrivals).instance(0)
    breaks = [(broken or {}).get(agent, np.inf) for agent in range(m)]
    return replace(instance, breaks=np.array(breaks))


def environment(instance: Instance, speed: float = 0.01) -> mtsp_v0.raw_env:
    env = mtsp_v0.raw_env(instance.n_nodes, instance.n_agents, scenario=world_of_arrivals, depot="wait", speed=speed)
    env.reset(options={"instance": instance})
    return env


def over(env: mtsp_v0.raw_env) -> bool:
    return any(env.terminations.values()) or any(env.truncations.values())


def play_in_the_environment(instance: Instance, policy) -> list[Decision]:
    """The game in one process, in which everybody sees what the environment shows."""
    env, decisions = environment(instance), []
    while not over(env):
        seen = env.observe(env.agent_selection)
        node = policy({**seen["observation"], "action_mask": seen["action_mask"].astype(bool)})
        decisions.append((env.now, env.possible_agents.index(env.agent_selection), node))
        env.step(node)
    return decisions


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.01, 0.1])
def test_beliefs_are_what_the_environment_shows(speed: float) -> None:
    """Bit for bit, in random games in which half of the agents break down, without any socket."""
    missed = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n, m = int(rng.integers(2, 14)), int(rng.integers(1, 6))
        broken = {agent: float(rng.uniform(0.05, 3.0)) for agent in range(1, m) if rng.random() < 0.5}
        instance = draw(seed, n, m, broken)
        env = environment(instance, speed)
        beliefs = [Belief(a, instance.nodes[0], instance.speeds, n, speed) for a in range(m)]
        alive = np.ones(m, bool)
        while not over(env):
            for a in sorted(np.flatnonzero(alive & ~env.game.alive[0]), key=lambda a: env.game.break_tick[0, a]):
                missed += 1
                for belief in beliefs:
                    belief.now = int(env.game.break_tick[0, a])
                    belief.miss(a)
            alive = env.game.alive[0]
            for belief in beliefs:
                belief.now = env.now
                for city in np.flatnonzero(env.game.appear_tick[0] <= env.now):
                    belief.learn_of(city, instance.nodes[city], instance.service[city])
            agent = env.possible_agents.index(env.agent_selection)
            shown, believed = env.observe(env.agent_selection), beliefs[agent].observe()
            shown = {**shown["observation"], "action_mask": shown["action_mask"].astype(bool)}
            assert shown.keys() == believed.keys()
            for key, value in shown.items():
                assert believed[key].dtype == value.dtype and np.array_equal(believed[key], value), key
            node = int(rng.choice(np.flatnonzero(shown["action_mask"])))
            departure = beliefs[agent].set_off(node)
            for belief in beliefs:
                belief.hear_of(**departure)
            env.step(node)
    assert missed > 20


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["nearest", "default"])
def test_without_faults_the_processes_decide_as_in_the_environment(policy: str) -> None:
    instance = draw(seed=1, n=12, m=3)
    decisions, env = play(instance, policy)
    assert decisions == play_in_the_environment(instance, make_policy(policy))
    assert check_log(instance, env.log, 0.01) == pytest.approx(env.infos["agent_0"]["makespan"], abs=1e-9)


@pytest.mark.slow
def test_the_others_take_over_when_a_process_is_killed() -> None:
    """Killed on its way to a city: the others notice, and visit that city and all others."""
    whole = draw(seed=2, n=12, m=3)
    legs = play_in_the_environment(whole, nearest)
    killed = next(agent for tick, agent, node in legs if tick > 0 and node != 0)
    first = next(leg for leg in whole_log(whole)[killed] if leg.departed > 0)
    instance = replace(whole, breaks=np.where(np.arange(3) == killed, (first.departed + first.arrived) / 2, np.inf))
    decisions, env = play(instance, "nearest")
    assert decisions == play_in_the_environment(instance, nearest)
    assert not env.game.alive[0, killed]
    assert first.node not in env.tours[killed]
    assert sorted(city for tour in env.tours for city in tour if city) == list(range(1, 12))
    assert check_log(instance, env.log, 0.01) == pytest.approx(env.infos["agent_0"]["makespan"], abs=1e-9)


def whole_log(instance: Instance) -> list:
    """The log of the nearest-city game."""
    env = environment(instance)
    for _, _, node in play_in_the_environment(instance, nearest):
        env.step(node)
    return env.log
