"""The program that ``exact`` describes: from an instance to variables and rows, and from values back to tours."""

from __future__ import annotations

import itertools

import numpy as np

from benchmarks.solvers._milp import Rows, Variables
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import lower_bound, makespan

ROUNDING = 1e-6  # by how much tours may exceed the limit, so that rounding excludes none


class Program:
    """The program of an instance. Its columns are T, x of each arc, and u of each city.

    Attributes:
        variables, rows: the program.
        start: the tours ``start`` as values of the variables, (columns,), or None.
    """

    def __init__(self, instance: Instance, start: Tours | None = None) -> None:
        self.n_agents, self.n_nodes = instance.n_agents, instance.n_nodes
        self.distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes[None], axis=2)  # (n, n)
        self.home = self.distance[0]
        limit = greedy_makespan(self.distance, self.n_agents) if start is None else makespan(instance, start)
        self.limit = limit + ROUNDING
        allowed = self.home[:, None] + self.distance + self.home <= self.limit
        np.fill_diagonal(allowed, False)
        self.tail, self.head = np.nonzero(allowed)  # (arcs,) each
        self.length = self.distance[self.tail, self.head]
        self.arc = np.arange(len(self.tail)) + 1  # columns
        self.apart = self._cities_apart()
        self.variables = self._variables(lower_bound(instance))
        self.rows = Rows()
        self._add_tours()
        self._add_distances()
        self.start = None if start is None else self._values(start)

    def _arrival(self, city: np.ndarray | int) -> np.ndarray | int:
        """The column of a city's u."""
        return len(self.arc) + city

    def _cities_apart(self) -> np.ndarray:
        """Cities of which no two can be on the same tour, the farthest from the depot first."""
        apart: list[int] = []
        for city in np.argsort(-self.home[1:], kind="stable") + 1:
            if (self.home[city] + self.distance[city, apart] + self.home[apart] > self.limit).all():
                apart.append(city)
        return np.array(apart)

    def _variables(self, bound: float) -> Variables:
        home, arcs = self.home[1:], len(self.arc)
        return Variables(
            cost=np.concatenate([[1.0], np.zeros(arcs + len(home))]),
            lower=np.concatenate([[bound], np.zeros(arcs), home]),
            upper=np.concatenate([[max(self.limit, bound)], np.ones(arcs), self.limit - home]),
            binary=np.concatenate([[False], np.ones(arcs, bool), np.zeros(len(home), bool)]),
        )

    def _add_tours(self) -> None:
        cities, add = self.n_nodes - 1, self.rows.add
        into, out = self.head > 0, self.tail > 0
        add(1, 1, cities, (self.head[into] - 1, self.arc[into], 1))
        add(1, 1, cities, (self.tail[out] - 1, self.arc[out], 1))
        add(1, self.n_agents, 1, (0, self.arc[~out], 1))
        pair, back = self._pairs()
        row = np.arange(len(pair))
        add(-np.inf, 1, len(pair), (row, self.arc[pair], 1), (row, self.arc[back], 1))

    def _pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions of the arcs i -> j between two cities with i < j, and of the arcs j -> i, (pairs,) each."""
        place = np.full((self.n_nodes, self.n_nodes), -1)
        place[self.tail, self.head] = np.arange(len(self.arc))
        pair = np.flatnonzero((self.tail > 0) & (self.tail < self.head))
        return pair, place[self.head[pair], self.tail[pair]]

    def _add_distances(self) -> None:
        home, cities, add = self.home, np.arange(1, self.n_nodes), self.rows.add
        # u_i - u_j + M x_ij + (M - 2 d_ij) x_ji <= M - d_ij, the least M being U - d_0i - d_0j + d_ij
        pair, back = self._pairs()
        ij, ji = np.concatenate([pair, back]), np.concatenate([back, pair])
        i, j, d, row = self.tail[ij], self.head[ij], self.length[ij], np.arange(len(ij))
        big = self.limit - home[i] - home[j] + d
        terms = (self._arrival(i), 1), (self._arrival(j), -1), (self.arc[ij], big), (self.arc[ji], big - 2.0 * d)
        add(-np.inf, big - d, len(ij), *((row, column, value) for column, value in terms))
        # u_j >= the sum over i of (d_0i + d_ij) x_ij
        into, out, row = self.head > 0, self.tail > 0, cities - 1
        least = home[self.tail[into]] + self.length[into]
        add(0, np.inf, len(cities), (row, self._arrival(cities), 1), (self.head[into] - 1, self.arc[into], -least))
        # T >= u_j + the sum over k of (d_jk + d_k0) x_jk
        rest = self.length[out] + home[self.head[out]]
        last = (row, 0, 1), (row, self._arrival(cities), -1), (self.tail[out] - 1, self.arc[out], -rest)
        add(0, np.inf, len(cities), *last)
        add(0, np.inf, 1, (0, 0, self.n_agents), (0, self.arc, -self.length))
        row = np.arange(len(self.apart))
        add(0, np.inf, len(row), (row, 0, 0.5), (row, self._arrival(self.apart), -1))

    def forbid(self, cycles: list[list[int]]) -> None:
        """Forbid tours within the cities of each cycle: fewer arcs than cities."""
        for cycle in cycles:
            within = np.isin(self.tail, cycle) & np.isin(self.head, cycle)
            self.rows.add(-np.inf, len(cycle) - 1, 1, (0, self.arc[within], 1))

    def tours(self, values: np.ndarray) -> tuple[Tours, list[list[int]]]:
        """The tours that ``values`` describe, one per agent, and the cycles without the depot."""
        taken = values[self.arc] > 0.5
        first, onward = taken & (self.tail == 0), taken & (self.tail > 0)
        after = dict(zip(self.tail[onward].tolist(), self.head[onward].tolist(), strict=True))
        tours: Tours = []
        for city in self.head[first].tolist():
            tours.append([0])
            while city != 0:
                tours[-1].append(city)
                city = after.pop(city)
        cycles = []
        while after:
            first, city = after.popitem()
            cycles.append([first])
            while city != first:
                cycles[-1].append(city)
                city = after.pop(city)
        tours += [[0] for _ in range(self.n_agents - len(tours))]
        return [[*tour, 0] for tour in tours], cycles

    def _values(self, tours: Tours) -> np.ndarray:
        """``tours`` as values of the variables, each in the direction that the rows allow."""
        values = np.zeros(len(self.variables.cost))
        column = dict(zip(zip(self.tail.tolist(), self.head.tolist(), strict=True), self.arc.tolist(), strict=True))
        for tour in tours:
            nodes = [0, *(node for node in tour if node != 0), 0]  # visits of the depot on the way are left out
            if len(nodes) == 2:
                continue
            arrival = np.concatenate([[0.0], np.cumsum(self.distance[nodes[:-1], nodes[1:]])])
            if (arrival[np.isin(nodes, self.apart)] > arrival[-1] / 2.0).any():
                nodes, arrival = nodes[::-1], arrival[-1] - arrival[::-1]
            values[[column[arc] for arc in itertools.pairwise(nodes)]] = 1.0
            values[self._arrival(np.array(nodes[1:-1]))] = arrival[1:-1]
            values[0] = max(values[0], arrival[-1])
        return values


def greedy_makespan(distance: np.ndarray, n_agents: int) -> float:
    """Makespan of greedy insertion: cities, the farthest first, go to the place that gives the shortest tour.

    Args:
        distance: (n, n); node 0 is the depot.
        n_agents: number of tours.
    """
    n = len(distance)
    tail, head = np.zeros(n_agents + n - 1, np.int64), np.zeros(n_agents + n - 1, np.int64)  # the legs' ends
    agent = np.concatenate([np.arange(n_agents), np.zeros(n - 1, np.int64)])  # the legs' agents
    length, legs = np.zeros(n_agents), n_agents
    for city in np.argsort(-distance[0, 1:], kind="stable") + 1:
        a, b = tail[:legs], head[:legs]
        longer = length[agent[:legs]] + distance[a, city] + distance[city, b] - distance[a, b]
        leg = int(np.argmin(longer))
        length[agent[leg]] = longer[leg]
        tail[legs], head[legs], agent[legs] = city, head[leg], agent[leg]
        head[leg] = city
        legs += 1
    return float(length.max())
