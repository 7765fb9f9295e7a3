"""OR-Tools' routing solver (package ``ortools``) with a cost on the longest tour.

The paper ("Results"): "OR Tools initially gets a solution using meta-heuristic algorithms (path-cheapest-arc) and then
further improves it by local search (2-opt)", with a reference to guided local search. It states neither the objective
nor a limit on the tours. Its numbers for n >= 500 are those of Hu et al. Our settings:

- Lengths are rounded to millionths of the unit square's side, because the solver's lengths are integers.
- The objective is 1000 times the longest tour plus the sum of all tours: a global span cost on a dimension in which
  every tour starts at 0, and lengths as arc costs. With arc costs of 0, path-cheapest-arc would choose arcs blindly
  (tours 8 times as long at n = 200) and guided local search would have nothing to penalise.
- ``search="first"`` stops at the tours of path-cheapest-arc. It extends one tour until a limit is reached, and there is
  none: one agent visits every city, always the nearest next. Only its time is of interest (the paper's Figure 4).
- ``search="greedy_descent"`` continues with the default local search (2-opt, Or-opt, relocate, exchange, cross,
  Lin-Kernighan, reinsertion of whole tours) until no move helps. This is our reading of the paper's setting. From one
  agent's long tour it takes minutes if n >= 200.
- ``search="guided"`` was the best setting: the first tours are constructed under lower and lower limits on a tour's
  length, so that the agents share the cities from the start, and guided local search follows under the lowest limit.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.solvers import NoTours, Unavailable
from mtsp_env.instance import Instance, Tours

if TYPE_CHECKING:
    from ortools.constraint_solver.pywrapcp import Assignment

UNIT = 1_000_000  # the solver's lengths per side of the unit square
SPAN_COST = 1000  # weight of the longest tour; that of the sum of all tours is 1
SEARCHES = {"first": "GREEDY_DESCENT", "greedy_descent": "GREEDY_DESCENT", "guided": "GUIDED_LOCAL_SEARCH"}
# Lower limits on a tour's length
TIGHTER = 0.93  # each limit relative to the one before
FIRST_TOURS, TIGHTENING = 0.6, 0.3  # maximum share of the time for the first limit, and for all limits
PATIENCE, MIN_PATIENCE = 3.0, 0.05  # a limit is too low if tours take this many times as long as before; seconds


def solve(instance: Instance, seconds: float, seed: int, search: str = "guided") -> Tours:
    """Tours by OR-Tools, on one thread, within ``seconds``.

    The search is not random, so ``seed`` is ignored; how far it gets depends on the machine.

    Raises:
        ValueError: an unknown search.
        Unavailable: the package ortools is missing.
        NoTours: path-cheapest-arc was not done in time.
    """
    if search not in SEARCHES:
        raise ValueError(f"unknown search {search!r}; choose from {list(SEARCHES)}")
    try:
        from ortools.constraint_solver import pywrapcp  # noqa: F401
    except ImportError as error:
        raise Unavailable(f"package ortools is missing ({error})") from error

    end = time.perf_counter() + seconds
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)  # (n, n)
    distance = np.rint(distance * UNIT).astype(np.int64)
    problem, start = None, None
    if search == "guided":
        problem, start = _share_cities(distance, instance.n_agents, seconds, end)
    if problem is None:
        limit = len(distance) * int(distance.max())  # none
        problem = Problem(distance, instance.n_agents, limit, SEARCHES[search])
    assignment = problem.search(end, start, only_first=search == "first") or start
    if assignment is None:
        raise NoTours(f"path-cheapest-arc was not done within {seconds:g} s")
    return problem.tours(assignment)


class Problem:
    """OR-Tools' model of an instance and its search options.

    Args:
        distance: int64 (n, n), in units of 1 / UNIT.
        n_agents: number of agents.
        limit: maximum length of a tour, in units of 1 / UNIT.
        local_search: name of a ``LocalSearchMetaheuristic``. The first search fixes it for the model.
    """

    def __init__(self, distance: np.ndarray, n_agents: int, limit: int, local_search: str) -> None:
        from ortools.constraint_solver import pywrapcp, routing_enums_pb2

        self.manager = pywrapcp.RoutingIndexManager(len(distance), n_agents, 0)
        self.model = pywrapcp.RoutingModel(self.manager)
        legs = self.model.RegisterTransitMatrix(distance.tolist())  # avoids callbacks into Python
        self.model.SetArcCostEvaluatorOfAllVehicles(legs)
        self.model.AddDimension(legs, 0, limit, True, "length")  # no waiting; every tour starts at 0
        self.model.GetDimensionOrDie("length").SetGlobalSpanCostCoefficient(SPAN_COST)
        self.options = pywrapcp.DefaultRoutingSearchParameters()
        self.options.first_solution_strategy = routing_enums_pb2.FirstSolutionStrategy.PATH_CHEAPEST_ARC
        self.options.local_search_metaheuristic = getattr(routing_enums_pb2.LocalSearchMetaheuristic, local_search)
        self.no_limit = self.options.solution_limit

    def search(self, end: float, start: Assignment | None = None, only_first: bool = False) -> Assignment | None:
        """The best tours until ``end`` (``time.perf_counter``), from ``start`` or from path-cheapest-arc."""
        left = end - time.perf_counter()
        if left <= 0:
            return None
        self.options.time_limit.FromNanoseconds(int(left * 1e9))
        self.options.solution_limit = 1 if only_first else self.no_limit
        if start is not None:
            return self.model.SolveFromAssignmentWithParameters(start, self.options)
        return self.model.SolveWithParameters(self.options)

    def tours(self, assignment: Assignment) -> Tours:
        """The tours of an assignment, one per agent."""
        tours = []
        for vehicle in range(self.manager.GetNumberOfVehicles()):
            index, tour = self.model.Start(vehicle), [0]
            while not self.model.IsEnd(index):
                index = assignment.Value(self.model.NextVar(index))
                tour.append(self.manager.IndexToNode(index))
            tours.append(tour)
        return tours


def _share_cities(
    distance: np.ndarray, n_agents: int, seconds: float, end: float
) -> tuple[Problem, Assignment] | tuple[None, None]:
    """First tours under the lowest limit on a tour's length for which OR-Tools finds any, and the problem.

    If a limit is too low, OR-Tools does not stop by itself, so a limit is given up after some time.
    """
    limit = 2 * int(distance[0].max()) + _nearest_next(distance) // n_agents  # a fair share, and one trip out and back
    best, patience, turn = (None, None), math.inf, FIRST_TOURS
    while (began := time.perf_counter()) < end - (1 - turn) * seconds:
        problem = Problem(distance, n_agents, limit, SEARCHES["guided"])
        assignment = problem.search(min(began + patience, end - (1 - turn) * seconds), only_first=True)
        if assignment is None:
            break
        best, turn = (problem, assignment), TIGHTENING
        patience = max(PATIENCE * (time.perf_counter() - began), MIN_PATIENCE)
        limit = int(TIGHTER * limit)
    return best


def _nearest_next(distance: np.ndarray) -> int:
    """Length of a tour of all cities that always goes to the nearest unvisited one."""
    left, here, length = np.ones(len(distance), dtype=bool), 0, 0
    for _ in range(len(distance) - 1):
        left[here] = False
        there = int(np.argmin(np.where(left, distance[here], np.iinfo(np.int64).max)))
        length += int(distance[here, there])
        here = there
    return length + int(distance[here, 0])
