"""Why there is a reference solver: the gaps of well-kept routing libraries after the same time, on one thread.

It needs ``pyvrp`` (0.14) and ``ortools`` (9.15).
"""

from __future__ import annotations

import time

import numpy as np
from scipy.stats import sem

from benchmarks import solvers
from benchmarks.reports.markdown import markdown_table
from benchmarks.suite import SEED, Cell, check_instances
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import check_tours, lower_bound, makespan

UNIT = 1_000_000  # PyVRP's distances are whole numbers
SHARE = 0.1  # of the time, at most, for each limit
RESOLUTION = 1e-3  # if the bisection's interval is smaller, relative to the best makespan, lower limits are tried again


def pyvrp(instance: Instance, seconds: float, seed: int) -> Tours:
    """Tours by PyVRP, which minimises the total length, with a bisection on a vehicle's maximum distance.

    The limit lies between the lower bound and the best makespan so far, which begins with greedy insertion. Each solve
    starts from the best tours so far and ends with the first feasible solution or after its share of the time.
    """
    import pyvrp as library
    from pyvrp.stop import FirstFeasible, MaxRuntime, MultipleCriteria

    from mtsp_env.reference import improve  # imports Numba

    end, m, nodes = time.perf_counter() + seconds, instance.n_agents, instance.nodes
    legs = [np.ceil(np.linalg.norm(nodes[:, None] - nodes, axis=2) * UNIT).astype(np.int64)]
    places = [library.Location(x, y) for x, y in nodes * UNIT]
    clients = [library.Client(i) for i in range(1, len(nodes))]

    best = improve(instance, iterations=0)
    low, high = (bound := lower_bound(instance)), makespan(instance, best)
    while (left := end - time.perf_counter()) > 0 and high > bound + 1e-6:
        if high - low < RESOLUTION * high:
            low = bound
        limit = (low + high) / 2
        vehicles = library.VehicleType(m, max_distance=int(limit * UNIT))
        data = library.ProblemData(places, clients, [library.Depot(0)], [vehicles], legs, legs)
        start = library.Solution(data, [[city - 1 for city in tour[1:-1]] for tour in best if len(tour) > 2])
        stop = MultipleCriteria([FirstFeasible(), MaxRuntime(min(left, SHARE * seconds))])
        solution = library.solve(data, stop, seed, collect_stats=False, initial_solution=start).best
        if solution.is_feasible():
            best = [[0, *(visit.idx + 1 for visit in tour if visit.is_client()), 0] for tour in solution.routes()]
            high = makespan(instance, best)
        else:
            low = limit
    return best + [[0, 0]] * (m - len(best))


def main(instances: int = 5, seconds: tuple[float, ...] = (0.1, 1.0, 5.0), seed: int = SEED) -> None:
    """Print the mean gap of the reference solver, PyVRP and OR-Tools to the best of the three, in a Markdown table.

    Args:
        instances: number of instances of each size, at least 2.
        seconds: budgets of the solvers.
        seed: seed of the instances.

    Raises:
        ValueError: an argument outside its range.
    """
    check_instances(instances, minimum=2)
    check_count("seed", seed, minimum=0)
    for budget in seconds:
        check_seconds("seconds", budget)
    methods = {"reference": solvers.find("reference"), "PyVRP": pyvrp, "OR-Tools": solvers.find("ortools-gls")}
    lines = []
    for n, m in ((50, 5), (100, 5), (200, 10)):
        problems = Cell(n, m, instances).instances(seed)
        for budget in seconds:
            costs = np.array(
                [[_cost(solve, x, budget, seed + i) for solve in methods.values()] for i, x in enumerate(problems)]
            )
            gaps = 100 * (costs / np.nanmin(costs, axis=1, keepdims=True) - 1.0)
            lines.append([f"{n}, {m} in {budget:g} s", *(f"{gap.mean():.2f} ± {sem(gap):.2f}" for gap in gaps.T)])
    print(markdown_table(["gap to the best of the line, %", *methods], lines))


def _cost(solve: solvers.Solve, instance: Instance, seconds: float, seed: int) -> float:
    try:
        tours = solve(instance, seconds, seed)
    except solvers.NoTours:
        return np.nan
    check_tours(instance, tours)
    return makespan(instance, tours)
