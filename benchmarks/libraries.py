"""Why there is a reference solver: what well-kept routing libraries find in the same time, on one thread.

``python -m benchmarks.libraries``, with ``pyvrp`` (0.14) and ``ortools`` (9.15) installed.
"""

from __future__ import annotations

import time

import numpy as np
import tyro
from scipy.stats import sem

from benchmarks import solvers
from benchmarks.suite import SEED, Cell
from mtsp_env.instance import Instance, Tours
from mtsp_env.reference import improve
from mtsp_env.tours import check_tours, lower_bound, makespan

UNIT = 1_000_000  # PyVRP counts in whole numbers
SHARE = 0.1  # of the time, for one limit at most
FINE = 1e-3  # limits as near as this to the best makespan have had their turn: the lower ones are tried again


def pyvrp(instance: Instance, seconds: float, seed: int) -> Tours:
    """PyVRP minimises the total length, so: bisection on the longest distance that a vehicle may go.

    The limit is between the lower bound and the best makespan so far, at first greedy insertion's. Each starts from the
    best tours so far, and is over with the first feasible ones or its share of the time.
    """
    import pyvrp as lib
    from pyvrp.stop import FirstFeasible, MaxRuntime, MultipleCriteria

    end, m, nodes = time.perf_counter() + seconds, instance.n_agents, instance.nodes
    legs = [np.ceil(np.linalg.norm(nodes[:, None] - nodes, axis=2) * UNIT).astype(np.int64)]
    places = [lib.Location(x, y) for x, y in nodes * UNIT]
    clients = [lib.Client(i) for i in range(1, len(nodes))]

    best = improve(instance, iterations=0)
    low, high = (bound := lower_bound(instance)), makespan(instance, best)
    while (left := end - time.perf_counter()) > 0 and high > bound + 1e-6:
        if high - low < FINE * high:
            low = bound
        limit = (low + high) / 2
        vehicles = lib.VehicleType(m, max_distance=int(limit * UNIT))
        data = lib.ProblemData(places, clients, [lib.Depot(0)], [vehicles], legs, legs)
        start = lib.Solution(data, [[city - 1 for city in tour[1:-1]] for tour in best if len(tour) > 2])
        stop = MultipleCriteria([FirstFeasible(), MaxRuntime(min(left, SHARE * seconds))])
        found = lib.solve(data, stop, seed, collect_stats=False, initial_solution=start).best
        if found.is_feasible():
            best = [[0, *(visit.idx + 1 for visit in tour if visit.is_client()), 0] for tour in found.routes()]
            high = makespan(instance, best)
        else:
            low = limit
    return best + [[0, 0]] * (m - len(best))


def main(instances: int = 5, seconds: tuple[float, ...] = (0.1, 1.0, 5.0), seed: int = SEED) -> None:
    """Mean gap of each solver to the best of all of them, ± standard error, in a Markdown table."""
    methods = {"reference": solvers.find("reference"), "PyVRP": pyvrp, "OR-Tools": solvers.find("ortools-gls")}
    print("| gap to the best of the row, % | " + " | ".join(methods) + " |\n|---|" + "---|" * len(methods))
    for n, m in ((50, 5), (100, 5), (200, 10)):
        for budget in seconds:
            problems = enumerate(Cell(n, m, instances).instances(seed))
            costs = np.array([[_cost(f, x, budget, seed + i) for f in methods.values()] for i, x in problems])
            gaps = 100 * (costs / np.nanmin(costs, axis=1, keepdims=True) - 1.0)
            print(f"| {n}, {m} in {budget:g} s", *(f"{g.mean():.2f} ± {sem(g):.2f}" for g in gaps.T), "", sep=" | ")


def _cost(solve: solvers.Solve, instance: Instance, seconds: float, seed: int) -> float:
    try:
        tours = solve(instance, seconds, seed)
    except solvers.NoTours:
        return np.nan
    check_tours(instance, tours)
    return makespan(instance, tours)


if __name__ == "__main__":
    tyro.cli(main)
