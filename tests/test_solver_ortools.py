"""OR-Tools returns valid tours in its time: the first solution, its descent, and near-optimal guided search."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest

pytest.importorskip("ortools.constraint_solver.pywrapcp")

from helpers.odd import ODD

from benchmarks.solvers import NoTours, Unavailable, ortools
from benchmarks.studies.optima import optimal_makespan
from benchmarks.suite import Cell
from mtsp_env import Instance, check_tours, makespan

SEARCHES = tuple(ortools.SEARCHES)


def whole_lengths(instance: Instance) -> np.ndarray:
    between = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)
    return np.rint(between * ortools.UNIT).astype(np.int64)


def nearest_next(instance: Instance) -> list[int]:
    tour, left = [0], set(range(1, instance.n_nodes))
    while left:
        tour.append(min(left, key=lambda city: np.linalg.norm(instance.nodes[city] - instance.nodes[tour[-1]])))
        left.remove(tour[-1])
    return [*tour, 0]


@pytest.mark.slow
@pytest.mark.parametrize("search", SEARCHES)
def test_tiny_instances_are_solved_in_time_on_one_thread(search):
    for instance in Cell(8, 2, 3).instances(0):
        wall, processor = time.perf_counter(), time.process_time()
        tours = ortools.solve(instance, 0.3, 0, search)
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        check_tours(instance, tours)
        assert wall < 1.2 * 0.3 + 0.5
        assert processor < 1.1 * wall + 0.1


@pytest.mark.slow
def test_guided_search_goes_on_until_its_time_is_over():
    (instance,) = Cell(20, 3, 1).instances(0)
    began = time.perf_counter()
    ortools.solve(instance, 1.0, 0, "guided")
    assert 0.9 < time.perf_counter() - began < 1.2 * 1.0 + 0.5


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.slow
def test_the_time_limit_holds_for_a_thousand_nodes(search):
    (instance,) = Cell(1000, 10, 1).instances(0)
    began = time.process_time()  # the processor may be shared
    try:
        check_tours(instance, ortools.solve(instance, 1.0, 0, search))
    except NoTours as error:
        assert "within 1 s" in str(error)
    assert time.process_time() - began < 1.2 * 1.0 + 0.5


@pytest.mark.parametrize("search", SEARCHES)
@pytest.mark.parametrize("name", ODD)
def test_odd_instances_are_solved(name, search):
    check_tours(ODD[name], ortools.solve(ODD[name], 0.1, 0, search))


def test_the_first_solution_is_one_agent_that_goes_to_the_nearest_city_next():
    for instance in Cell(30, 3, 3).instances(1):
        tours = ortools.solve(instance, 5.0, 0, "first")
        assert sorted(tours) == [[0, 0], [0, 0], nearest_next(instance)]


@pytest.mark.slow
def test_a_descent_is_much_better_and_always_the_same():
    for instance in Cell(20, 3, 2).instances(2):
        first, descent = (ortools.solve(instance, 20.0, 0, search) for search in ("first", "greedy_descent"))
        assert makespan(instance, descent) < 0.6 * makespan(instance, first)
        assert descent == ortools.solve(instance, 20.0, 1, "greedy_descent")


@pytest.mark.slow
def test_guided_search_reaches_the_optimum_of_small_instances():
    for instance in [*Cell(7, 3, 2).instances(3), *Cell(8, 2, 2).instances(3)]:
        optimum = optimal_makespan(instance)
        tours = ortools.solve(instance, 0.3, 0, "guided")
        # SPAN_COST * longest + sum is minimal, and the optimum's sum is at most m times its longest tour
        slack = instance.n_agents * optimum / ortools.SPAN_COST + 10 / ortools.UNIT
        assert optimum - 1e-9 <= makespan(instance, tours) <= optimum + slack


def test_no_tour_is_longer_than_the_limit():
    (instance,) = Cell(30, 3, 1).instances(4)
    distance = whole_lengths(instance)
    limit = int(0.6 * ortools.UNIT * makespan(instance, [nearest_next(instance)]))
    problem = ortools.Problem(distance, 3, limit, "GREEDY_DESCENT")
    tours = problem.tours(problem.search(time.perf_counter() + 5.0, only_first=True))
    check_tours(instance, tours)
    assert ortools.UNIT * makespan(instance, tours) <= limit + 30


def test_agents_share_the_cities_before_guided_search():
    for instance in Cell(60, 4, 2).instances(5):
        distance, seconds = whole_lengths(instance), 5.0
        problem, assignment = ortools._share_cities(distance, 4, seconds, time.perf_counter() + seconds)
        share = makespan(instance, [nearest_next(instance)]) / 4
        tours = problem.tours(assignment)
        check_tours(instance, tours)
        assert makespan(instance, tours) < share + 2 * distance[0].max() / ortools.UNIT


def test_the_nearest_city_next_is_as_long_as_its_tour():
    (instance,) = Cell(30, 3, 1).instances(6)
    length = makespan(instance, [nearest_next(instance)])
    assert ortools._nearest_next(whole_lengths(instance)) == pytest.approx(ortools.UNIT * length, abs=30)


def test_unknown_searches_and_too_little_time_raise():
    (instance,) = Cell(8, 2, 1).instances(0)
    with pytest.raises(ValueError, match=r"unknown search 'magic'; choose from \['first'"):
        ortools.solve(instance, 1.0, 0, "magic")
    for search in SEARCHES:
        with pytest.raises(NoTours, match="path-cheapest-arc was not done within 1e-09 s"):
            ortools.solve(instance, 1e-9, 0, search)


def test_without_the_package_it_is_unavailable(monkeypatch):
    (instance,) = Cell(8, 2, 1).instances(0)
    monkeypatch.setitem(sys.modules, "ortools.constraint_solver", None)
    with pytest.raises(Unavailable, match="package ortools is missing"):
        ortools.solve(instance, 1.0, 0)
