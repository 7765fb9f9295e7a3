"""Self-organising maps: short rings win, a neuron wins one city, and the guided evolution starts from the maps."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest

pytest.importorskip("numba")

from helpers.odd import ODD

from benchmarks.solvers import som
from benchmarks.suite import Cell
from mtsp_env import Instance, check_tours, lower_bound, makespan


def ring_lengths(rings: np.ndarray) -> np.ndarray:
    return np.linalg.norm(rings - np.roll(rings, 1, axis=1), axis=-1).sum(axis=1)


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.slow
def test_tiny_instances_are_solved_in_time_and_reproducibly(guided):
    som._compile()
    for instance in Cell(8, 2, 3).instances(0):
        began = time.perf_counter()
        check_tours(instance, som.solve(instance, 0.2, 0, guided))
        assert time.perf_counter() - began < 1.2 * 0.2 + 0.5
        tours = som.solve(instance, 60.0, 1, guided, maps=2, generations=5)
        check_tours(instance, tours)
        assert tours == som.solve(instance, 60.0, 1, guided, maps=2, generations=5)
    (instance,) = Cell(50, 5, 1).instances(0)
    assert som.solve(instance, 60.0, 1, guided, 2, 5) != som.solve(instance, 60.0, 2, guided, 2, 5)


@pytest.mark.slow
@pytest.mark.parametrize("guided", [False, True])
def test_the_time_limit_holds_for_a_thousand_nodes(guided):
    som._compile()
    (instance,) = Cell(1000, 10, 1).instances(0)
    began = time.process_time()  # the processor may be shared
    check_tours(instance, som.solve(instance, 0.3, 0, guided))
    assert time.process_time() - began < 1.2 * 0.3 + 0.5


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("name", ODD)
def test_odd_instances_are_solved(name, guided):
    check_tours(ODD[name], som.solve(ODD[name], 60.0, 0, guided, maps=2, generations=5))


def test_an_epoch_gives_each_city_a_neuron_of_its_own_and_leaves_the_depots():
    (instance,) = Cell(40, 3, 1).instances(0)
    rng = np.random.default_rng(0)
    rings = som.first_rings(instance.nodes, 3, rng)
    assert rings[:, 0] == pytest.approx(np.tile(instance.nodes[0], (3, 1)))
    assert ring_lengths(rings) == pytest.approx(np.full(3, ring_lengths(rings)[0]))
    depots, lengths, winner = rings[:, 0].copy(), ring_lengths(rings), np.full(40, -1)
    for width in (5.0, 1.0, 0.3):
        som.show(instance.nodes, 1 + rng.permutation(39), rings, lengths, winner, width)
        assert len(set(winner[1:])) == 39 and winner[0] == -1
        assert (winner[1:] % rings.shape[1] > 0).all() and (winner[1:] < 3 * rings.shape[1]).all()
        assert (rings[:, 0] == depots).all()
        moved = np.flatnonzero(np.bincount(winner[1:] // rings.shape[1], minlength=3))
        assert lengths[moved] == pytest.approx(ring_lengths(rings)[moved])


def test_the_winner_and_its_neighbours_move_towards_the_city():
    nodes = np.array([[0.0, 0.0], [0.5, 0.5]])
    rings = np.array([[[0.0, 0.0], [0.1, 0.0], [0.4, 0.4], [0.0, 0.1], [0.0, 0.05]]])
    before, winner = rings.copy(), np.zeros(2, dtype=np.int64)
    som.show(nodes, np.array([1]), rings, ring_lengths(rings), winner, 1.0)
    assert winner[1] == 2
    way = som.RATE * np.exp(-np.array([1.0, 0.0, 1.0, 4.0]))  # from neuron 1 to 4
    assert rings[0, 1:] == pytest.approx(before[0, 1:] + way[:, None] * (nodes[1] - before[0, 1:]))


def test_the_shorter_of_two_equally_near_rings_wins():
    nodes = np.array([[0.5, 0.5], [0.5, 0.6]])
    for long in (0, 1):
        rings = np.array([[[0.5, 0.5], [0.4, 0.6], [0.4, 0.5]], [[0.5, 0.5], [0.6, 0.6], [0.6, 0.5]]])
        rings[long, 2, 1] = 0.0
        winner = np.zeros(2, dtype=np.int64)
        som.show(nodes, np.array([1]), rings, ring_lengths(rings), winner, 0.3)
        assert winner[1] == 3 * (1 - long) + 1


def test_one_map_divides_the_cities_between_two_agents():
    """Two bunches of cities on either side of the depot: no map should send an agent to both."""
    rng = np.random.default_rng(0)
    left, right = ([x, 0.5] + 0.1 * rng.random((10, 2)) for x in (0.0, 0.9))
    instance = Instance(np.concatenate([[[0.5, 0.5]], left, right]), n_agents=2)
    tours = som.train(instance, math.inf, hurry=False, rng=rng)
    assert sorted(sorted(tour[1:-1]) for tour in tours) == [list(range(1, 11)), list(range(11, 21))]


@pytest.mark.slow
def test_maps_beat_random_tours_and_more_of_them_are_never_worse():
    (instance,) = Cell(50, 5, 1).instances(2)
    costs = [makespan(instance, som.solve(instance, 60.0, 0, guided=False, maps=k)) for k in (1, 2, 5, 20)]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] < 2 * lower_bound(instance)


def test_evolution_begins_with_the_tours_of_the_maps():
    (instance,) = Cell(50, 5, 1).instances(2)
    alone = makespan(instance, som.solve(instance, 60.0, 0, guided=False, maps=3))
    begun, bred = (makespan(instance, som.solve(instance, 60.0, 0, True, 3, g)) for g in (0, 100))
    assert bred < begun <= alone < 1.05 * begun


def test_a_map_in_a_hurry_is_done_in_few_epochs_and_another_is_not(monkeypatch):
    (instance,) = Cell(20, 2, 1).instances(0)
    rng, now, widths, show = np.random.default_rng(0), time.perf_counter(), [], som.show
    monkeypatch.setattr(som, "show", lambda *args: widths.append(args[-1]) or show(*args))
    check_tours(instance, som.train(instance, now, hurry=True, rng=rng))
    assert widths == pytest.approx([som.WIDE * 25, som.NARROW])  # 2.5 neurons for each of 9.5 cities, and the depot's
    assert som.train(instance, now, hurry=False, rng=rng) is None
    widths.clear()
    som.train(instance, math.inf, hurry=False, rng=rng)
    assert len(widths) == som.EPOCHS and widths[-1] == pytest.approx(som.NARROW)
    assert np.diff(np.log(widths)) == pytest.approx(np.log(widths[1] / widths[0]))
    assert len(list(som.train_maps(instance, now, None, rng))) == 1
    assert len(list(som.train_maps(instance, math.inf, 3, rng))) == 3


def test_bad_counts_are_refused():
    with pytest.raises(ValueError, match="maps must be a whole number of at least 1, got 0"):
        som.solve(ODD["one city"], 1.0, 0, maps=0)
    with pytest.raises(ValueError, match="generations must be a whole number of at least 0, got -1"):
        som.solve(ODD["one city"], 1.0, 0, generations=-1)
