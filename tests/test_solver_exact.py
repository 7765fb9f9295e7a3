"""``exact`` agrees with enumeration, its bounds hold, and its constraints exclude no optimal tours."""

from __future__ import annotations

import itertools
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.solvers import Answer, NoTours, Unavailable, _milp, exact
from benchmarks.solvers._two_index import Program, greedy_makespan
from benchmarks.studies import optima
from benchmarks.suite import Cell
from mtsp_env import Instance, check_tours, lower_bound, makespan

needs_highs = pytest.mark.skipif(find_spec("highspy") is None, reason="needs the package highspy")


def try_everything(instance: Instance) -> float:
    """The smallest makespan over all assignments of cities to agents and all orders of each agent's cities."""
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2).tolist()
    cities = range(1, instance.n_nodes)
    shortest = {
        part: min(sum(distance[i][j] for i, j in itertools.pairwise([0, *order, 0])) for order in permutations(part))
        for size in range(instance.n_nodes)
        for part in itertools.combinations(cities, size)
    }
    team = range(min(instance.n_agents, instance.n_nodes - 1))
    return min(
        max(shortest[tuple(itertools.compress(cities, [owner == agent for owner in owners]))] for agent in team)
        for owners in itertools.product(team, repeat=len(cities))
    )


SMALL = [i for cell in (Cell(5, 2, 2), Cell(6, 3, 2), Cell(7, 2, 1), Cell(8, 2, 1)) for i in cell.instances(0)]
SMALL += [Cell(7, 3, 1).instances(0, "clustered")[0], Cell(8, 3, 1).instances(0, "clustered")[0]]
ODD = {
    "n = 2": ([[0, 0], [0, 1]], 1),
    "n = 2, idle agents": ([[0, 0], [0, 1]], 4),
    "one agent": ([[0, 0], [0, 1], [1, 0], [0.3, 0.9], [0.8, 0.7]], 1),
    "more agents than cities": ([[0, 0], [0, 1], [1, 0]], 5),
    "all in one place": ([[0.5, 0.5]] * 6, 2),
    "cities in one place": ([[0.5, 0.5]] + [[0.2, 0.2]] * 3 + [[0.8, 0.1]] * 3, 1),
    "cities nearly in one place": ([[0.5, 0.5]] + [[0.2, 0.2 + i * 1e-8] for i in range(6)], 2),
    "cities on the depot": ([[0, 0]] * 5 + [[0, 1]] * 2, 2),
    "on a line": ([[0, x / 6] for x in range(7)], 3),
}


@pytest.mark.slow
@needs_highs
@pytest.mark.parametrize("instance", SMALL, ids=lambda instance: instance.name)
def test_proofs_agree_with_trying_everything(instance):
    optimum, proof = try_everything(instance), exact.prove(instance, 60.0)
    check_tours(instance, proof.tours)
    assert proof.optimal and proof.gap <= exact.PROVED
    assert proof.makespan == makespan(instance, proof.tours) == pytest.approx(optimum, rel=1e-6)
    assert lower_bound(instance) - 1e-12 <= proof.bound <= optimum + 1e-12
    assert optima.optimal_makespan(instance) == pytest.approx(optimum, rel=1e-12)


@needs_highs
@pytest.mark.parametrize("name", ODD)
def test_odd_instances_are_proved_too(name):
    instance = Instance(*ODD[name])
    proof = exact.prove(instance, 60.0)
    check_tours(instance, proof.tours)
    assert proof.optimal
    assert proof.makespan == pytest.approx(try_everything(instance), rel=1e-6)


@needs_highs
def test_the_square_is_solved_to_its_optimum_and_again_the_same(square):
    answer = exact.solve(square, 60.0, 0)
    assert isinstance(answer, Answer)
    assert makespan(square, answer.tours) == pytest.approx(2.0)
    assert 2.0 * (1 - exact.PROVED) <= answer.bound <= 2.0
    assert exact.solve(square, 60.0, 0) == answer


@pytest.mark.slow
@needs_highs
def test_three_tiny_instances_are_solved_within_the_time_limit():
    for instance in Cell(8, 2, 3).instances(0):
        start = time.perf_counter()
        answer = exact.solve(instance, 5.0, 0)
        assert time.perf_counter() - start < 1.2 * 5.0 + 0.5
        check_tours(instance, answer.tours)


@pytest.mark.slow
@needs_highs
def test_the_time_limit_holds_if_there_is_no_proof_in_time():
    instance = Cell(40, 3, 1).instances(0)[0]
    start = time.perf_counter()
    proof = exact.prove(instance, 1.0)
    assert time.perf_counter() - start < 1.2 * 1.0 + 0.5
    assert not proof.optimal and proof.bound >= lower_bound(instance) - 1e-12
    with pytest.raises(NoTours, match=r"highs found no tours in 1e-06 s; none is below"):
        exact.solve(instance, 1e-6, 0)


@pytest.mark.slow
@needs_highs
def test_given_tours_are_the_first_answer():
    instance = Cell(40, 3, 1).instances(0)[0]
    start = thirds(instance)
    program = Program(instance, start)
    result = _milp.minimise(program.variables, program.rows, 1.0, 0, "highs", program.start)
    assert result.values is not None  # without a start, HiGHS has none after a minute
    assert makespan(instance, exact.solve(instance, 0.5, 0, start=start).tours) <= makespan(instance, start)
    small = SMALL[0]
    assert exact.prove(small, 60.0, start=thirds(small)).makespan == pytest.approx(try_everything(small), rel=1e-6)
    with pytest.raises(ValueError, match="missing from the tours"):
        exact.prove(instance, 1.0, start=[[0, 1, 0], [0, 0], [0, 0]])


def test_a_proof_is_sound_whatever_bound_a_solver_reports(square, square_tours, monkeypatch):
    for claim, bound in [(1e9, 2.0), (1.9, 1.9 * (1 - exact.TOLERANCE)), (-np.inf, lower_bound(square))]:
        monkeypatch.setattr(exact, "minimise", lambda *_, claim=claim: _milp.Result(np.zeros(1), claim))
        monkeypatch.setattr(Program, "tours", lambda *_: (thirds(square), []))  # longer than those given
        proof = exact.prove(square, 60.0, start=square_tours)
        assert (proof.tours, proof.makespan, proof.bound) == (square_tours, 2.0, bound)


def thirds(instance: Instance) -> list[list[int]]:
    """Tours in which each agent visits every m-th city."""
    m = instance.n_agents
    return [[0, *range(1 + agent, instance.n_nodes, m), 0] for agent in range(m)]


@pytest.mark.slow
@settings(deadline=None, max_examples=150)
@given(data=st.data(), n=st.integers(2, 9), m=st.integers(1, 4), seed=st.integers(0, 10**6))
def test_the_rows_hold_for_all_tours_within_the_limit(data, n, m, seed):
    """Any tours are feasible in the program whose limit is their makespan, so no row excludes an optimum."""
    grid = data.draw(st.sampled_from([2, 5, 10**6]))  # coarse: cities in one place, on the depot, on a line
    nodes = np.random.default_rng(seed).integers(0, grid + 1, (n, 2)) / grid
    instance = Instance(nodes, m)
    cities = data.draw(st.permutations(range(1, n)))
    cuts = sorted(data.draw(st.lists(st.integers(0, n - 1), min_size=m - 1, max_size=m - 1)))
    tours = [[0, *cities[a:b], 0] for a, b in itertools.pairwise([0, *cuts, n - 1])]
    program = Program(instance, tours)
    lower, upper = program.rows.bounds()
    sums = program.rows.matrix(len(program.start)) @ program.start
    assert (sums >= lower - 1e-9).all() and (sums <= upper + 1e-9).all()
    assert (program.start >= program.variables.lower - 1e-9).all()
    assert (program.start <= program.variables.upper + 1e-9).all()
    again, cycles = program.tours(program.start)
    assert not cycles
    canonical = [sorted(min(tour, tour[::-1]) for tour in one if len(tour) > 2) for one in (again, tours)]
    assert canonical[0] == canonical[1]


def test_cycles_without_the_depot_are_forbidden():
    program = Program(Instance([[0.5, 0.5]] + [[0.2, 0.2]] * 3 + [[0.9, 0.5]], 1))
    arcs = dict(zip(zip(program.tail.tolist(), program.head.tolist(), strict=True), program.arc, strict=True))
    values = np.zeros(len(program.variables.cost))
    values[[arcs[arc] for arc in [(0, 4), (4, 0), (1, 2), (2, 3), (3, 1)]]] = 1.0
    tours, cycles = program.tours(values)
    assert tours == [[0, 4, 0]] and [sorted(cycle) for cycle in cycles] == [[1, 2, 3]]
    program.forbid(cycles)
    _, upper = program.rows.bounds()
    assert (program.rows.matrix(len(values)) @ values)[-1] == 3 > upper[-1] == 2


def test_the_greedy_limit_is_a_makespan():
    for instance in SMALL:
        distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2)
        assert greedy_makespan(distance, instance.n_agents) >= try_everything(instance) - 1e-12
    line = np.abs(np.subtract.outer([0.0, 1.0, -1.0, 0.5], [0.0, 1.0, -1.0, 0.5]))
    assert greedy_makespan(line, 2) == 2.0  # the farthest two to an agent each, the last on the way of one
    assert greedy_makespan(line, 1) == 4.0


@pytest.mark.parametrize(("backend", "package"), [("gurobi", "gurobipy"), ("cplex", "cplex")])
def test_licensed_backends_prove_the_same_within_their_size_limits(backend, package):
    pytest.importorskip(package)
    instance = SMALL[-1]
    proof = exact.prove(instance, 60.0, backend=backend)
    assert proof.optimal and proof.makespan == pytest.approx(try_everything(instance), rel=1e-6)
    from_start = exact.prove(instance, 60.0, backend=backend, start=thirds(instance))
    assert from_start.makespan == pytest.approx(proof.makespan)
    with pytest.raises(Unavailable, match=r"(?i)size"):
        exact.solve(Cell(60, 3, 1).instances(0)[0], 5.0, 0, backend)


@pytest.mark.parametrize(("backend", "package"), [("highs", "highspy"), ("gurobi", "gurobipy"), ("cplex", "cplex")])
def test_a_missing_backend_is_named(square, monkeypatch, backend, package):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(Unavailable, match=f"package {package} is missing"):
        exact.solve(square, 1.0, 0, backend)


def test_an_unknown_backend_is_bad_input(square):
    with pytest.raises(ValueError, match=r"unknown backend 'abacus'; choose from \['cplex', 'gurobi', 'highs'\]"):
        exact.solve(square, 1.0, 0, "abacus")


@pytest.mark.slow
@needs_highs
def test_the_table_of_optima_shows_what_is_confirmed(monkeypatch):
    pytest.importorskip("numba")
    pytest.importorskip("elkai")
    monkeypatch.setattr(optima, "LKH_SECONDS", 1.0)
    (optimum,) = optima.find_optima(1)
    assert optimum.confirmed
    assert optimum.proof.makespan == pytest.approx(try_everything(optima.CELLS[0].instances(7)[0]), rel=1e-6)
    missed = replace(optimum, lkh3=1.01 * optimum.optimum)
    unproved = replace(optimum, proof=replace(optimum.proof, bound=0.9 * optimum.proof.makespan))
    assert not missed.confirmed and not unproved.confirmed
    lines = optima.to_markdown([optimum, missed, unproved]).splitlines()[2:]
    assert lines[0].endswith("| reached | reached |") and "| yes |" in lines[0]
    assert lines[1].endswith(f"| reached | {missed.lkh3:.6f} |") and "| gap 10.00 % |" in lines[2]
    with pytest.raises(ValueError, match="count must be 1 to 20, got 21"):
        optima.find_optima(21)


def test_sets_of_too_many_cities_are_bad_input():
    with pytest.raises(ValueError, match="n_nodes must be at most 13, got 14"):
        optima.optimal_makespan(Cell(14, 2, 1).instances(0)[0])
