"""The reference solver: optimal on small instances, never worse than given tours, reproducible from its seed."""

import copy
import itertools
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.insertion import greedy_insertion
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, clustered, lower_bound, machine, makespan, uniform
from mtsp_env.instance import Tours
from mtsp_env.tours import path_lengths

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import improve, improve_batch, sisr, solver

ROOT = Path(__file__).parents[1]


def random_instance(seed: int, n_nodes: int, n_agents: int) -> Instance:
    return uniform(np.random.default_rng(seed), n_nodes, n_agents)


def optimum(instance: Instance) -> float:
    """The least makespan: tries all orders of every set of cities, then all partitions into one set per agent."""
    nodes, n = instance.nodes, instance.n_nodes
    distance = np.linalg.norm(nodes[:, None] - nodes, axis=2)  # (n, n)
    shortest = np.zeros(2 ** (n - 1))  # of each set of cities: bit c - 1 stands for city c
    for chosen in range(1, len(shortest)):
        cities = [city for city in range(1, n) if chosen >> (city - 1) & 1]
        orders = np.array(list(itertools.permutations(cities)))
        tours = np.pad(orders, ((0, 0), (1, 1)))
        shortest[chosen] = distance[tours[:, :-1], tours[:, 1:]].sum(axis=1).min()
    best = shortest  # with one agent; each further agent takes any part of the cities
    for _ in range(instance.n_agents - 1):
        best = [min(max(shortest[p], best[s - p]) for p in range(s + 1) if p & s == p) for s in range(len(shortest))]
    return best[-1]


points = st.tuples(*[st.integers(0, 3).map(lambda k: k / 3) | st.floats(0, 1)] * 2)  # many coincide
instances = st.builds(Instance, st.lists(points, min_size=2, max_size=14), st.integers(1, 16))


@st.composite
def instances_and_tours(draw: st.DrawFn) -> tuple[Instance, Tours]:
    """An instance and tours that solve it. They may pass the depot in the middle, and agents may stay at home."""
    instance = draw(instances)
    tours = [[0] for _ in range(instance.n_agents)]
    for city in draw(st.permutations(range(1, instance.n_nodes))):
        tours[draw(st.integers(0, instance.n_agents - 1))] += [0, city] if draw(st.booleans()) else [city]
    return instance, [[*tour, 0] for tour in tours]


def test_square_by_hand(square: Instance) -> None:
    tours = improve(square, iterations=1000)
    assert makespan(square, tours) == 2.0
    assert sorted(sorted(tour[1:-1]) for tour in tours) == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("n_agents", [1, 2, 3, 4])
@pytest.mark.parametrize("n_nodes", [2, 3, 4, 5, 6, 7, 8])
def test_small_instances_are_solved_to_the_optimum(n_nodes: int, n_agents: int) -> None:
    rng = np.random.default_rng([n_nodes, n_agents])
    for make in (uniform, clustered):
        instance = make(rng, n_nodes, n_agents)
        assert makespan(instance, improve(instance, iterations=1000)) == pytest.approx(optimum(instance), abs=1e-9)


@pytest.mark.slow
def test_a_few_milliseconds_give_near_optimal_tours() -> None:
    """n = 50, m = 5: on average 2000 iterations are within 1 % of 20,000; greedy insertion is more than 15 % off."""
    nodes = np.random.default_rng(0).random((12, 50, 2))
    start, short, long = (
        np.mean(
            [makespan(Instance(row, 5), tours) for row, tours in zip(nodes, improve_batch(nodes, 5, k), strict=True)]
        )
        for k in (0, 2000, 20000)
    )
    assert long <= short < 1.01 * long
    assert start > 1.15 * long


def test_a_travelling_salesman_goes_round_a_circle() -> None:
    """One agent: points on a circle are best visited in their order around it."""
    angles = np.random.default_rng(1).random(40) * 2 * math.pi
    nodes = 0.5 + 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    tour = improve(Instance(nodes, n_agents=1))[0]
    around = np.argsort(angles).tolist()
    ring = [*around[around.index(0) :], *around[: around.index(0)], 0]
    assert tour in (ring, ring[::-1])


def test_without_iterations_the_result_is_greedy_insertion() -> None:
    for seed, (n_nodes, n_agents) in enumerate([(2, 1), (9, 3), (30, 4), (12, 20)]):
        instance = random_instance(seed, n_nodes, n_agents)
        tours, expected = improve(instance, iterations=0), greedy_insertion(instance)
        assert [min(tour, tour[::-1]) for tour in tours] == [min(tour, tour[::-1]) for tour in expected]


@pytest.mark.slow
def test_greedy_insertion_next_to_near_cities_is_nearly_as_short_as_anywhere() -> None:
    """n = 120: a city goes next to one of its 40 nearest or to the depot, not next to any other city."""
    ratios = []
    for seed in range(10):
        instance = random_instance(seed, 120, 4)
        everywhere = makespan(instance, greedy_insertion(instance))
        ratios.append(makespan(instance, improve(instance, iterations=0)) / everywhere)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.02)


# Limits


@pytest.mark.slow
def test_large_instances_are_prepared_without_trying_all_pairs(monkeypatch) -> None:
    """Trying all pairs of 20,000 nodes takes seconds."""
    monkeypatch.setattr(sisr, "nearest_cities", lambda *_: pytest.fail("tried all pairs"))
    instance = random_instance(0, 20_000, 10)
    solver.compile_kernels()
    tours = improve(instance, iterations=100)
    check_tours(instance, tours)
    assert makespan(instance, tours) < 1.9 * lower_bound(instance)  # near-optimal tours: about 1.1 times


@pytest.mark.parametrize(
    ("n_nodes", "n_agents", "message"),
    [
        (70_000, 2, "n_nodes 70000 needs about 0.13 GiB of memory, of which 0.125 GiB are free; at most 67108 fits"),
        (
            3,
            700_000,
            "n_agents 700000 needs about 0.13 GiB of memory, of which 0.125 GiB are free; at most 671088 fits",
        ),
    ],
)
def test_what_does_not_fit_into_the_memory_is_refused(monkeypatch, n_nodes: int, n_agents: int, message: str) -> None:
    monkeypatch.setattr(machine, "available_memory", lambda: 2**27)
    nodes = np.random.default_rng(0).random((1, n_nodes, 2))
    with pytest.raises(ValueError, match=message):
        improve(Instance(nodes[0], n_agents), iterations=0)
    with pytest.raises(ValueError, match=message):
        improve_batch(nodes, n_agents, iterations=0)


# Any instance


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(instances, st.sampled_from([0, 1, 40]), st.integers(0, 2**70))
def test_tours_are_valid(instance: Instance, iterations: int, seed: int) -> None:
    tours = improve(instance, iterations=iterations, seed=seed)
    check_tours(instance, tours)
    assert makespan(instance, tours) >= lower_bound(instance) - 1e-9
    assert all(0 not in tour[1:-1] and all(type(node) is int for node in tour) for tour in tours)


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(instances_and_tours(), st.sampled_from([0, 1, 40]))
def test_given_tours_are_never_made_worse(problem: tuple[Instance, Tours], iterations: int) -> None:
    instance, tours = problem
    before = copy.deepcopy(tours)
    improved = improve(instance, tours, iterations=iterations)
    check_tours(instance, improved)
    assert makespan(instance, improved) <= makespan(instance, tours)
    assert tours == before


def test_optimal_tours_are_returned_as_a_copy(square: Instance, square_tours: Tours) -> None:
    improved = improve(square, square_tours, iterations=100)
    assert improved == square_tours
    improved[0].reverse()
    assert improved != square_tours

    idle_first = [[0, 0], [0, 2, 0, 1, 0]]  # passes the depot, where all cities are
    assert improve(Instance([[0.5, 0.5]] * 3, n_agents=2), idle_first, iterations=100) == idle_first


def test_the_search_starts_from_the_better_of_the_given_tours_and_greedy_insertion(monkeypatch) -> None:
    instance, starts = random_instance(3, 60, 3), []
    good, greedy = improve(instance, iterations=1000), improve(instance, iterations=0)
    bad = [[0, *range(1, 60), 0], [0, 0], [0, 0]]
    monkeypatch.setattr(sisr, "anneal", lambda search, iterations, hot, cold, best, *_: starts.append(best) or best)
    assert improve(instance, good) == good
    assert improve(instance, bad) == greedy
    expected = [makespan(instance, good), makespan(instance, greedy)]
    assert expected[0] < expected[1]
    assert starts == pytest.approx(np.repeat(expected, 4).tolist())  # in each of the four rounds


@pytest.mark.parametrize("nodes", [[[0.25, 0.5]] * 5, [[0.0, 0.0], *[[1.0, 1.0]] * 6]], ids=["one place", "two places"])
@pytest.mark.parametrize("n_agents", [1, 3, 9])
def test_coincident_cities(nodes: list, n_agents: int) -> None:
    """If all cities are in one place, one agent can visit all of them at no extra cost, so one trip is optimal."""
    instance = Instance(nodes, n_agents)
    assert makespan(instance, improve(instance, iterations=10)) == 2 * math.dist(*nodes[:2])


# The end of a search


@pytest.mark.parametrize("limit", [{"iterations": 10**15}, {"seconds": 1e9}, {"iterations": 10**15, "seconds": 1e9}])
def test_the_search_ends_at_the_lower_bound(limit: dict) -> None:
    """Without this rule it would not end here. With 20 agents the farthest city alone sets the makespan."""
    instance = random_instance(0, 60, 20)
    assert makespan(instance, improve(instance, iterations=0)) > lower_bound(instance) + 1e-3
    assert makespan(instance, improve(instance, **limit)) <= lower_bound(instance) + 1e-9


def test_the_seed_determines_the_tours() -> None:
    instance = random_instance(6, 60, 4)
    one, again, other = (improve(instance, iterations=300, seed=seed) for seed in (7, 7, 8))
    assert one == again != other


@pytest.mark.parametrize("threads", [None, 1, 2, 5])
def test_a_batch_gives_the_same_tours_as_its_rows(threads: int | None) -> None:
    nodes = np.random.default_rng(8).random((7, 30, 2))
    rows = [improve(Instance(row, 3), iterations=200, seed=9) for row in nodes]
    assert improve_batch(nodes, 3, iterations=200, seed=9, threads=threads) == rows


def test_tidy_tours_are_shorter_in_total() -> None:
    """With 12 agents the farthest city sets the makespan: the other tours can be shorter at no cost."""
    nodes = np.random.default_rng(3).random((6, 40, 2))
    for row, loose, tidy in zip(
        nodes, *(improve_batch(nodes, 12, 4000, tidy=tidy) for tidy in (False, True)), strict=True
    ):
        instance = Instance(row, 12)
        check_tours(instance, tidy)
        assert makespan(instance, loose) == pytest.approx(lower_bound(instance))  # which ended that search
        assert makespan(instance, tidy) <= 1.005 * makespan(instance, loose)
        assert path_lengths(row, tidy).sum() < 0.9 * path_lengths(row, loose).sum()


def test_empty_float32_and_strided_batches() -> None:
    nodes = np.random.default_rng(8).random((2, 6, 2), dtype=np.float32)
    assert improve_batch(nodes[:0], 3) == []
    assert improve_batch(nodes[:, :, ::-1][::-1], 9, iterations=50) == [
        improve(Instance(row[:, ::-1], 9), iterations=50) for row in nodes[::-1]
    ]


# Kernels


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seconds": 0}, "seconds must be a finite number of seconds above 0, got 0"),
        ({"seconds": -1.0}, "seconds must be a finite number of seconds above 0, got -1.0"),
        ({"seconds": math.nan}, "seconds must be a finite number of seconds above 0, got nan"),
        ({"seconds": math.inf}, "seconds must be a finite number of seconds above 0, got inf"),
        ({"seconds": "soon"}, "seconds must be a finite number of seconds above 0, got 'soon'"),
        ({"seconds": True}, "seconds must be a finite number of seconds above 0, got True"),
        ({"iterations": -1}, "iterations must be a whole number of at least 0, got -1"),
        ({"iterations": 1.5}, "iterations must be a whole number of at least 0, got 1.5"),
        ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
        ({"seed": None}, "seed must be a whole number of at least 0, got None"),
        ({"tours": [[0, 1, 2, 3, 4, 5, 6, 0]]}, "expected 2 tours"),
        ({"tours": [[0, 1, 2, 3, 0], [0, 4, 5, 0]]}, "city 6 missing"),
    ],
)
def test_bad_arguments_are_named(square: Instance, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        improve(square, **arguments)


@pytest.mark.parametrize(
    ("nodes", "arguments", "message"),
    [
        (np.zeros((4, 2)), {}, r"nodes must have shape \(B, n, 2\), got \(4, 2\)"),
        (np.zeros((3, 4, 3)), {}, r"nodes must have shape \(n, 2\), got \(3, 4, 3\)"),
        (np.zeros((3, 1, 2)), {}, "n_nodes must be a whole number of at least 2, got 1"),
        (np.full((3, 4, 2), np.nan), {}, "nodes must be finite"),
        (np.full((3, 4, 2), 1.5), {}, r"nodes must be in \[0, 1\]"),
        (np.zeros((3, 4, 2)), {"n_agents": 0}, "n_agents must be a whole number of at least 1, got 0"),
        (np.zeros((3, 4, 2)), {"threads": 0}, "threads must be a whole number of at least 1, got 0"),
        (np.zeros((3, 4, 2)), {"iterations": -1}, "iterations must be a whole number of at least 0, got -1"),
        (np.zeros((3, 4, 2)), {"seed": -1}, "seed must be a whole number of at least 0, got -1"),
    ],
)
def test_bad_batches_are_named(nodes: np.ndarray, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        improve_batch(nodes, **{"n_agents": 2, **arguments})


@pytest.mark.slow
@pytest.mark.parametrize("package", ["numba", "scipy"])
def test_without_a_package_the_extra_is_named(package: str) -> None:
    code = f"import sys; sys.modules['{package}'] = None\nimport mtsp_env, mtsp_env.reference"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert f"mtsp_env.reference needs {package}: pip install 'mtsp-env[reference]'" in run.stderr
