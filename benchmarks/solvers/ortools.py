"""OR-Tools' routing solver (package ``ortools``) with a cost on the longest tour.

The paper ("Results"): "OR Tools initially gets a solution using meta-heuristic algorithms (path-cheapest-arc) and then
further improves it by local search (2-opt)", with a reference to guided local search; it gives neither the objective
nor a limit on the tours. Its numbers for n >= 500 are those of Hu et al. What is done here:

- Lengths are whole millionths of the unit square's side, rounded, as the solver knows integers only.
- The objective is 1000 times the longest tour plus the sum of all: a global span cost on a dimension in which every
  tour starts at 0, and lengths as arc costs. With arc costs of 0, path-cheapest-arc would pick arcs blindly (tours 8
  times as long at n = 200) and guided local search would have nothing to penalise.
- ``search="first"`` stops at the tours of path-cheapest-arc. It fills one tour until it is full, which it never is: one
  agent visits every city, nearest next. Only the time that this takes is of interest (the paper's Figure 4).
- ``search="greedy_descent"`` goes on with the default local search (2-opt, Or-opt, relocate, exchange, cross,
  Lin-Kernighan, reinsertion of whole tours) until no move helps: the paper's weak setting, as we read it. From one
  agent's long tour that takes minutes where n >= 200.
- ``search="guided"`` is the best that we found: the first tours are made again under ever lower limits on a tour's
  length, so that the agents share the cities from the start; then guided local search under the lowest limit.
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
SPAN_COST = 1000  # of the longest tour, where the sum of all tours costs 1
SEARCHES = {"first": "GREEDY_DESCENT", "greedy_descent": "GREEDY_DESCENT", "guided": "GUIDED_LOCAL_SEARCH"}
# Lower limits on a tour's length
TIGHTER = 0.93  # in units of the limit before
FIRST_TOURS, TIGHTENING = 0.6, 0.3  # of the time at most, for the first limit and for all
PATIENCE, MIN_PATIENCE = 3.0, 0.05  # a limit is too low where tours take this many times as long as before, and seconds


def solve(instance: Instance, seconds: float, seed: int, search: str = "guided") -> Tours:
    """Tours by OR-Tools, on one thread, within ``seconds``.

    ``seed`` changes nothing: the search is not random. How far it comes in its time is.

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
    found = problem.search(end, start, only_first=search == "first") or start
    if found is None:
        raise NoTours(f"path-cheapest-arc was not done within {seconds:g} s")
    return problem.tours(found)


class Problem:
    """OR-Tools' model of an instance, and how it is to be searched.

    Args:
        distance: int64 (n, n), in UNITs.
        n_agents: m.
        limit: no tour is longer, in UNITs.
        local_search: a name of ``LocalSearchMetaheuristic``. It belongs to the model: the first search settles it, and
            later ones keep it whatever they ask for.
    """

    def __init__(self, distance: np.ndarray, n_agents: int, limit: int, local_search: str) -> None:
        from ortools.constraint_solver import pywrapcp, routing_enums_pb2

        self.manager = pywrapcp.RoutingIndexManager(len(distance), n_agents, 0)
        self.model = pywrapcp.RoutingModel(self.manager)
        legs = self.model.RegisterTransitMatrix(distance.tolist())  # read without calls back into Python
        self.model.SetArcCostEvaluatorOfAllVehicles(legs)
        self.model.AddDimension(legs, 0, limit, True, "length")  # no waiting; every tour starts at 0
        self.model.GetDimensionOrDie("length").SetGlobalSpanCostCoefficient(SPAN_COST)
        self.options = pywrapcp.DefaultRoutingSearchParameters()
        self.options.first_solution_strategy = routing_enums_pb2.FirstSolutionStrategy.PATH_CHEAPEST_ARC
        self.options.local_search_metaheuristic = getattr(routing_enums_pb2.LocalSearchMetaheuristic, local_search)
        self.no_limit = self.options.solution_limit

    def search(self, end: float, start: Assignment | None = None, only_first: bool = False) -> Assignment | None:
        """The best tours found until ``end`` (of ``time.perf_counter``), from ``start`` or path-cheapest-arc on."""
        left = end - time.perf_counter()
        if left <= 0:
            return None
        self.options.time_limit.FromNanoseconds(int(left * 1e9))
        self.options.solution_limit = 1 if only_first else self.no_limit
        if start is not None:
            return self.model.SolveFromAssignmentWithParameters(start, self.options)
        return self.model.SolveWithParameters(self.options)

    def tours(self, found: Assignment) -> Tours:
        """Node numbers, [0, ..., 0] for each agent."""
        tours = []
        for vehicle in range(self.manager.GetNumberOfVehicles()):
            index, tour = self.model.Start(vehicle), [0]
            while not self.model.IsEnd(index):
                index = found.Value(self.model.NextVar(index))
                tour.append(self.manager.IndexToNode(index))
            tours.append(tour)
        return tours


def _share_cities(
    distance: np.ndarray, n_agents: int, seconds: float, end: float
) -> tuple[Problem, Assignment] | tuple[None, None]:
    """The problem with the lowest limit on a tour's length that first tours were found for, and these tours.

    Where a limit is too low, OR-Tools searches on without end, so that only time can tell.
    """
    limit = 2 * int(distance[0].max()) + _nearest_next(distance) // n_agents  # a fair share, and a way there and back
    best, patience, turn = (None, None), math.inf, FIRST_TOURS
    while (began := time.perf_counter()) < end - (1 - turn) * seconds:
        problem = Problem(distance, n_agents, limit, SEARCHES["guided"])
        found = problem.search(min(began + patience, end - (1 - turn) * seconds), only_first=True)
        if found is None:
            break
        best, turn = (problem, found), TIGHTENING
        patience = max(PATIENCE * (time.perf_counter() - began), MIN_PATIENCE)
        limit = int(TIGHTER * limit)
    return best


def _nearest_next(distance: np.ndarray) -> int:
    """Length of one agent's tour of all cities, always to the nearest that is left."""
    left, here, length = np.ones(len(distance), dtype=bool), 0, 0
    for _ in range(len(distance) - 1):
        left[here] = False
        there = int(np.argmin(np.where(left, distance[here], np.iinfo(np.int64).max)))
        length += int(distance[here, there])
        here = there
    return length + int(distance[here, 0])
