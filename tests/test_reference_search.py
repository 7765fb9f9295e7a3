"""The reference solver from the inside: its rounds, its clock, its neighbour lists, the lengths that it keeps."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from helpers.insertion import greedy_insertion

from mtsp_env import Instance, check_tours, makespan, tour_lengths, uniform
from mtsp_env.instance import Tours
from mtsp_env.tours import path_lengths

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import annealing, improve, sisr, solver
from mtsp_env.reference import search as search_arrays
from mtsp_env.reference.annealing import END_TEMPERATURE, START_TEMPERATURE


def random_instance(seed: int, n_nodes: int, n_agents: int) -> Instance:
    return uniform(np.random.default_rng(seed), n_nodes, n_agents)


@pytest.fixture
def turns(monkeypatch) -> list[tuple[int, float, float]]:
    """Calls of the annealing kernel (iterations, first and last temperature); the clock gives each iteration 0.1 ms."""
    calls, anneal = [], sisr.anneal
    solver.compile_kernels()

    def recorded(search, iterations, hot, cold, *goal):
        calls.append((iterations, hot, cold))
        return anneal(search, iterations, hot, cold, *goal)

    clock = SimpleNamespace(perf_counter=lambda: 5.0 + 1e-4 * sum(iterations for iterations, _, _ in calls))
    monkeypatch.setattr(sisr, "anneal", recorded)
    for module in (solver, annealing):
        monkeypatch.setattr(module, "time", clock)
    return calls


# Quality


@pytest.mark.parametrize(("given", "total"), [(150, 150), (15, 15), (7, 7), (None, 500 * 40)])
def test_iterations_are_divided_into_four_rounds(turns: list, given: int | None, total: int) -> None:
    """Each round is twice as long as the one before. Unit of temperature: greedy makespan times sqrt(m / n)."""
    instance = random_instance(5, 40, 3)
    unit = makespan(instance, greedy_insertion(instance)) * math.sqrt(3 / 40)
    improve(instance, iterations=given)
    iterations, hot, cold = np.array(turns).T
    assert np.cumsum(iterations).tolist() == [math.ceil(total * part / 15) for part in (1, 3, 7, 15)]
    if total % 15 == 0:  # otherwise a round ends within an iteration
        assert hot == pytest.approx(START_TEMPERATURE * unit)
    assert cold == pytest.approx(END_TEMPERATURE * unit)


def test_with_seconds_the_temperature_follows_the_clock(turns: list) -> None:
    """1.5 s are 15,000 iterations, in turns of a hundredth; each turn starts at the last one's temperature."""
    improve(random_instance(5, 40, 3), seconds=1.5)
    iterations, hot, cold = np.array(turns).T
    assert iterations.sum() == pytest.approx(15000, rel=1e-3)
    assert iterations[1:].max() <= 151
    over = np.cumsum(iterations) / 1000
    ends = np.array([0, 1, 3, 7, 15])
    of_round = np.searchsorted(ends, over) - 1
    within = (over - ends[of_round]) / np.diff(ends)[of_round]
    inside = (over[1:-1] - ends[of_round[1:-1]] > 0.01) & (within[1:-1] < 0.99)  # not at the end of a round
    assert inside.sum() > 80
    assert cold[1:-1][inside] / hot[0] == pytest.approx((END_TEMPERATURE / START_TEMPERATURE) ** within[1:-1][inside])
    assert hot[2:][inside] == pytest.approx(cold[1:-1][inside])


@pytest.mark.parametrize(("seconds", "iterations", "done"), [(1e9, 1234, 1234), (0.1, 10**15, 1000)])
def test_the_limit_reached_first_ends_the_search(turns: list, seconds: float, iterations: int, done: int) -> None:
    improve(random_instance(5, 40, 3), seconds=seconds, iterations=iterations)
    assert done <= sum(turn for turn, _, _ in turns) <= min(done * 1.02, iterations)


# Seeds and batches


@pytest.mark.slow
@pytest.mark.parametrize(("n", "k"), [(2, 0), (3, 1), (40, 20), (40, 38), (299, 40), (300, 40), (700, 1)])
@pytest.mark.parametrize("coincide", [False, True])
def test_nearest_cities(n: int, k: int, coincide: bool) -> None:
    """From 300 nodes on a k-d tree finds them. Of equally near cities any may be listed."""
    nodes = np.random.default_rng(n).random((n, 2))
    if coincide:
        nodes = nodes[np.random.default_rng(0).integers(0, min(n, 4), n)]  # many in one place
    near, distance = search_arrays.nearest_cities(nodes[:, 0].copy(), nodes[:, 1].copy(), k)
    assert near.shape == distance.shape == (n, k)
    for city in range(1, n):
        others = sorted((math.dist(nodes[city], nodes[other]), other) for other in range(1, n) if other != city)[:k]
        assert len({0, city, *near[city].tolist()}) == k + 2  # other cities, each once
        assert distance[city] == pytest.approx([length for length, _ in others], abs=1e-12)
        assert distance[city] == pytest.approx(np.linalg.norm(nodes[near[city]] - nodes[city], axis=1), abs=1e-12)
        if not coincide:
            assert near[city].tolist() == [other for _, other in others]


@pytest.mark.parametrize("weight", [0.0, 0.5])
@pytest.mark.parametrize("hot", [1e-9, 1.0], ids=["cold", "hot"])
@pytest.mark.parametrize(("n", "m"), [(2, 1), (3, 1), (4, 3), (8, 2), (30, 1), (60, 5), (40, 30)])
def test_lengths_are_kept_up_to_date(n: int, m: int, hot: float, weight: float) -> None:
    """They equal the judge's after many iterations, accepted (hot) or undone (cold). A cold objective never grows."""

    def score(tours: Tours) -> float:
        lengths = tour_lengths(instance, tours)
        return lengths.max() + weight * lengths.sum()

    instance = random_instance(10, n, m)
    search = search_arrays.new_search(instance.nodes, m, seed=1)
    sisr.insert_greedily(search, np.arange(1, n))
    best, objective = sisr.sum_lengths(search) + weight * search.length.sum(), math.inf
    for _ in range(10):
        best = sisr.anneal(search, 300, hot, hot, best, -1.0, weight)
        assert score(search_arrays.as_tours(sisr.best_order(search), m)) == pytest.approx(best)

        now = search._replace(best=search.next)
        tours = search_arrays.as_tours(sisr.best_order(now), m)
        check_tours(instance, tours)
        assert search.length == pytest.approx(tour_lengths(instance, tours), abs=1e-10)
        assert search.n_movable.tolist() == [len(tour) - 2 for tour in tours]
        assert (search.previous[search.next] == np.arange(n + m)).all()
        if hot < 1e-6:
            before, objective = objective, search.length.max() + sisr.TOTAL_WEIGHT * search.length.sum()
            assert objective <= before + 1e-6


def test_tours_are_loaded_as_given() -> None:
    """Except that idle agents come last and visits to the depot in the middle are left out. Old tours are replaced."""
    search = search_arrays.new_search(np.random.default_rng(0).random((6, 2)), 4, seed=0)
    sisr.insert_greedily(search, np.arange(1, 6))
    tours = [[0, 0], [0, 3, 0, 0, 1, 0], [0, 0], [0, 5, 2, 4, 0]]
    sisr.load_tours(search, search_arrays.as_order(tours, 5 + 4))
    assert search_arrays.as_tours(sisr.best_order(search), 5) == [[0, 3, 1, 0], [0, 5, 2, 4, 0], [0, 0], [0, 0], [0, 0]]
    assert sisr.sum_lengths(search) == pytest.approx(
        path_lengths(np.stack([search.x, search.y], 1)[:6], [[0, 3, 1, 0], tours[3]]).max()
    )


def test_rounds_begin_with_the_best_tours(monkeypatch) -> None:
    anneal = sisr.anneal
    bests = []

    def checked(search, iterations, hot, cold, best, *goal):
        bests.append(best)
        assert sisr.sum_lengths(search) == pytest.approx(best)
        return anneal(search, iterations, hot, hot, best, *goal)  # always hot: ends far from the best tours

    monkeypatch.setattr(sisr, "anneal", checked)
    improve(random_instance(11, 50, 4), iterations=1500)
    assert len(bests) == 4 and bests[0] > bests[-1]


# Bad input
