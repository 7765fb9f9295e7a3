"""The judge of tours: lengths by hand, every kind of invalid tour, and a bound below every solution."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, from_coordinates, lower_bound, makespan, tour_lengths
from mtsp_env.tours import farthest_trip, path_lengths


def shortest_tours(nodes: np.ndarray) -> dict[frozenset[int], float]:
    """The shortest tour through the depot and each set of cities, by trying all orders."""
    cities = range(1, len(nodes))
    return {
        frozenset(chosen): min(
            sum(math.dist(nodes[a], nodes[b]) for a, b in itertools.pairwise([0, *order, 0]))
            for order in itertools.permutations(chosen)
        )
        for size in range(len(nodes))
        for chosen in itertools.combinations(cities, size)
    }


def optimum(instance: Instance) -> float:
    """The least makespan, by trying all assignments of cities to agents."""
    tours = shortest_tours(instance.nodes)
    n_cities, agents = instance.n_nodes - 1, range(instance.n_agents)
    return min(
        max(tours[frozenset(city for city in range(1, n_cities + 1) if owner[city - 1] == agent)] for agent in agents)
        for owner in itertools.product(agents, repeat=n_cities)
    )


points = st.tuples(*[st.integers(0, 4).map(lambda k: k / 4) | st.floats(0, 1)] * 2)
small = st.builds(Instance, st.lists(points, min_size=2, max_size=6), st.integers(1, 3))


# Lengths


def test_square_by_hand(square: Instance, square_tours: list[list[int]]) -> None:
    check_tours(square, square_tours)
    assert tour_lengths(square, square_tours).tolist() == [2.0, 2.0]
    assert makespan(square, square_tours) == optimum(square) == 2.0


def test_lengths_by_hand() -> None:
    nodes = [[0.0, 0.0], [3.0, 4.0], [3.0, 0.0]]
    paths = [[0, 1, 2, 0], [0, 1, 0], [0, 0], [0], [0, 2, 1]]
    assert path_lengths(np.array(nodes), paths).tolist() == [12, 10, 0, 0, 7]
    instance = from_coordinates(nodes, 2)  # scale 4: the extent of the nodes
    assert (tour_lengths(instance, paths) * instance.scale).tolist() == [12, 10, 0, 0, 7]
    assert makespan(instance, [[0, 1, 0], [0, 2, 0]]) * instance.scale == 10.0
    assert makespan(instance, []) == 0.0


@pytest.mark.slow
@settings(deadline=None)
@given(small, st.randoms(use_true_random=False))
def test_a_tour_is_as_long_backwards(instance: Instance, random) -> None:
    order = list(range(1, instance.n_nodes))
    random.shuffle(order)
    there, back = tour_lengths(instance, [[0, *order, 0], [0, *order[::-1], 0]])
    assert there == pytest.approx(back, abs=1e-12)


# Validity


@st.composite
def instances_and_tours(draw) -> tuple[Instance, list[list[int]]]:
    """An instance and tours that solve it, some of which pass the depot in the middle."""
    instance = draw(small)
    tours = [[0] for _ in range(instance.n_agents)]
    for city in draw(st.permutations(range(1, instance.n_nodes))):
        tour = tours[draw(st.integers(0, instance.n_agents - 1))]
        tour.extend([0, city] if draw(st.booleans()) else [city])
    return instance, [[*tour, 0] for tour in tours]


@pytest.mark.slow
@settings(deadline=None)
@given(instances_and_tours())
def test_valid_tours_pass_and_no_bound_is_above_them(case: tuple) -> None:
    instance, tours = case
    check_tours(instance, tours)
    check_tours(instance, [np.array(tour) for tour in tours])
    assert lower_bound(instance) <= makespan(instance, tours) + 1e-12


@pytest.mark.slow
@settings(deadline=None)
@given(instances_and_tours(), st.data())
def test_a_missing_and_a_repeated_city_are_named(case: tuple, data: st.DataObject) -> None:
    instance, tours = case
    city = data.draw(st.integers(1, instance.n_nodes - 1))
    missing = [[node for node in tour if node != city] for tour in tours]
    with pytest.raises(ValueError, match=f"^city {city} missing from the tours$"):
        check_tours(instance, missing)
    chosen = data.draw(st.integers(0, len(tours) - 1))
    repeated = [[*tour[:-1], city, 0] if agent == chosen else tour for agent, tour in enumerate(tours)]
    with pytest.raises(ValueError, match=f"^city {city} visited more than once$"):
        check_tours(instance, repeated)


@pytest.mark.parametrize(
    ("tours", "message"),
    [
        ([[0, 2, 1, 3, 4, 5, 6, 0]], "expected 2 tours, one per agent, got 1"),
        ([[0, 2, 1, 3, 0], [0, 4, 5, 6, 0], [0, 0]], "expected 2 tours, one per agent, got 3"),
        ([[0, 2, 1, 3, 0], [0, 4, 5, 6]], "tour 1 must begin and end at the depot 0, got 0 and 6"),
        ([[2, 1, 3, 0], [0, 4, 5, 6, 0]], "tour 0 must begin and end at the depot 0, got 2 and 0"),
        ([[0, 2, 1, 3, 0], [0, 4, 5, 7, 0]], r"tour 1 visits node 7, outside 0\.\.6"),
        ([[0, 2, 1, -3, 0], [0, 4, 5, 6, 0]], r"tour 0 visits node -3, outside 0\.\.6"),
        ([[0, 2, 1, 3, 0], [0, 4, 5, 6.0, 0]], "tour 1 must be a list of at least 2 node numbers"),
        ([[0, 2, 1, 3, 0], []], "tour 1 must be a list of at least 2 node numbers"),
        ([[0], [0, 2, 1, 3, 4, 5, 6, 0]], "tour 0 must be a list of at least 2 node numbers"),
        ([[0, 2, 1, 3, 0], [[0, 4, 5, 6, 0]]], "tour 1 must be a list of at least 2 node numbers"),
        ([[0, 0], [0, 4, 5, 0]], "cities 1, 2, 3, 6 missing from the tours"),
        ([[0, 0], [0, 0]], r"cities 1, 2, 3, 4, 5, \.\.\. missing from the tours"),
        ([[0, 2, 1, 3, 0], [0, 3, 4, 5, 6, 2, 0]], "cities 2, 3 visited more than once"),
    ],
)
def test_invalid_tours_are_refused(square: Instance, tours: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_tours(square, tours)


def test_staying_at_home_is_valid(square: Instance) -> None:
    check_tours(square, [[0, 0], [0, 2, 1, 3, 0, 4, 5, 6, 0]])


# The bound


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(small)
def test_no_solution_is_below_the_bound(instance: Instance) -> None:
    assert 0.0 <= lower_bound(instance) <= optimum(instance) + 1e-12


def test_the_bound_by_hand(square: Instance) -> None:
    assert lower_bound(square) == 1.5  # a tree of 6 edges of 0.5, shared by two; the corners are only 0.707 away
    assert lower_bound(Instance(square.nodes, 3)) == math.sqrt(2.0)  # now the trip to a corner is longer
    twice = Instance(square.nodes, 2, speeds=[2.0, 2.0], service=[0.0] + [0.1] * 6)
    assert lower_bound(twice) == pytest.approx((3.0 + 6 * 0.1 * 2.0) / 4.0)  # the same tree, and six visits
    slow = Instance(square.nodes, 2, speeds=[0.1, 0.2], service=[0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert lower_bound(slow) == pytest.approx((3.0 + 0.1) / 0.3)
    assert lower_bound(Instance(square.nodes, 2, service=slow.service * 3)) == pytest.approx(math.sqrt(2.0) + 3.0)
    ell = Instance([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]], 1)
    assert lower_bound(ell) == 3.0


@pytest.mark.parametrize(
    ("nodes", "n_agents", "best"),
    [
        ([[0.2, 0.2], [0.2, 0.9]], 3, 1.4),  # one city
        ([[0.0, 0.0], [0.3, 0.0], [0.5, 0.0], [1.0, 0.0]], 1, 2.0),  # all on the way to the farthest
        ([[0.5, 0.5], [1.0, 0.5], [0.5, 0.9], [0.5, 0.0]], 3, 1.0),  # one agent per city
        ([[0.7, 0.3]] * 4, 2, 0.0),  # all in one place
    ],
)
def test_the_bound_is_the_optimum_if_the_farthest_city_sets_the_makespan(
    nodes: list, n_agents: int, best: float
) -> None:
    instance = Instance(nodes, n_agents)
    assert lower_bound(instance) == pytest.approx(best, abs=1e-12)
    assert optimum(instance) == pytest.approx(best, abs=1e-12)


def test_the_farthest_trip(square: Instance) -> None:
    assert farthest_trip(square.nodes) == math.sqrt(2.0)
    assert farthest_trip([[3, 4], [0, 0], [3, 5]]) == 10.0


@pytest.mark.slow
@settings(deadline=None)
@given(small)
def test_with_an_agent_for_each_city_the_farthest_trip_is_the_optimum(instance: Instance) -> None:
    many = Instance(instance.nodes, max(instance.n_nodes - 1, instance.n_agents))
    tours = [[0, city, 0] for city in range(1, many.n_nodes)]
    tours += [[0, 0]] * (many.n_agents - len(tours))
    check_tours(many, tours)
    assert makespan(many, tours) == pytest.approx(farthest_trip(instance.nodes), abs=1e-12)
    assert farthest_trip(instance.nodes) <= lower_bound(instance)


@pytest.mark.slow
@settings(deadline=None)
@given(small, st.floats(0.01, 1.0))
def test_the_bound_grows_with_the_map(instance: Instance, factor: float) -> None:
    smaller = Instance(instance.nodes * factor, instance.n_agents)
    assert lower_bound(smaller) == pytest.approx(factor * lower_bound(instance), abs=1e-12)
