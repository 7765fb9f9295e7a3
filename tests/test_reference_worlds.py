"""The reference solver in worlds with speeds and service, and around agents that have stopped."""

import math

import numpy as np
import pytest
from helpers.completions import least_makespan
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, makespan
from mtsp_env.instance import Tours
from mtsp_env.tours import is_closed, tour_times

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import improve, plan_rest, sisr
from mtsp_env.reference import search as search_arrays

points = st.tuples(*[st.integers(0, 3).map(lambda k: k / 3) | st.floats(0, 1)] * 2)  # many coincide
speeds = st.sampled_from([0.1, 0.5, 1.0, 3.0]) | st.floats(0.3, 3.0)
visits = st.sampled_from([0.0, 0.1, 5.0]) | st.floats(0.0, 1.0)


@st.composite
def worlds(draw: st.DrawFn, max_nodes: int = 6, max_agents: int = 3) -> Instance:
    """An instance with speeds, service or both."""
    nodes = draw(st.lists(points, min_size=2, max_size=max_nodes))
    n, m = len(nodes), draw(st.integers(1, max_agents))
    fields = draw(st.sampled_from([("speeds",), ("service",), ("speeds", "service")]))
    world = {
        "speeds": draw(st.lists(speeds, min_size=m, max_size=m)),
        "service": [0.0, *draw(st.lists(visits, min_size=n - 1, max_size=n - 1))],
    }
    return Instance(nodes, m, **{name: world[name] for name in fields})


@st.composite
def teams_under_way(
    draw: st.DrawFn, max_nodes: int = 6, max_agents: int = 3
) -> tuple[Instance, Tours, Tours, set[int]]:
    """An instance, prefixes of its tours, some of them closed, tours that begin with them, and the stopped agents."""
    instance = draw(worlds(max_nodes, max_agents))
    tours: Tours = [[0] for _ in range(instance.n_agents)]
    for city in draw(st.permutations(range(1, instance.n_nodes))):
        tours[draw(st.integers(0, instance.n_agents - 1))].append(city)
    prefixes = [tour[: draw(st.integers(1, len(tour)))] for tour in tours]
    finished = {agent for agent, tour in enumerate(tours) if tour == prefixes[agent]}
    stopped = {agent for agent in finished if draw(st.booleans())}
    tours = [tour if agent in stopped else [*tour, 0] for agent, tour in enumerate(tours)]
    closed = {agent for agent in finished - stopped if draw(st.booleans())}
    prefixes = [tours[agent] if agent in closed else prefix for agent, prefix in enumerate(prefixes)]
    return instance, prefixes, tours, stopped


def check_kept(instance: Instance, prefixes: Tours, tours: Tours, stopped: set[int]) -> None:
    """The tours solve the instance and begin with the prefixes; those of finished agents are the prefixes."""
    check_tours(instance, [[*tour, 0] if agent in stopped else tour for agent, tour in enumerate(tours)])
    for agent, (prefix, tour) in enumerate(zip(prefixes, tours, strict=True)):
        assert tour[: len(prefix)] == prefix
        assert tour == prefix or not (agent in stopped or is_closed(prefix))


@pytest.mark.slow
@given(worlds())
@settings(max_examples=60, deadline=None)
def test_small_instances_are_solved_to_the_optimum(instance: Instance) -> None:
    tours = improve(instance, iterations=20_000)  # if speeds differ by a factor of 30, 2,000 may not suffice
    check_tours(instance, tours)
    least = least_makespan(instance, [[0] for _ in range(instance.n_agents)])
    assert makespan(instance, tours) == pytest.approx(least, abs=1e-9)


@pytest.mark.slow
@given(teams_under_way())
@settings(max_examples=60, deadline=None)
def test_teams_under_way_are_completed_optimally(case: tuple) -> None:
    instance, prefixes, _, stopped = case
    tours = improve(instance, iterations=20_000, prefixes=prefixes, stopped=stopped)
    check_kept(instance, prefixes, tours, stopped)
    assert makespan(instance, tours) == pytest.approx(least_makespan(instance, prefixes, stopped), abs=1e-9)


@pytest.mark.slow
@given(teams_under_way(max_nodes=14, max_agents=5), st.integers(0, 300))
@settings(max_examples=100, deadline=None)
def test_given_tours_are_never_made_worse(case: tuple, iterations: int) -> None:
    instance, prefixes, tours, stopped = case
    improved = improve(instance, tours, iterations=iterations, prefixes=prefixes, stopped=stopped)
    check_kept(instance, prefixes, improved, stopped)
    assert makespan(instance, improved) <= makespan(instance, tours)


@pytest.mark.parametrize("fields", [("speeds",), ("service",), ("speeds", "service")])
@pytest.mark.parametrize("hot", [1e-9, 1.0], ids=["cold", "hot"])
@pytest.mark.parametrize(("n", "m"), [(2, 1), (4, 3), (30, 1), (60, 5), (40, 30)])
def test_the_search_counts_times_as_the_judge_does(n: int, m: int, hot: float, fields: tuple[str, ...]) -> None:
    """After many iterations, accepted (hot) or undone (cold), its times and its objective are the judge's."""
    rng = np.random.default_rng(n)
    world = {"speeds": rng.uniform(0.5, 1.5, m), "service": np.append(0.0, rng.uniform(0.0, 0.1, n - 1))}
    instance = Instance(rng.random((n, 2)), m, **{name: world[name] for name in fields})
    search = search_arrays.new_search(instance.nodes, m, 1, instance.speeds, instance.service)
    sisr.insert_greedily(search, np.arange(1, n))
    best = sisr.sum_lengths(search)
    for _ in range(10):
        best = sisr.anneal(search, 300, hot, hot, best, -1.0, 0.0)
        tours = search_arrays.as_tours(sisr.best_order(search), m)
        assert makespan(instance, tours) == pytest.approx(best, abs=1e-10)
        now = search_arrays.as_tours(sisr.best_order(search._replace(best=search.next)), m)
        check_tours(instance, now)
        assert search.length == pytest.approx(tour_times(instance, now), abs=1e-10)


def test_speeds_of_one_and_visits_without_time_change_nothing() -> None:
    """Bit for bit: the kernels for worlds make the same search as those for plain problems."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        nodes, prefixes = rng.random((30, 2)), [[0, 3, 7], [0], [0, 5, 0], [0]]
        plain, team = Instance(nodes, 4), Instance(nodes, 4, speeds=np.ones(4), service=np.zeros(30))
        assert improve(team, iterations=800, prefixes=prefixes) == improve(plain, iterations=800, prefixes=prefixes)
        visits = Instance(nodes, 4, service=np.zeros(30))
        assert improve(visits, iterations=800) == improve(plain, iterations=800)


def test_fast_agents_drive_farther() -> None:
    """By hand: the fast agent visits both cities in time 1, before the slow one is back from the nearer city."""
    instance = Instance([[0.2, 0.0], [1.0, 0.0], [0.0, 0.0]], 2, speeds=[0.25, 2.0])
    tours = improve(instance, iterations=200)
    assert tours[0] == [0, 0]
    assert makespan(instance, tours) == pytest.approx(1.0)


def test_more_agents_than_cities_leave_the_slow_ones_at_home() -> None:
    instance = Instance([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], 5, speeds=[0.1, 3.0, 0.2, 1.0, 4.0])
    tours = improve(instance, iterations=500)
    assert makespan(instance, tours) == pytest.approx(2 / 3)
    assert [len(tour) for tour in tours] == [2, 3, 2, 2, 3]


def test_the_rest_of_the_tours_begins_at_the_heads() -> None:
    """By hand: an agent that is free later gets the nearer city, and one that has stopped gets none."""
    instance = Instance([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5], [0.0, 1.0], [0.25, 0.0]], 3)
    rest = plan_rest(instance, [1, 2, None], np.array([2.0, 0.5, 0.0]), [3, 4], iterations=300)
    assert rest == [[4], [3], []]
    assert plan_rest(instance, [1, 2, None], np.zeros(3), [], iterations=5) == [[], [], []]
    with pytest.raises(ValueError, match="2 cities are left, and every agent has stopped"):
        plan_rest(instance, [None, None, None], np.zeros(3), [3, 4], iterations=5)


@pytest.mark.slow
@given(worlds(max_nodes=12), st.data())
@settings(max_examples=60, deadline=None)
def test_cities_missing_in_the_given_routes_are_inserted(instance: Instance, data: st.DataObject) -> None:
    cities = list(range(1, instance.n_nodes))
    order = data.draw(st.permutations(cities))[: data.draw(st.integers(0, len(cities)))]
    routes: Tours = [[] for _ in range(instance.n_agents)]
    for city in order:
        routes[data.draw(st.integers(0, instance.n_agents - 1))].append(city)
    driven = np.zeros(instance.n_agents)
    rest = plan_rest(instance, [0] * instance.n_agents, driven, cities, routes, iterations=0)
    tours = [[0, *route, 0] for route in rest]
    check_tours(instance, tours)
    greedy = plan_rest(instance, [0] * instance.n_agents, driven, cities, iterations=0)
    assert makespan(instance, tours) <= makespan(instance, [[0, *route, 0] for route in greedy]) + 1e-9
    if len(order) == len(cities):
        assert makespan(instance, tours) <= makespan(instance, [[0, *route, 0] for route in routes]) + 1e-9


@pytest.mark.parametrize(
    "world", [{"appears": [0.0, 1.0, 0.0]}, {"breaks": [1.0, math.inf]}, {"traffic": [[1.0], [2.0]]}], ids=str
)
def test_worlds_that_change_are_refused(world: dict) -> None:
    instance = Instance([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], 2, speeds=[1.0, 2.0], **world)
    with pytest.raises(
        ValueError, match=rf"world with \['{next(iter(world))}'\]: mtsp_env.replan.Replanner plans again"
    ):
        improve(instance)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stopped": [2]}, r"stopped must name agents in 0\.\.1, got 2"),
        ({"stopped": [-1]}, "an agent in stopped must be a whole number of at least 0, got -1"),
        ({"stopped": [0, 1]}, "all agents are stopped or home for good, and 6 cities are left"),
        (
            {"stopped": [0], "prefixes": [[0], [0, 1, 0]]},
            "all agents are stopped or home for good, and 5 cities are left",
        ),
        ({"stopped": [0], "tours": [[0, 1, 0], [0, 2, 3, 4, 5, 6, 0]]}, r"tour 0 must be its prefix \[0\]"),
    ],
)
def test_bad_arguments_are_named(square: Instance, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        improve(square, **arguments)
