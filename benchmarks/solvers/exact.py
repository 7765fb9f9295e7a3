"""Proofs of optimality by mixed-integer programming: two-index arcs with cumulative distances.

A binary x_ij says that an agent goes from i to j, u_j is the distance that it has come at city j, T the makespan:

    minimise T
    one arc into, one out of each city; at most m arcs out of the depot (agents may stay at home)
    u_j >= u_i + d_ij where x_ij = 1: no tour without the depot (Miller, Tucker and Zemlin 1960, with distances)
    T >= u_j + d_jk + d_k0 where x_jk = 1

and, so that it is solved sooner: the ordering rows in the lifted form of Desrochers and Laporte (1991), with the least
big-M that an upper bound U on T allows; no arc i -> j with d_0i + d_ij + d_j0 > U; u_j at least d_0i + d_ij where
x_ij = 1; m T >= the sum of all tours; T at least ``tours.lower_bound``; not both x_ij and x_ji; and one of each two
directions of a tour: a city that comes after half of its tour comes before it in the other direction, so u_j <= T / 2
for cities so far apart that no two are on one tour.

The distance does not order cities that lie (nearly) in one place: tours without the depot among these are forbidden
as they occur, and the program is solved again.

U is the makespan of the given tours ``start``, from which the solver then also starts. Without them, as in the tables,
nothing of another solver helps: U is the makespan of a greedy insertion, whose tours the solver does not see. A low U
makes proofs shorter, and hides poor tours, so that HiGHS often finds none at all in a minute at n = 50. From n = 500 on
it overruns its time, too, as it does not look at the clock while it prepares.
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

TOLERANCE = 1e-6  # relative: what rounding in a solver may make of a bound
PROVED = 1e-5  # relative gap


@dataclass(frozen=True)
class Proof:
    """What is known of an instance.

    Attributes:
        tours: the best found, None where none were.
        makespan: theirs, by ``mtsp_env.tours``; infinite without tours.
        bound: no makespan is below this.
    """

    tours: Tours | None
    makespan: float
    bound: float

    @property
    def gap(self) -> float:
        """From the makespan down to the bound, in units of the makespan."""
        return 0.0 if self.makespan == self.bound else 1.0 - self.bound / self.makespan

    @property
    def optimal(self) -> bool:
        """The tours are the best there are, but for PROVED."""
        return self.gap <= PROVED


def solve(instance: Instance, seconds: float, seed: int, backend: str = "highs", start: Tours | None = None) -> Answer:
    """The best tours and the bound that a ``backend`` ("highs", "gurobi", "cplex") finds within ``seconds``.

    They depend on nothing but the arguments where it comes to an end in time.

    Raises:
        ValueError: an unknown backend, or tours ``start`` that do not solve the instance.
        Unavailable: the backend is not installed, has no licence, or takes no program of this size without one.
        NoTours: none were found in time.
    """
    proof = prove(instance, seconds, seed, backend, start)
    if proof.tours is None:
        raise NoTours(f"{backend} found no tours in {seconds:g} s; none is below {proof.bound:.4f}")
    return Answer(proof.tours, proof.bound)


def prove(
    instance: Instance, seconds: float, seed: int = 0, backend: str = "highs", start: Tours | None = None
) -> Proof:
    """``solve``, which also says whether the tours are proved to be the best, and does not mind finding none."""
    end = time.perf_counter() + seconds
    if start is not None:
        check_tours(instance, start)
    program = Program(instance, start)
    proof = Proof(start, np.inf if start is None else makespan(instance, start), lower_bound(instance))
    while (left := end - time.perf_counter()) > 0:
        found = minimise(program.variables, program.rows, left, seed, backend, program.start)
        bound = max(proof.bound, found.bound * (1.0 - TOLERANCE))
        proof = Proof(proof.tours, proof.makespan, min(bound, proof.makespan))
        if found.values is None:
            break
        tours, cycles = program.tours(found.values)
        if not cycles:
            length = makespan(instance, tours)
            if length < proof.makespan:
                proof = Proof(tours, length, min(proof.bound, length))
            break
        program.forbid(cycles)
    return proof


if __name__ == "__main__":
    import sys

    from benchmarks.solvers import _optima  # which imports this module

    sys.exit(_optima.main())
