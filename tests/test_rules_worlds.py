"""Worlds: the rules against a literal Algorithm 1 (``helpers/oracle.py``), cases by hand, and what must always hold.

``WORLD_SEEDS=300 pytest tests/test_rules_worlds.py -k algorithm`` plays 1,200 random games through every face.
"""

from __future__ import annotations

import os
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from helpers.faces import FACES, FIELDS, PLAYERS, Game, check_face, play, play_random, random_world, random_world_game
from helpers.oracle import Oracle
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, mtsp_v0, rules
from mtsp_env.instance import Problem

SEEDS = int(os.environ.get("WORLD_SEEDS", "20"))
CROSS = [[0.5, 0.5], [0.5, 0.8], [0.5, 0.1], [0.9, 0.5]]  # the depot, cities at distances 0.3, 0.4 and 0.4


@pytest.mark.slow
@pytest.mark.parametrize("start", range(0, SEEDS, 5))
@pytest.mark.parametrize("face", FACES)
def test_every_decision_in_a_world_is_algorithm_1s(face: str, start: int) -> None:
    for seed in range(start, min(start + 5, SEEDS)):  # 4 games each
        check_face(face, *play_random(seed, random_world_game))


def test_random_worlds_have_all_fields_singly_and_together() -> None:
    games = [random_world_game(seed) for seed in range(200)]
    assert {frozenset(game.world) for game in games} >= {frozenset({field}) for field in FIELDS} | {frozenset(FIELDS)}
    assert {game.rules.depot for game in games} == set(rules.DEPOTS)
    assert {game.rules.speed for game in games} == {0.1, 0.01}
    for pair in combinations(FIELDS, 2):
        assert any(set(pair) <= set(game.world) for game in games)


@st.composite
def odd_worlds(draw: st.DrawFn) -> Game:
    """Small games in which several things happen at one tick, at the very beginning, or at the very end."""
    axis = st.sampled_from([0.0, 0.1, 0.2, 0.25, 0.5, 0.8, 1.0])
    n, m, speed = draw(st.integers(2, 6)), draw(st.integers(1, 4)), draw(st.sampled_from([0.1, 0.05, 0.3, 1.0]))
    nodes = np.array([draw(st.lists(st.tuples(axis, axis), min_size=n, max_size=n))])
    time = st.sampled_from([0.0, 1e-12, 0.05, 0.1, 0.2, 0.3, 0.5, 0.9, 1.0, 2.0, 5.0, 50.0])  # 50: longer than any game
    breaks = np.array([[draw(time | st.just(np.inf)) or np.inf for _ in range(m)]])
    breaks[0, draw(st.integers(0, m - 1))] = np.inf
    if draw(st.booleans()):  # all but one at tick 1
        breaks[np.isfinite(breaks)] = speed
    cities = [[0.0, *(draw(time) for _ in range(n - 1))] for _ in range(2)]
    world = {
        "speeds": np.array([[draw(st.sampled_from([0.5, 1.0, 2.0])) for _ in range(m)]]),
        "service": np.array(cities[:1]),
        "appears": np.array(cities[1:]),
        "breaks": breaks,
        "traffic": np.array([[[draw(st.sampled_from([0.5, 1.0, 3.0])), 1.0] for _ in range(m)]]),
    }
    fields = draw(st.sets(st.sampled_from(FIELDS), min_size=1))
    depots = ["open", "wait"] if fields & {"appears", "breaks"} else list(rules.DEPOTS)
    game_rules = rules.make_rules(
        n,
        m,
        speed,
        draw(st.sampled_from(depots)),
        draw(st.sampled_from(rules.REWARDS)),
        draw(st.none() | st.integers(1, n + m)),
        draw(st.none() | st.integers(1, n)),
        draw(st.none() | st.sampled_from([0.0, 0.1, 0.5])),
    )
    arrays = {"nodes": nodes, **{name: world[name] for name in sorted(fields)}}
    return Game(arrays, m, game_rules, (draw(st.sampled_from(PLAYERS)),), draw(st.integers(0, 2**16)))


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(odd_worlds())
@pytest.mark.slow
def test_odd_worlds_are_algorithm_1s(game: Game) -> None:
    traces = play(game)
    for face in FACES:
        check_face(face, game, traces)


# By hand


def both(nodes: list, n_agents: int, depot: str, **world: list) -> tuple[Oracle, mtsp_v0.raw_env]:
    """The oracle and the environment at the start of one game, a tenth of a unit per tick."""
    env = mtsp_v0.raw_env(
        len(nodes), n_agents, 0.1, depot, scenario=lambda rng, b, n, m: {k: np.array([v] * b) for k, v in world.items()}
    )
    env.reset(options={"instance": Instance(nodes, n_agents, **world)})
    return Oracle(nodes, n_agents, 0.1, depot, world=world), env


def follow(oracle: Oracle, env: mtsp_v0.raw_env, moves: list[tuple[int, int, int]]) -> None:
    """Both make these moves (agent, tick, node)."""
    for agent, tick, node in moves:
        assert (oracle.agent, oracle.tick) == (agent, tick)
        assert (env.agent_selection, env.now) == (f"agent_{agent}", tick)
        oracle.step(node)
        env.step(node)


def test_a_leg_by_hand() -> None:
    """At half speed, in double traffic, with a visit of 0.25: 0.3 take 0.6, announced, or 1.2, and 1.45 with it."""
    oracle, env = both(CROSS, 1, "open", speeds=[0.5], service=[0, 0.25, 0, 0], traffic=[[2.0, 1.0]])
    follow(oracle, env, [(0, 0, 1)])
    assert env.now == oracle.tick == 15 and env.log == [[(1, 0.0, pytest.approx(1.2), pytest.approx(1.45))]]
    assert env.game.leg[0, 0] == pytest.approx(0.85) and env.game.own_time[0, 0] == pytest.approx(1.45)
    follow(oracle, env, [(0, 15, 2)])
    assert env.log[0][1] == (2, 1.5, pytest.approx(1.5 + 0.7 / 0.5), pytest.approx(1.5 + 0.7 / 0.5))


def test_a_city_appears_by_hand() -> None:
    """City 3 appears at 0.65, which is tick 7; agent 0, which waits at the depot from tick 6 on, is woken for it."""
    oracle, env = both(CROSS, 2, "wait", appears=[0, 0, 0, 0.65])
    seen = env.observe("agent_0")
    assert seen["action_mask"].tolist() == [0, 1, 1, 0] and seen["observation"]["visited"].tolist() == [0, 0, 0, 1]
    assert seen["observation"]["city_known"].tolist() == [1, 1, 1, 0]
    assert seen["observation"]["cities"][3].tolist() == [0.0, 0.0]
    follow(oracle, env, [(0, 0, 1), (1, 0, 2), (0, 3, 0), (1, 4, 0), (0, 6, 0)])
    assert env.observe("agent_0")["action_mask"].tolist() == [1, 0, 0, 1]
    assert env.observe("agent_0")["observation"]["cities"][3].tolist() == pytest.approx([0.4, 0.0])
    follow(oracle, env, [(0, 7, 3)])
    assert oracle.done and env.infos["agent_0"]["makespan"] == pytest.approx(0.7 + 0.8)  # it left at 0.7


def test_a_breakdown_by_hand() -> None:
    """Agent 0 breaks down at 0.15, at tick 2, on its way to city 1, which agent 1 must visit as well."""
    oracle, env = both(CROSS, 2, "wait", breaks=[0.15, np.inf])
    follow(oracle, env, [(0, 0, 1), (1, 0, 2)])
    seen = env.observe("agent_1")
    assert seen["observation"]["agent_alive"].tolist() == [0, 1] and seen["action_mask"].tolist() == [1, 1, 0, 1]
    assert seen["observation"]["agents"][0].tolist() == pytest.approx([0.0, 0.7, 0.0])  # where it was going
    follow(oracle, env, [(1, 4, 1), (1, 11, 3)])
    assert oracle.done and oracle.tick == 16  # only then is city 3 reached
    assert env.infos["agent_0"]["makespan"] == pytest.approx(0.4 + 0.7 + 0.5 + 0.4)
    assert env.tours == [[0], [0, 2, 1, 3, 0]]
    assert env.game.own_time[0, 0] == 0.15 and env.log[0] == [(1, 0.0, np.inf, np.inf)]


def test_an_agent_that_arrives_at_its_last_tick_has_arrived() -> None:
    for breaks, arrived in ((0.3, True), (0.2, False)):
        oracle, env = both(CROSS, 2, "wait", breaks=[breaks, np.inf])
        follow(oracle, env, [(0, 0, 1), (1, 0, 2)])
        assert env.observe("agent_1")["observation"]["visited"][1] == arrived
        assert env.game.own_time[0, 0] == breaks


# The future


def with_another_future(rng: np.random.Generator, instance: Instance, game: rules.State, now: int) -> Instance:
    """The instance with other arrivals, breakdowns and traffic after tick ``now`` of the game, at speed 0.1."""
    later, arrays = (now + 1) * 0.1, {name: array.copy() for name, array in instance.arrays().items()}
    unknown = game.appear_tick[0] > now
    arrays["appears"][unknown] = later + rng.random(unknown.sum())
    arrays["nodes"][unknown] = rng.random((unknown.sum(), 2))
    arrays["service"][unknown] = rng.random(unknown.sum())
    breaks_later = game.break_tick[0] > now
    arrays["breaks"][breaks_later] = later + rng.random(breaks_later.sum())
    arrays["breaks"][rng.choice(np.flatnonzero(breaks_later))] = np.inf
    for agent, legs in enumerate(game.legs[0]):
        arrays["traffic"][agent, legs:] *= rng.lognormal(0.0, 1.0, arrays["traffic"].shape[1] - legs)
    return Instance(n_agents=instance.n_agents, **arrays)


@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "wait"])
@pytest.mark.parametrize("known", [{}, {"view": 3}, {"hearing": 0.4}], ids=str)
def test_observations_hold_nothing_about_the_future(depot: str, known: dict) -> None:
    """A game up to a decision, and the same decisions with another future after it: everybody sees the same."""
    rng, compared = np.random.default_rng(5), 0
    for _ in range(12):
        settings = {"n_nodes": 9, "n_agents": 3, "speed": 0.1, "depot": depot, "scenario": longer_traffic, **known}
        one, other = mtsp_v0.raw_env(**settings), mtsp_v0.raw_env(**settings)
        one.reset(seed=int(rng.integers(1000)))
        actions: list[int] = []
        until = int(rng.integers(3, 25))
        while len(actions) < until and one.agents and not any(one.terminations.values()):
            actions.append(int(rng.choice(np.flatnonzero(one.observe(one.agent_selection)["action_mask"]))))
            one.step(actions[-1])
        if any(one.terminations.values()):
            continue
        changed = with_another_future(rng, one.instance, one.game, one.now)
        instance = one.instance
        one.reset(options={"instance": instance})
        other.reset(options={"instance": changed})
        for action in [*actions, None]:
            assert one.agent_selection == other.agent_selection and one.now == other.now
            for agent in one.possible_agents:
                seen, too = one.observe(agent), other.observe(agent)
                assert np.array_equal(seen["action_mask"], too["action_mask"])
                for key, value in seen["observation"].items():
                    assert np.array_equal(value, too["observation"][key]), key
                compared += 1
            if action is not None:
                one.step(action)
                other.step(action)
        assert not np.array_equal(instance.appears, changed.appears) or not np.array_equal(
            instance.traffic, changed.traffic
        )
    assert compared > 100


def longer_traffic(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """All fields; factors for more legs than any game has, so that they do not repeat."""
    world = random_world(rng, batch, n_nodes, n_agents, FIELDS, 0.1)
    return world | {"traffic": rng.lognormal(0.0, 0.3, (batch, n_agents, 300))}


# Truncation


@pytest.mark.parametrize("seed", range(40))
def test_stalling_never_pays_in_a_world(seed: int) -> None:
    """A game that is cut off costs at least what it costs to go on from there, without waiting while cities are open.

    If waiting counts, up to what the clock rounds up: a tick for each leg and visit. Worlds with ``breaks`` have no
    such bound, because every breakdown on the way loses a trip.
    """
    rng = np.random.default_rng([seed, 7])
    fields = [name for name in FIELDS if name != "breaks" and rng.random() < 0.6]
    n, m, speed = int(rng.integers(3, 10)), int(rng.integers(1, 4)), 0.1
    world = {name: array[0] for name, array in random_world(rng, 1, n, m, fields, speed).items()}
    nodes, cap = rng.random((n, 2)), int(rng.integers(1, n))
    cut, free = (Oracle(nodes, m, speed, "open", "sparse", limit, world) for limit in (cap, 100_000))
    while not cut.done:
        action = PLAYERS[seed % 2](cut, rng)
        cut.step(action)
        free.step(action)
    while not free.done:
        legal = np.flatnonzero(free.legal_actions())
        free.step(int(rng.choice(legal[legal > 0] if len(legal) > 1 or legal[0] else legal)))
    ticks = 2 * n + 2 * m if "appears" in fields else 0
    assert not cut.truncated or free.cost <= cut.cost + ticks * speed + 1e-9


def test_the_penalty_by_hand() -> None:
    """Cut off after two decisions, at tick 3: city 1 is reached; 2 is not, though agent 1 is on its way; 3 is unknown.

    The slowest agent goes for 2 and 3 when 3 has appeared, in the worst traffic: 5 + (0.8 + 0.8) / 0.5 * 3.
    """
    world = {"speeds": [1.0, 0.5], "appears": [0, 0, 0, 5.0], "breaks": [np.inf, 90.0], "traffic": [[1.0], [3.0]]}
    env = mtsp_v0.raw_env(
        4, 2, 0.1, max_decisions=2, scenario=lambda rng, b, n, m: {k: np.array([v] * b) for k, v in world.items()}
    )
    env.reset(options={"instance": Instance(CROSS, 2, **world)})
    env.step(1)
    env.step(2)
    assert env.truncations["agent_0"] and env.now == 3
    assert env.infos["agent_0"]["makespan"] == pytest.approx(5.0 + 1.6 / 0.5 * 3.0)
    assert env.rewards["agent_1"] == pytest.approx(-14.6)


# What must hold of every game


@pytest.mark.parametrize("seed", range(0, 12))
def test_finished_games_in_worlds_stand_still(seed: int) -> None:
    """A batch steps its finished rows along with the others, which changes neither cost nor tours."""
    game, traces = play_random(seed, random_world_game)
    state = rules.start(Problem(game.n_agents, game.arrays), game.rules)
    for k in range(max(len(trace.actions) for trace in traces) + 5):
        over = rules.terminated(state)
        picks = [trace.actions[k] if k < len(trace.actions) else 0 for trace in traces]
        after = rules.depart(state, game.rules, np.where(over, 0, picks))
        assert (rules.terminated(after) | ~over).all()
        assert rules.makespan(after)[over] == pytest.approx(rules.makespan(state)[over], abs=1e-12)
        state = after


def test_states_have_the_fields_of_their_world_alone() -> None:
    for field, needed in (
        ("traffic", {"legs"}),
        ("appears", {"appear_tick"}),
        ("breaks", {"break_tick", "arrival", "alive"}),
    ):
        arrays = random_world(np.random.default_rng(0), 2, 5, 3, [field], 0.1) | {"nodes": np.zeros((2, 5, 2))}
        state = rules.start(Problem(3, arrays), rules.make_rules(5, 3, 0.1, "open", "sparse", None))
        assert state.arrays().keys() - rules.state_fields(()).keys() == needed | {"nodes", field}
        for name in needed:
            described = rules.STATE_FIELDS[name]
            array = state.arrays()[name]
            assert (array.shape, str(array.dtype)) == ((2, *described.sizes(5, 3)), described.dtype)


@pytest.mark.parametrize("field", ["appears", "breaks"])
def test_closed_tours_do_not_fit_worlds_that_change(field: str) -> None:
    problem = Problem(3, random_world(np.random.default_rng(0), 1, 5, 3, [field], 0.1) | {"nodes": np.zeros((1, 5, 2))})
    game_rules = rules.make_rules(5, 3, 0.1, "final", "sparse", None)
    with pytest.raises(ValueError, match=rf"depot \"final\" cannot be played in a world with \['{field}'\]"):
        rules.start(problem, game_rules)
    rules.start(problem, replace(game_rules, depot="wait"))


def test_absurdly_long_legs_do_not_overflow() -> None:
    nodes, traffic = np.random.default_rng(0).random((1, 4, 2)), np.full((1, 2, 1), 1e300)
    game_rules = rules.make_rules(4, 2, 1e-9, "open", "sparse", None)
    state = rules.start(Problem(2, {"nodes": nodes, "traffic": traffic}), game_rules)
    for node in (1, 2, 3):
        state = rules.depart(state, game_rules, np.array([node]))
        assert (state.ready >= 0).all() and (state.ready < rules.NEVER).all()
