"""The evolutionary algorithm: operators keep permutations, the best is never lost, and small optima are reached."""

from __future__ import annotations

import time

import numpy as np
import pytest
from helpers.odd import ODD
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.solvers import ea
from benchmarks.studies.optima import optimal_makespan
from benchmarks.suite import Cell
from mtsp_env import Instance, check_tours, lower_bound, makespan, uniform

sizes = st.tuples(st.integers(2, 12), st.integers(1, 6), st.integers(0, 10**6))  # n, m, seed


def of_size(n_nodes: int, n_agents: int, seed: int) -> tuple[Instance, np.ndarray, np.random.Generator]:
    """A uniform instance, 9 random chromosomes of it, and the random generator."""
    rng = np.random.default_rng(seed)
    instance = uniform(rng, n_nodes, n_agents)
    symbols = np.arange(1, ea.chromosome_length(instance) + 1)
    return instance, rng.permuted(np.tile(symbols, (9, 1)), axis=1), rng


def every_symbol_once(chromosomes: np.ndarray) -> bool:
    return (np.sort(chromosomes, axis=1) == np.arange(1, chromosomes.shape[1] + 1)).all()


@given(sizes)
def test_mutants_and_children_have_every_symbol_once(size):
    instance, population, rng = of_size(*size)
    before, partners = population.copy(), ea.nearest_partners(instance)
    assert every_symbol_once(ea.mutate(population, partners, rng))
    assert every_symbol_once(ea.breed(population, rng.random(len(population)), partners, rng))
    assert (population == before).all()


@given(sizes)
def test_a_child_keeps_a_slice_of_one_parent_and_the_order_of_the_other(size):
    _, population, rng = of_size(*size)
    other = population[::-1]
    cuts = np.sort(rng.integers(population.shape[1] + 1, size=(len(population), 2)), axis=1)
    children = ea.cross(population, other, cuts)
    assert every_symbol_once(children)
    for child, first, second, (begin, end) in zip(children, population, other, cuts, strict=True):
        inherited = first[begin:end].tolist()
        assert child[begin:end].tolist() == inherited
        assert [*child[:begin], *child[end:]] == [symbol for symbol in second if symbol not in inherited]


def test_a_mutation_brings_a_city_next_to_its_partner(monkeypatch):
    monkeypatch.setattr(ea, "NEAR", 1.0)
    monkeypatch.setattr(ea, "LONGEST_MOVE", 1)  # if more cities move, another one can arrive
    partner = np.array([0, *range(7, 13), *range(1, 7)])  # 6 places away
    parents = np.tile(np.arange(1, 13), (300, 1))
    mutants = ea.mutate(parents, partner[:, None], np.random.default_rng(0))
    assert every_symbol_once(mutants)
    assert (partner[mutants[:, :-1]] == mutants[:, 1:]).any(axis=1).all()


def test_mutations_reverse_move_and_swap(monkeypatch):
    monkeypatch.setattr(ea, "NEAR", 0.0)
    mutants = ea.mutate(np.tile(np.arange(1, 8), (5000, 1)), np.zeros((8, 0), int), np.random.default_rng(0))
    distinct = {tuple(mutant.tolist()) for mutant in mutants}
    assert {(1, 5, 4, 3, 2, 6, 7), (1, 4, 5, 2, 3, 6, 7), (1, 5, 6, 7, 2, 3, 4), (1, 6, 3, 4, 5, 2, 7)} <= distinct


@pytest.mark.slow
@given(sizes)
def test_chromosomes_are_tours_as_the_judge_sees_them(size):
    instance, population, _ = of_size(*size)
    longest, fitness = ea.evaluate(population, instance.n_nodes, ea.symbol_distances(instance))
    for chromosome, least, score in zip(population, longest, fitness, strict=True):
        tours = ea.decode(chromosome, instance)
        check_tours(instance, tours)
        assert least == pytest.approx(makespan(instance, tours))
        assert least <= score <= (1 + ea.MEAN_WEIGHT) * least
        again = ea.encode(tours, instance)
        assert every_symbol_once(again[None])
        assert sorted(ea.decode(again, instance)) == sorted(tours)


def test_two_tours_by_hand(square, square_tours):
    chromosome = ea.encode(square_tours, square)
    assert chromosome.tolist() == [2, 1, 3, 7, 4, 5, 6]  # 7 is the break point
    longest, fitness = ea.evaluate(np.array([chromosome, [7, 2, 1, 3, 4, 5, 6]]), 7, ea.symbol_distances(square))
    alone = 0.5 * 3 + np.hypot(0.5, 0.5) + 0.5 * 3  # 0 2 1 3, the diagonal to 4, 5 6 0
    assert longest == pytest.approx([2.0, alone])
    assert fitness == pytest.approx([2.0 + ea.MEAN_WEIGHT * 2.0, alone + ea.MEAN_WEIGHT * alone / 2])


def test_the_fittest_survive_and_duplicates_come_last():
    fitness = np.array([3.0, 1.0, 2.0, 1.0 + 1e-12, 5.0, 2.0])
    assert ea.survivors(fitness, 4).tolist() == [1, 2, 0, 4]
    assert ea.survivors(fitness, 6).tolist() == [1, 2, 0, 4, 3, 5]


def test_the_fittest_of_those_drawn_wins_a_tournament(monkeypatch):
    monkeypatch.setattr(ea, "TOURNAMENT", 60)
    fitness = np.array([3.0, 1.0, 2.0])
    assert (ea.tournament(fitness, 50, np.random.default_rng(0)) == 1).all()
    monkeypatch.setattr(ea, "TOURNAMENT", 1)
    assert set(ea.tournament(fitness, 50, np.random.default_rng(0))) == {0, 1, 2}


@pytest.mark.slow
def test_tiny_instances_are_solved_in_time_and_reproducibly():
    for instance in Cell(8, 2, 3).instances(0):
        began = time.perf_counter()
        check_tours(instance, ea.solve(instance, 0.2, 0))
        assert time.perf_counter() - began < 1.2 * 0.2 + 0.5
        tours = ea.solve(instance, 60.0, 1, generations=20)
        check_tours(instance, tours)
        assert tours == ea.solve(instance, 60.0, 1, generations=20)
    (instance,) = Cell(50, 5, 1).instances(0)
    assert ea.solve(instance, 60.0, 1, generations=5) != ea.solve(instance, 60.0, 2, generations=5)


@pytest.mark.slow
def test_the_time_limit_holds_for_a_thousand_nodes():
    (instance,) = Cell(1000, 10, 1).instances(0)
    began = time.process_time()  # the processor may be shared
    check_tours(instance, ea.solve(instance, 0.3, 0))
    assert time.process_time() - began < 1.2 * 0.3 + 0.5


@pytest.mark.parametrize("name", ODD)
def test_odd_instances_are_solved(name):
    check_tours(ODD[name], ea.solve(ODD[name], 60.0, 0, generations=10))


@pytest.mark.slow
def test_the_optimum_of_small_instances_is_reached():
    for instance in [*Cell(7, 3, 2).instances(3), *Cell(8, 2, 3).instances(3)]:
        tours = ea.solve(instance, 60.0, 0, generations=300)
        assert makespan(instance, tours) == pytest.approx(optimal_makespan(instance))


@pytest.mark.slow
@pytest.mark.parametrize("weight", [ea.MEAN_WEIGHT, 5.0])  # with 5, the fittest often have long tours
def test_the_best_tours_are_never_lost(weight, monkeypatch):
    monkeypatch.setattr(ea, "MEAN_WEIGHT", weight)
    (instance,) = Cell(30, 3, 1).instances(1)
    costs = [makespan(instance, ea.solve(instance, 60.0, 0, generations=g)) for g in range(0, 150, 10)]
    assert costs == sorted(costs, reverse=True)
    assert costs[-1] < 0.7 * costs[0]


def test_it_stops_at_the_lower_bound():
    instance = Instance([[0.5, 0.5], [0.5, 1.0], [1.0, 0.5], [0.0, 0.5]], n_agents=3)
    began = time.process_time()
    tours = ea.solve(instance, 20.0, 0)
    assert time.process_time() - began < 1.0
    assert makespan(instance, tours) == pytest.approx(lower_bound(instance))


def test_bad_generations_are_refused():
    with pytest.raises(ValueError, match="generations must be a whole number of at least 0, got -1"):
        ea.solve(ODD["one agent"], 1.0, 0, generations=-1)
