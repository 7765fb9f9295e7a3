"""Logs: when every agent of given tours is where, and which logs are refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.games import play
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, mtsp_v0, tour_lengths, uniform
from mtsp_env.distributions import SCENARIOS
from mtsp_env.render import make_page
from mtsp_env.schedule import end_time, make_log, moment
from mtsp_env.tours import tour_times


def test_the_square_by_hand(square: Instance, square_tours: list[list[int]]) -> None:
    """Every leg of the square is 0.5 long."""
    log = make_log(square, square_tours)
    assert log[0] == [(2, 0.0, 0.5, 0.5), (1, 0.5, 1.0, 1.0), (3, 1.0, 1.5, 1.5), (0, 1.5, 2.0, 2.0)]
    assert end_time(log) == 2.0
    now = moment(square, log, 0.75)
    assert now.paths[0].tolist() == [[0.5, 0.5], [0.5, 1.0], [0.25, 1.0]]
    assert now.paths[1].tolist() == [[0.5, 0.5], [0.5, 0.0], [0.75, 0.0]]
    assert now.lengths.tolist() == [0.75, 0.75]
    assert now.owner.tolist() == [-1, -1, 0, -1, 1, -1, -1]


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(2, 30), m=st.integers(1, 6), share=st.floats(0, 1))
def test_without_waiting_everybody_has_driven_as_long_as_the_time_or_its_tour(seed, n, m, share) -> None:
    rng = np.random.default_rng(seed)
    instance = uniform(rng, n, m)
    tours = [[0, *part.tolist(), 0] for part in np.array_split(1 + rng.permutation(n - 1), m)]
    log = make_log(instance, tours)
    lengths = tour_lengths(instance, tours)
    assert end_time(log) == pytest.approx(lengths.max())
    time = share * end_time(log)
    now = moment(instance, log, time)
    assert now.lengths == pytest.approx(np.minimum(lengths, time))
    last = moment(instance, log, end_time(log) + 1e-9)
    for agent, tour in enumerate(tours):
        driven = tour if len(tour) > 2 else [0]  # staying at the depot is no leg
        assert last.paths[agent].tolist() == instance.nodes[driven].tolist()
        assert (last.owner[tour[1:-1]] == agent).all()


def test_a_log_with_a_visit_that_takes_time(square: Instance) -> None:
    log = make_log(square, log=[[(2, 0.0, 0.5, 2.5), (0, 3.0, 4.0, 4.0)], []])
    for time in (0.5, 2.0, 2.9):
        assert moment(square, log, time).paths[0].tolist() == [[0.5, 0.5], [0.5, 1.0]]
    halfway = moment(square, log, 3.5)  # at half the speed
    assert halfway.paths[0][-1].tolist() == [0.5, 0.75]
    assert halfway.owner.tolist() == [-1, -1, 0, -1, -1, -1, -1]
    assert end_time(log) == 4.0


def test_a_leg_that_never_ends_stays_where_it_began(square: Instance) -> None:
    log = make_log(square, log=[[(2, 0.0, 0.5, 0.5), (1, 0.5, math.inf, math.inf)], [(4, 0.0, 0.5, 0.5)]])
    assert end_time(log) == 0.5
    now = moment(square, log, 7.0)
    assert now.paths[0][-1].tolist() == [0.5, 1.0]
    assert now.owner[1] == -1


def test_open_tours_are_driven_as_far_as_they_go(square: Instance) -> None:
    log = make_log(square, [[0, 2], [0]])
    assert log == [[(2, 0.0, 0.5, 0.5)], []]
    assert end_time(make_log(square, [[0], [0]])) == 0.0


@pytest.mark.parametrize(
    ("tours", "log", "message"),
    [
        (None, None, "either tours or a log"),
        ([[0, 0], [0, 0]], [[], []], "either tours or a log"),
        ([[0, 0]], None, "expected 2 tours, one per agent, got 1"),
        ([[0, 9, 0], [0, 0]], None, r"tour 0 visits node 9, outside 0\.\.6"),
        (None, [[]], "expected 2 lists of legs, one per agent, got 1"),
        (None, [[(1, 0, 1)], []], r"leg 0 of agent 0 must be \(node, departed, arrived, ready\), got \(1, 0, 1\)"),
        (None, [[], [(7, 0, 1, 1)]], r"leg 0 of agent 1 goes to node 7, outside 0\.\.6"),
        (None, [[], [(1.5, 0, 1, 1)]], r"goes to node 1\.5"),
        (None, [[(1, 0, 1, 2), (2, 1.5, 3, 3)], []], "leg 1 of agent 0 must depart at 2 or later"),
        (None, [[(1, 0, 2, 1)], []], "then arrive, then be ready"),
        (None, [[(1, 2, 1, 3)], []], "then arrive, then be ready"),
        (None, [[(1, 0, math.nan, 1)], []], "then arrive, then be ready"),
        (None, [[(1, math.inf, math.inf, math.inf)], []], "must depart"),
    ],
)
def test_what_does_not_fit_is_refused(square: Instance, tours, log, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_log(square, tours, log)


def test_tours_of_a_team_take_as_long_as_the_judge_says(square: Instance, square_tours: list[list[int]]) -> None:
    traffic = np.array([[1.0, 2.0], [1.5, 1.0]])
    world = Instance(square.nodes, 2, speeds=[1.0, 2.0], service=[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], traffic=traffic)
    log = make_log(world, square_tours)
    assert log[0][:2] == [(2, 0.0, 0.5, 2.5), (1, 2.5, 3.5, 4.5)]
    assert [legs[-1].ready for legs in log] == pytest.approx(tour_times(world, square_tours).tolist(), abs=1e-12)
    assert moment(world, log, 3.0).paths[0].tolist() == [[0.5, 0.5], [0.5, 1.0], [0.25, 1.0]]


@pytest.mark.parametrize(("field", "values"), [("appears", [0.0] * 6 + [1.0]), ("breaks", [1.0, math.inf])])
def test_tours_do_not_say_when_a_world_with_events_is_driven(square: Instance, square_tours, field, values) -> None:
    world = Instance(square.nodes, 2, **{field: values})
    with pytest.raises(ValueError, match=rf"the fields \['{field}'\]; pass the log of a game"):
        make_log(world, square_tours)
    assert make_log(world, log=[[(1, 0.0, 1.0, 1.0)], []])


def test_an_agent_that_breaks_down_stops_on_its_way(square: Instance) -> None:
    """Agents 0 and 1 break down at 0.75, halfway on legs of 0.5: agent 0 on its way home, agent 1 to a second city."""
    world = Instance(square.nodes, 3, breaks=[0.75, 0.75, math.inf])
    first, second = [(2, 0.0, 0.5, 0.5), (0, 0.5, 0.75, 0.75)], [(4, 0.0, 0.5, 0.5), (5, 0.5, math.inf, math.inf)]
    log = make_log(world, log=[first, second, []])
    for time, driven in ((0.625, 0.125), (0.75, 0.25), (9.0, 0.25)):
        now = moment(world, log, time)
        assert now.paths[0][-1].tolist() == [0.5, 1.0 - driven]
        assert now.paths[1][-1].tolist() == [0.5 + driven, 0.0]
        assert now.owner.tolist() == [-1, -1, 0, -1, 1, -1, -1]
    assert now.lengths.tolist() == [0.75, 0.75, 0.0]


def test_an_agent_that_breaks_down_before_it_moves_stays_where_it_is() -> None:
    """Agent 0 leaves for a city at the depot's own place, agent 1 only after its breakdown."""
    world = Instance([[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]], 3, breaks=[0.5, 0.5, math.inf])
    log = make_log(world, log=[[(1, 0.0, math.inf, math.inf)], [(2, 0.75, math.inf, math.inf)], []])
    now = moment(world, log, 9.0)
    assert [path[-1].tolist() for path in now.paths] == [[0.0, 0.0]] * 3
    assert now.owner.tolist() == [-1, -1, -1]


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_log_of_every_world_can_be_shown(scenario: str) -> None:
    env = mtsp_v0.env(n_nodes=15, n_agents=3, scenario=scenario)
    for seed in range(5):
        env.reset(seed=seed)
        play(env, seed)
        instance, log = env.unwrapped.instance, make_log(env.unwrapped.instance, log=env.unwrapped.log)
        late = end_time(log) - env.infos["agent_0"]["makespan"]
        assert -1e-6 <= late <= 0.01 * (1 + max(map(len, log)))  # every leg ends with the tick in which it arrives
        last = moment(instance, log, end_time(log))
        assert (last.owner[1:] >= 0).all()
        assert "the end at" in make_page(instance, log=env.unwrapped.log)
