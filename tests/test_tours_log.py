"""The judge of worlds: times of tours, and what a log may not say."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from helpers.games import play

from mtsp_env import SCENARIOS, Instance, check_log, makespan, mtsp_v0
from mtsp_env.tours import Leg, Log, tour_times

CROSS = [[0.5, 0.5], [0.5, 0.8], [0.5, 0.1], [0.9, 0.5]]  # the depot, cities at distances 0.3, 0.4 and 0.4


def finished(scenario: str, seed: int, depot: str = "wait", speed: float = 0.01) -> mtsp_v0.raw_env:
    """A random game that has come to its end."""
    env = mtsp_v0.raw_env(8, 3, speed, depot, scenario=scenario, max_decisions=10_000)
    env.reset(seed=seed)
    play(env, seed)
    assert all(env.terminations.values())
    return env


def replaced(log: Log, agent: int, k: int, **values: object) -> Log:
    """A copy of the log with other values in one leg."""
    legs = [list(own) for own in log]
    legs[agent][k] = legs[agent][k]._replace(**values)
    return legs


# Times


def test_times_of_tours_by_hand() -> None:
    world = Instance(CROSS, 2, speeds=[0.5, 1.0], service=[0, 0.2, 0, 0], traffic=[[2.0, 1.0], [1.0, 3.0]])
    tours = [[0, 1, 0], [0, 2, 0, 3, 0]]
    assert tour_times(world, tours).tolist() == pytest.approx([1.2 + 0.2 + 0.6, 0.4 + 1.2 + 0.4 + 1.2])
    assert makespan(world, tours) == pytest.approx(3.2)
    assert makespan(world, [[0, 0], [0, 0, 2, 0, 0]]) == pytest.approx(0.4 + 1.2)  # staying is no leg
    for changing in ({"appears": [0, 0, 0, 1]}, {"breaks": [1, math.inf]}):
        with pytest.raises(ValueError, match="use check_log"):
            makespan(Instance(CROSS, 2, **changing), tours)


@pytest.mark.parametrize("scenario", ["plain", "traffic", "team", "service"])
@pytest.mark.parametrize("depot", ["open", "wait", "final"])
def test_tours_and_log_cost_the_same_if_waiting_does_not(scenario: str, depot: str) -> None:
    for seed in range(4):
        env = finished(scenario, seed, depot)
        cost = env.infos["agent_0"]["makespan"]
        assert makespan(env.instance, env.tours) == pytest.approx(cost, abs=1e-9)
        assert check_log(env.instance, env.log) == pytest.approx(cost, abs=1e-9)


@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.parametrize("speed", [0.1, 0.01])
def test_logs_of_games_are_valid_and_cost_what_the_game_does(scenario: str, speed: float) -> None:
    for seed in range(6):
        env = finished(scenario, seed, speed=speed)
        for known in (speed, None):
            judged = check_log(env.instance, env.log, known)
            assert judged == pytest.approx(env.infos["agent_0"]["makespan"], abs=1e-9)


# What a log may not say


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_any_wrong_time_is_refused(scenario: str) -> None:
    env, rng = finished(scenario, 3), np.random.default_rng(0)
    for agent, own in enumerate(env.log):
        for k, leg in enumerate(own):
            for name in ("departed", "arrived", "ready"):
                if math.isinf(getattr(leg, name)):
                    continue
                wrong = getattr(leg, name) + float(rng.choice([-1.0, 1.0])) * float(rng.uniform(0.002, 0.3))
                with pytest.raises(ValueError, match=rf"agent {agent}"):
                    check_log(env.instance, replaced(env.log, agent, k, **{name: wrong}), 0.01)


def shifted(log: Log, agent: int, k: int, time: float) -> Log:
    """The log with an agent's legs from the ``k``-th on later by ``time``."""
    later = [
        leg._replace(departed=leg.departed + time, arrived=leg.arrived + time, ready=leg.ready + time)
        for leg in log[agent][k:]
    ]
    return [[*own[:k], *later] if number == agent else list(own) for number, own in enumerate(log)]


def test_a_city_served_before_it_appeared_is_refused() -> None:
    instance = Instance(CROSS, 1, appears=[0, 0.5, 0, 0])
    trips, log, begin = (1, 2, 3), [[]], 0.5
    for city in trips:
        there = math.dist(CROSS[0], CROSS[city])
        log[0] += [Leg(city, begin, begin + there, begin + there)]
        begin = math.ceil((begin + there) * 10 - 1e-9) / 10
        log[0] += [Leg(0, begin, begin + there, begin + there)]
        begin = math.ceil((begin + there) * 10 - 1e-9) / 10
    assert check_log(instance, log, 0.1) == check_log(instance, log) == pytest.approx(0.5 + 2 * 1.1)
    with pytest.raises(ValueError, match=r"agent 0, leg 0 to node 1: it departs at 0\.4, but the city appears at 0.5"):
        check_log(instance, shifted(log, 0, 0, -0.1))


def test_a_dead_agent_that_moves_is_refused() -> None:
    instance = Instance(CROSS, 2, breaks=[0.15, math.inf])
    cut, other = Leg(1, 0.0, math.inf, math.inf), [Leg(2, 0.0, 0.4, 0.4), Leg(1, 0.4, 1.1, 1.1), Leg(3, 1.1, 1.6, 1.6)]
    home = Leg(0, 1.6, 2.0, 2.0)
    assert check_log(instance, [[cut], [*other, home]], 0.1) == pytest.approx(2.0)
    arrived = Leg(1, 0.0, 0.3, 0.3)
    for log, message in (
        ([[arrived], [*other, home]], "agent 0, leg 0 to node 1: it arrives at 0.3, but broke down at 0.15"),
        ([[cut, Leg(0, 0.3, 0.6, 0.6)], [*other, home]], "agent 0, leg 0 to node 1: it arrives at 0.3, but broke down"),
        ([[Leg(1, 0.2, math.inf, math.inf)], [*other, home]], "it departs at 0.2, but broke down at 0.15"),
        ([[], [*other, Leg(0, 1.6, math.inf, math.inf)]], "agent 1, leg 3 to node 0: it arrives at 2, got inf"),
        ([[cut], other], "agent 1 does not come home from node 3"),
        ([[cut], [other[0], Leg(0, 0.4, 0.8, 0.8)]], "cities 1, 3 missing from the log"),
    ):
        with pytest.raises(ValueError, match=message):
            check_log(instance, log, 0.1)
        with pytest.raises(ValueError, match=r"agent|missing"):
            check_log(instance, log)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: log[:2], "expected 3 lists of legs, one per agent, got 2"),
        (lambda log: replaced(log, 0, 0, node=99), r"agent 0 sets off for node 99, outside 0\.\.7"),
        (lambda log: replaced(log, 0, 0, node=0), "staying at the depot is no leg"),
        (
            lambda log: [[(1, 2.0)], *log[1:]],
            r"agent 0: a leg must be \(node, departed, arrived, ready\), got \(1, 2.0\)",
        ),
        (lambda log: [[], *log[1:]], "missing from the log"),
        (lambda log: [log[0], log[0], log[2]], r"sets off for city \d at 0, which agent 0 visits|missing"),
    ],
    ids=["agents", "node", "stay", "tuple", "missing", "twice"],
)
def test_logs_that_are_none_are_refused(change: Callable, message: str) -> None:
    env = finished("plain", 1)
    with pytest.raises(ValueError, match=message):
        check_log(env.instance, change(env.log))


def test_the_log_of_a_running_game_ends_with_the_legs_under_way() -> None:
    env = mtsp_v0.env(n_nodes=6, n_agents=2, speed=0.1)
    env.reset(seed=0)
    assert env.unwrapped.log == [[], []]
    env.step(3)
    (leg,) = env.unwrapped.log[0]
    distance = math.dist(env.unwrapped.instance.nodes[0], env.unwrapped.instance.nodes[3])
    assert leg == (3, 0.0, pytest.approx(distance), pytest.approx(distance)) and env.unwrapped.log[1] == []
