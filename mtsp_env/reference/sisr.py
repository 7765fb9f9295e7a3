"""Kernels of the reference solver: ruin and recreate by string removals (SISR), compiled with Numba.

After Christiaens & Vanden Berghe 2020, "Slack Induction by String Removals for Vehicle Routing Problems", with the
MinMax mTSP's objective: the makespan plus ``TOTAL_WEIGHT`` times the total length. An iteration removes strings of
neighbouring cities from a few tours, puts them back greedily, and keeps the result or undoes it (simulated annealing).

An iteration does O(m) work and none that grows with n: cities go next to one of their ``N_NEAR`` nearest cities or next
to the depot, lengths are kept up to date, a rejected change is undone from a log, and tours are linked lists. In these,
nodes 1..n-1 are the cities, and node n + a is agent a's own copy of the depot, both the start and the end of its tour;
node 0 is unused.

An agent that is under way has a head: the city that it is going to, behind all that it has driven. The leg to it has
the length -inf, so that no detour before it is ever the cheapest place, without a question in the inner loop.

The kernels share one file because Numba's cache on disk sees no change in other files than a compiled function's own.
"""

from __future__ import annotations

from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

# Chosen on uniform instances of 50 to 1000 nodes; half or twice of any of them changes little, but for N_NEAR.
TOTAL_WEIGHT = 0.01  # of the total length against the makespan
N_NEAR = 40  # a city's nearest cities, next to which it may go: half of them are off their tours when it is its turn
MEAN_REMOVED = 10.0  # cities per iteration, about (the paper's c-bar)
MAX_STRING = 10.0  # cities of one string (the paper's L-max)
SPLIT_CHANCE = 0.5  # that a string leaves some cities in its middle (the paper's alpha)
LEAVE_CHANCE = 0.5  # that it leaves one more
LONGEST_CHANCE = 0.5  # that the first string is of the longest tour, which alone sets the makespan
BALANCE_CHANCE = 0.5  # that cities go where the tour stays shortest, not where the objective grows least
BLINK = 300  # the places next to a city are overlooked once in so many times
REFRESH = 4096  # iterations after which the lengths are summed afresh, against drift
FINE = 1e-12  # lengths closer than this are equal


class Search(NamedTuple):
    """What a search holds: N = n + m nodes (m copies of the depot at the end), K = min(N_NEAR, n - 2)."""

    x: np.ndarray  # (N,) float64
    y: np.ndarray  # (N,) float64
    near: np.ndarray  # (n, K) int64, a city's nearest cities, nearest first
    near_distance: np.ndarray  # (n, K) float64
    previous: np.ndarray  # (N,) int32
    next: np.ndarray  # (N,) int32
    leg: np.ndarray  # (N,) float64, distance from the previous node
    tour: np.ndarray  # (N,) int32, the agent; -1: on no tour
    length: np.ndarray  # (m,) float64, of each tour
    n_movable: np.ndarray  # (m,) int32, cities on each tour that may be moved: all but the head
    head: np.ndarray  # (m,) int32, the tour's first city where it must stay so; the agent's depot: closed; 0: free
    driven: np.ndarray  # (m,) float64, length of the tour as far as the head
    ruined: np.ndarray  # (m,) int64, the iteration that last took a string from the tour
    best: np.ndarray  # (N,) int32, ``next`` of the best tours so far
    random: np.ndarray  # (1,) uint64, state of the random numbers, not 0
    city_log: np.ndarray  # (2, n) int32, cities removed (row 0) and put back (row 1), in order
    place_log: np.ndarray  # (n,) int32, the node before each removed city
    tour_log: np.ndarray  # (2, n) int32, the tour of each logged city
    length_log: np.ndarray  # (2, n) float64, the length of that tour before the change
    key: np.ndarray  # (n,) float64, by which the removed cities are sorted


@njit(cache=True, nogil=True)
def nearest_cities(x: np.ndarray, y: np.ndarray, n: int, n_near: int) -> tuple[np.ndarray, np.ndarray]:
    """``near`` and ``near_distance`` of a Search, for nodes at ``x`` and ``y`` (at least n,). O(n^2) time."""
    near, distance = np.zeros((n, n_near), np.int64), np.zeros((n, n_near))
    for city in range(1, n if n_near else 0):
        found = 0
        for other in range(1, n):
            square = (x[city] - x[other]) ** 2 + (y[city] - y[other]) ** 2
            if other == city or (found == n_near and square >= distance[city, found - 1]):
                continue
            found = min(found + 1, n_near)
            i = found - 1
            while i > 0 and distance[city, i - 1] > square:
                distance[city, i], near[city, i] = distance[city, i - 1], near[city, i - 1]
                i -= 1
            distance[city, i], near[city, i] = square, other
    return near, np.sqrt(distance)


@njit(cache=True, nogil=True)
def insert_greedily(search: Search, order: np.ndarray) -> None:
    """Put the cities of ``order`` on the tours in this order, each where its tour stays shortest. O(n^2).

    Without heads the tours begin empty; with any, ``load_tours`` and ``sum_lengths`` have put these on theirs.
    """
    depot = search.tour.shape[0] - search.length.shape[0]
    for city in order:
        least, place = inf, depot
        for node in range(1, search.tour.shape[0]):
            agent = search.tour[node]
            if agent >= 0:
                before = search.previous[node]
                detour = _distance(search, before, city) + _distance(search, city, node) - search.leg[node]
                if search.length[agent] + detour < least:
                    least, place = search.length[agent] + detour, before
        search.length[search.tour[place]] = least
        _link(search, city, place)
    search.best[:] = search.next


@njit(cache=True, nogil=True)
def load_tours(search: Search, order: np.ndarray) -> None:
    """Make the tours anew from ``order`` (n - 1 + m,): the cities of each tour, its head first, and then a 0."""
    depot = search.tour.shape[0] - search.length.shape[0]
    search.n_movable[:] = 0
    for node in range(depot, search.tour.shape[0]):
        search.previous[node] = search.next[node] = node
    home = depot
    for node in order:
        if node == 0:
            home += 1
        else:
            _link(search, node, search.previous[home])
    for agent in range(search.head.shape[0]):
        if 0 < search.head[agent] < depot:
            search.n_movable[agent] -= 1
    search.best[:] = search.next


@njit(cache=True, nogil=True)
def best_order(search: Search) -> np.ndarray:
    """The best tours so far, int64 (n - 1 + m,), as ``load_tours`` takes them."""
    n_agents = search.length.shape[0]
    depot = search.tour.shape[0] - n_agents
    order = np.zeros(depot - 1 + n_agents, np.int64)
    i = 0
    for agent in range(n_agents):
        node = search.best[depot + agent]
        while node < depot:
            order[i] = node
            i += 1
            node = search.best[node]
        i += 1
    return order


@njit(cache=True, nogil=True)
def sum_lengths(search: Search) -> float:
    """Sum the lengths of the tours afresh; the makespan."""
    n_agents = search.length.shape[0]
    depot = search.tour.shape[0] - n_agents
    for agent in range(n_agents):
        length, node = search.driven[agent], depot + agent
        if search.head[agent] > 0:
            node = search.head[agent]
            search.leg[node] = -inf
        while search.head[agent] != depot + agent:
            before, node = node, search.next[node]
            search.leg[node] = _distance(search, before, node)
            length += search.leg[node]
            if node >= depot:
                break
        search.length[agent] = length
    return search.length.max()


@njit(cache=True, nogil=True)
def anneal(
    search: Search, iterations: int, hot: float, cold: float, best: float, enough: float, weight: float
) -> float:
    """Simulated annealing of the current tours from temperature ``hot`` to ``cold``, geometric, in units of length.

    ``search.best`` changes whenever the score, the makespan plus ``weight`` times the total length, falls below
    ``best``; a score of at most ``enough`` ends the search. Returns the best score.
    """
    makespan = sum_lengths(search)
    total = search.length.sum()
    search.ruined[:] = -1
    temperature, cooling = hot, (cold / hot) ** (1.0 / max(1, iterations))
    for iteration in range(iterations):
        if best <= enough:
            break
        if iteration % REFRESH == REFRESH - 1:
            makespan = sum_lengths(search)
            total = search.length.sum()
        n_removed, shrinkage = _ruin(search, iteration, makespan)
        _sort(search, n_removed)
        limit = makespan + TOTAL_WEIGHT * shrinkage - temperature * log(1.0 - _random(search))
        n_back, growth, longest = _recreate(search, n_removed, makespan, limit)
        if longest + TOTAL_WEIGHT * growth < limit:
            makespan = longest
            total += growth - shrinkage
            score = makespan + weight * total
            if score < best - FINE:
                best = score
                search.best[:] = search.next
        else:
            _undo(search, n_removed, n_back)
        temperature *= cooling
    return best


# The parts of an iteration have one caller each and are compiled into it: calls with so many arrays cost a tenth


@njit(cache=True, inline="always")
def _ruin(search: Search, iteration: int, makespan: float) -> tuple[int, float]:
    """Remove strings of cities around a random city; how many cities, and how much the total length shrinks."""
    n_agents = search.length.shape[0]
    n_cities = search.tour.shape[0] - n_agents - 1
    max_string = min(MAX_STRING, max(1.0, n_cities / n_agents))
    n_strings = int(_random(search) * (4.0 * MEAN_REMOVED / (1.0 + max_string) - 1.0) + 1.0)
    centre = 1 + int(_random(search) * n_cities)
    if _random(search) < LONGEST_CHANCE:
        for _ in range(2 * n_agents):
            if search.length[search.tour[centre]] >= makespan - FINE:
                break
            centre = 1 + int(_random(search) * n_cities)
    n_removed, shrinkage = 0, 0.0
    for k in range(-1, search.near.shape[1]):
        city = centre if k < 0 else search.near[centre, k]
        agent = search.tour[city]
        if agent < 0 or search.ruined[agent] == iteration or search.leg[city] == -inf:
            continue
        search.ruined[agent] = iteration
        before = search.length[agent]
        n_removed = _remove_string(search, n_removed, city, agent, max_string)
        shrinkage += before - search.length[agent]
        n_strings -= 1
        if n_strings == 0:
            break
    return n_removed, shrinkage


@njit(cache=True, inline="always")
def _remove_string(search: Search, n_removed: int, city: int, agent: int, max_string: float) -> int:
    """Remove a string of ``agent``'s tour around ``city``, or both ends of a longer one; n_removed from then on."""
    depot = search.tour.shape[0] - search.length.shape[0]
    count = search.n_movable[agent]
    n_remove = int(_random(search) * min(float(count), max_string) + 1.0)
    n_leave = 0
    if 1 < n_remove < count and _random(search) < SPLIT_CHANCE:
        n_leave = 1
        while n_remove + n_leave < count and _random(search) < LEAVE_CHANCE:
            n_leave += 1
    span = n_remove + n_leave
    # The string begins up to span - 1 cities before this one, as far as the ends of the tour allow
    node, behind, most_behind = city, 0, int(_random(search) * span)
    while behind < most_behind and search.previous[node] < depot and search.leg[search.previous[node]] > -inf:
        node = search.previous[node]
        behind += 1
    last, ahead = city, 0
    while behind + ahead < span - 1 and search.next[last] < depot:
        last = search.next[last]
        ahead += 1
    for _ in range(span - 1 - behind - ahead):
        node = search.previous[node]
    leave_from = 1 + int(_random(search) * (n_remove - 1))
    for i in range(span):
        following = search.next[node]
        if not leave_from <= i < leave_from + n_leave:
            search.city_log[0, n_removed] = node
            search.place_log[n_removed] = search.previous[node]
            search.tour_log[0, n_removed] = agent
            search.length_log[0, n_removed] = search.length[agent]
            n_removed += 1
            legs = search.leg[node] + search.leg[following]
            _unlink(search, node)
            search.length[agent] += search.leg[following] - legs
        node = following
    return n_removed


@njit(cache=True, inline="always")
def _sort(search: Search, n_removed: int) -> None:
    """The order in which cities go back: random, farthest from the depot first, or nearest first (4 : 2 : 1)."""
    depot = search.tour.shape[0] - 1
    rule = _random(search) * 7.0
    for i in range(n_removed):
        city = search.city_log[0, i]
        if rule < 4.0:
            j = int(_random(search) * (i + 1.0))
            search.city_log[1, i] = search.city_log[1, j]
        else:
            key, j = _distance(search, depot, city) * (-1.0 if rule < 6.0 else 1.0), i
            while j > 0 and search.key[j - 1] > key:
                search.key[j], search.city_log[1, j] = search.key[j - 1], search.city_log[1, j - 1]
                j -= 1
            search.key[j] = key
        search.city_log[1, j] = city


@njit(cache=True, inline="always")
def _recreate(search: Search, n_removed: int, makespan: float, limit: float) -> tuple[int, float, float]:
    """Put the removed cities back, each at its cheapest place, until the makespan plus the weighted growth of the total
    length is at least ``limit``: it never falls again. How many are back, that growth, and that makespan."""
    balance = _random(search) < BALANCE_CHANCE
    n_back, growth, longest = 0, 0.0, search.length.max()
    while n_back < n_removed and longest + TOTAL_WEIGHT * growth < limit:
        city = search.city_log[1, n_back]
        place, detour = _cheapest_place(search, city, makespan, balance)
        agent = search.tour[place]
        search.tour_log[1, n_back] = agent
        search.length_log[1, n_back] = search.length[agent]
        search.length[agent] += detour
        longest = max(longest, search.length[agent])
        growth += detour
        _link(search, city, place)
        n_back += 1
    return n_back, growth, longest


@njit(cache=True, inline="always")
def _cheapest_place(search: Search, city: int, makespan: float, balance: bool) -> tuple[int, float]:
    """The node after which ``city`` goes, and by how much its tour grows."""
    depot = search.tour.shape[0] - search.length.shape[0]
    blink = int(_random(search) * BLINK)
    found = (inf, depot, 0.0)
    for k in range(search.near.shape[1]):
        node = search.near[city, k]
        if search.tour[node] >= 0 and k != blink:
            found = _cheaper(search, city, node, search.near_distance[city, k], makespan, balance, found)
    home = _distance(search, depot, city)
    for node in range(depot, search.tour.shape[0]):  # without blinks, so that there always is a place
        found = _cheaper(search, city, node, home, makespan, balance, found)
    _, place, growth = found
    return place, growth


@njit(cache=True, inline="always")
def _cheaper(
    search: Search,
    city: int,
    node: int,
    to_node: float,
    makespan: float,
    balance: bool,
    found: tuple[float, int, float],
) -> tuple[float, int, float]:
    """``found`` (cost, place, growth of the tour), or the place before or after ``node`` where one is cheaper."""
    least, place, place_growth = found
    length = search.length[search.tour[node]]
    offset = length if balance else 0.0
    for side in range(2):  # before the node, after it
        end = node if side == 0 else search.next[node]
        # A cheap bound: the leg's other end is farther away than this node, or the leg has had its turn from there
        if 2.0 * to_node - search.leg[end] + offset >= least:
            continue
        other = search.previous[node] if side == 0 else end
        growth = to_node + _distance(search, other, city) - search.leg[end]
        cost = offset + growth
        if not balance and length + growth > makespan:
            cost += (length + growth - makespan) / TOTAL_WEIGHT
        if cost < least:
            least, place, place_growth = cost, search.previous[end], growth
    return least, place, place_growth


@njit(cache=True, inline="always")
def _undo(search: Search, n_removed: int, n_back: int) -> None:
    for i in range(n_back - 1, -1, -1):
        _unlink(search, search.city_log[1, i])
        search.length[search.tour_log[1, i]] = search.length_log[1, i]
    for i in range(n_removed - 1, -1, -1):
        _link(search, search.city_log[0, i], search.place_log[i])
        search.length[search.tour_log[0, i]] = search.length_log[0, i]


@njit(cache=True, inline="always")
def _link(search: Search, city: int, place: int) -> None:
    """Put ``city`` after the node ``place``; the tour's length is the caller's to change."""
    following = search.next[place]
    search.next[place], search.previous[city] = city, place
    search.next[city], search.previous[following] = following, city
    search.leg[city] = _distance(search, place, city)
    search.leg[following] = _distance(search, city, following)
    search.tour[city] = search.tour[place]
    search.n_movable[search.tour[place]] += 1


@njit(cache=True, inline="always")
def _unlink(search: Search, city: int) -> None:
    """Take ``city`` off its tour; the tour's length is the caller's to change."""
    before, following = search.previous[city], search.next[city]
    search.next[before], search.previous[following] = following, before
    search.leg[following] = _distance(search, before, following)
    search.n_movable[search.tour[city]] -= 1
    search.tour[city] = -1


@njit(cache=True, inline="always")
def _distance(search: Search, a: int, b: int) -> float:
    dx, dy = search.x[a] - search.x[b], search.y[a] - search.y[b]
    return sqrt(dx * dx + dy * dy)


@njit(cache=True, inline="always")
def _random(search: Search) -> float:
    """Uniform in [0, 1): xorshift64*."""
    z = search.random[0]
    z ^= z >> np.uint64(12)
    z ^= z << np.uint64(25)
    z ^= z >> np.uint64(27)
    search.random[0] = z
    return float((z * np.uint64(2685821657736338717)) >> np.uint64(11)) * 2.0**-53
