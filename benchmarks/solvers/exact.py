"""Proofs of optimality by mixed-integer programming: a two-index formulation with cumulative distances.

The binary x_ij is 1 if an agent goes from i to j, u_j is the distance travelled at city j, and T is the makespan:

    minimise T
    one arc into and one arc out of each city; at most m arcs out of the depot (agents may stay at home)
    u_j >= u_i + d_ij if x_ij = 1: no tour without the depot (Miller, Tucker and Zemlin 1960, with distances)
    T >= u_j + d_jk + d_k0 if x_jk = 1

Further constraints shorten the search: the ordering constraints in the lifted form of Desrochers and Laporte (1991),
with the smallest big-M that an upper bound U on T allows; no arc i -> j with d_0i + d_ij + d_j0 > U;
u_j >= d_0i + d_ij if x_ij = 1; m T >= the sum of all tours; T >= ``tours.lower_bound``; not both x_ij and x_ji. A tour
can be reversed, and a city in its second half is then in its first half. Hence u_j <= T / 2 for cities that are so far
apart that no two of them are on the same tour.

Distances do not order cities in (nearly) the same place. Tours among these that avoid the depot are forbidden when they
occur, and the program is solved again.

U is the makespan of the tours ``start``, if they are given; the solver then starts from them. Without them, as in the
tables, no other solver helps: U is the makespan of a greedy insertion, whose tours the solver does not see. A low U
shortens proofs but excludes poor tours, so that HiGHS often finds no tours in a minute at n = 50. From n = 500 on it
also exceeds its time, because it does not check the clock during its preparation.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.solvers import Answer, NoTours
from benchmarks.solvers._milp import minimise
from benchmarks.solvers._two_index import Program
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, lower_bound, makespan

TOLERANCE = 1e-6  # relative error of a solver's bound due to rounding
PROVED = 1e-5  # relative gap up to which tours count as proved optimal


@dataclass(frozen=True)
class Proof:
    """The result of a proof.

    Attributes:
        tours: the best tours, or None.
        makespan: their makespan by ``mtsp_env.tours``; infinite without tours.
        bound: lower bound on the makespan.
    """

    tours: Tours | None
    makespan: float
    bound: float

    @property
    def gap(self) -> float:
        """Distance from makespan to bound, relative to the makespan."""
        return 0.0 if self.makespan == self.bound else 1.0 - self.bound / self.makespan

    @property
    def optimal(self) -> bool:
        """Whether the tours are optimal, within PROVED."""
        return self.gap <= PROVED


def solve(instance: Instance, seconds: float, seed: int, backend: str = "highs", start: Tours | None = None) -> Answer:
    """The best tours and bound of a ``backend`` ("highs", "gurobi", "cplex") within ``seconds``.

    If it ends in time, they depend on the arguments alone.

    Raises:
        ValueError: an unknown backend, or tours ``start`` that do not solve the instance.
        Unavailable: the backend is not installed, has no licence, or its licence does not allow a program of this size.
        NoTours: it found no tours in time.
    """
    proof = prove(instance, seconds, seed, backend, start)
    if proof.tours is None:
        raise NoTours(f"{backend} found no tours in {seconds:g} s; none is below {proof.bound:.4f}")
    return Answer(proof.tours, proof.bound)


def prove(
    instance: Instance, seconds: float, seed: int = 0, backend: str = "highs", start: Tours | None = None
) -> Proof:
    """Like ``solve``, but the result says whether the tours are optimal, and may be without tours."""
    end = time.perf_counter() + seconds
    if start is not None:
        check_tours(instance, start)
    program = Program(instance, start)
    proof = Proof(start, np.inf if start is None else makespan(instance, start), lower_bound(instance))
    while (left := end - time.perf_counter()) > 0:
        result = minimise(program.variables, program.rows, left, seed, backend, program.start)
        bound = max(proof.bound, result.bound * (1.0 - TOLERANCE))
        proof = Proof(proof.tours, proof.makespan, min(bound, proof.makespan))
        if result.values is None:
            break
        tours, cycles = program.tours(result.values)
        if not cycles:
            length = makespan(instance, tours)
            if length < proof.makespan:
                proof = Proof(tours, length, min(proof.bound, length))
            break
        program.forbid(cycles)
    return proof
