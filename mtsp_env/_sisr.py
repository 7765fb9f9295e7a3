"""Kernels of the reference solver: ruin and recreate by string removals (SISR), compiled with Numba.

After Christiaens & Vanden Berghe 2020, "Slack Induction by String Removals for Vehicle Routing Problems", with the
MinMax mTSP's objective: the makespan plus ``TOTAL_WEIGHT`` times the total length. One iteration removes strings of
neighbouring cities from a few tours, reinserts them greedily, and keeps the result or undoes it (simulated annealing).

No iteration does O(n) work: cities go next to one of their ``N_NEAR`` nearest cities or next to the depot, lengths are
kept up to date, a rejected change is undone from a log, and the tours are a doubly linked list. In it nodes 1..n-1 are
the cities and node n + a is agent a's own copy of the depot, both the start and the end of its tour (node 0 is unused).
"""

from __future__ import annotations

from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

# Chosen on uniform instances of 50 to 1000 nodes; the result changes little for half or twice of any of them.
TOTAL_WEIGHT = 0.01  # of the total length against the makespan
N_NEAR = 20  # a city's nearest cities, next to which it may go
MEAN_REMOVED = 10.0  # cities per iteration, about (the paper's c-bar)
MAX_STRING = 10.0  # cities of one string (the paper's L-max)
SPLIT_CHANCE = 0.5  # that a string keeps some cities in its middle (the paper's alpha)
KEEP_MORE = 0.5  # chance that it keeps one more
LONGEST_CHANCE = 0.5  # that the first string is taken from the longest tour, the only one that sets the makespan
BALANCE_CHANCE = 0.5  # that cities go where the tour stays shortest, not where the objective grows least
BLINK = 300  # each place is overlooked once in so many times
REFRESH = 4096  # iterations after which lengths are summed afresh, against drift
FINE = 1e-12  # lengths closer than this are equal


class Search(NamedTuple):
    """What a search holds: N = n + m nodes (m copies of the depot at the end), K = min(N_NEAR, n - 2)."""

    x: np.ndarray  # (N,) float64
    y: np.ndarray  # (N,) float64
    near: np.ndarray  # (n, K) int32: a city's nearest cities, nearest first
    near_distance: np.ndarray  # (n, K) float64
    previous: np.ndarray  # (N,) int32
    next: np.ndarray  # (N,) int32
    leg: np.ndarray  # (N,) float64: distance from the previous node
    tour: np.ndarray  # (N,) int32: the agent, -1 where the city is on no tour
    length: np.ndarray  # (m,) float64, of each tour
    count: np.ndarray  # (m,) int32: cities on each tour
    ruined: np.ndarray  # (m,) int64: the iteration that last took a string from the tour
    best: np.ndarray  # (N,) int32: ``next`` of the best tours so far
    random: np.ndarray  # (1,) uint64, state of the random numbers
    city_log: np.ndarray  # (2, n) int32: cities removed (row 0) and reinserted (row 1), in order
    place_log: np.ndarray  # (n,) int32: the node before each removed city
    tour_log: np.ndarray  # (2, n) int32: its tour
    length_log: np.ndarray  # (2, n) float64: the length of that tour before the change
    key: np.ndarray  # (n,) float64: what the removed cities are sorted by


@njit(cache=True, nogil=True)
def new_search(nodes: np.ndarray, n_agents: int, seed: int) -> Search:
    """A search over ``nodes`` (n, 2) with empty tours; ``seed`` is uint64. O(n^2) time, O(n) memory."""
    n = nodes.shape[0]
    size = n + n_agents
    x, y = np.empty(size), np.empty(size)
    x[:n], y[:n] = nodes[:, 0], nodes[:, 1]
    x[n:], y[n:] = nodes[0, 0], nodes[0, 1]
    near, near_distance = _nearest_cities(nodes, min(N_NEAR, n - 2))
    itself = np.arange(size).astype(np.int32)  # an empty tour: the depot before and after itself
    tour = np.full(size, -1, np.int32)
    tour[n:] = np.arange(n_agents)
    # splitmix64 spreads neighbouring seeds apart; xorshift must not start at 0
    z = np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    random = np.full(1, (z ^ (z >> np.uint64(31))) | np.uint64(1))
    return Search(
        x, y, near, near_distance, itself, itself.copy(), np.zeros(size), tour,
        np.zeros(n_agents), np.zeros(n_agents, np.int32), np.zeros(n_agents, np.int64), itself.copy(), random,
        np.zeros((2, n), np.int32), np.zeros(n, np.int32), np.zeros((2, n), np.int32), np.zeros((2, n)), np.zeros(n),
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _nearest_cities(nodes, k_near):
    n = nodes.shape[0]
    near, distance = np.zeros((n, k_near), np.int32), np.zeros((n, k_near))
    for city in range(1, n):
        found = 0
        for other in range(1, n):
            if other == city:
                continue
            dx, dy = nodes[city, 0] - nodes[other, 0], nodes[city, 1] - nodes[other, 1]
            square = dx * dx + dy * dy
            if found < k_near:
                found += 1
            elif k_near == 0 or square >= distance[city, k_near - 1]:
                continue
            i = found - 1
            while i > 0 and distance[city, i - 1] > square:
                distance[city, i], near[city, i] = distance[city, i - 1], near[city, i - 1]
                i -= 1
            distance[city, i], near[city, i] = square, other
    return near, np.sqrt(distance)


@njit(cache=True, nogil=True)
def insert_greedily(search: Search) -> None:
    """Put every city on a tour, the farthest from the depot first, each where its tour stays shortest. O(n^2)."""
    n_agents = search.length.shape[0]
    n = search.tour.shape[0] - n_agents
    home = np.empty(n - 1)
    for city in range(1, n):
        home[city - 1] = _distance(search, n, city)
    for city in np.argsort(-home, kind="mergesort") + 1:
        least, place = inf, n
        for node in range(1, n + n_agents):
            if search.tour[node] >= 0:
                to_city = _distance(search, search.previous[node], city) + _distance(search, city, node)
                length = search.length[search.tour[node]] + to_city - search.leg[node]
                if length < least:
                    least, place = length, search.previous[node]
        search.length[search.tour[place]] = least
        _link(search, city, place)
    search.best[:] = search.next


@njit(cache=True, nogil=True)
def load_tours(search: Search, cities: np.ndarray, agents: np.ndarray) -> None:
    """Put ``cities`` (n - 1,) in this order at the ends of the tours of ``agents`` (n - 1,)."""
    n = search.tour.shape[0] - search.length.shape[0]
    for city, agent in zip(cities, agents):  # noqa: B905 (Numba knows no strict=)
        _link(search, city, search.previous[n + agent])
    search.best[:] = search.next


@njit(cache=True, nogil=True)
def best_order(search: Search) -> np.ndarray:
    """The best tours so far, int64 (n - 1 + m,): each tour's cities followed by a 0."""
    n_agents = search.length.shape[0]
    n = search.tour.shape[0] - n_agents
    order = np.zeros(n - 1 + n_agents, np.int64)
    i = 0
    for agent in range(n_agents):
        node = search.best[n + agent]
        while node < n:
            order[i] = node
            i += 1
            node = search.best[node]
        i += 1
    return order


@njit(cache=True, nogil=True)
def sum_lengths(search: Search) -> float:
    """Sum the tours' lengths afresh; the makespan."""
    n_agents = search.length.shape[0]
    depot = search.tour.shape[0] - n_agents
    for agent in range(n_agents):
        length, node = 0.0, search.next[depot + agent]
        while node < depot:
            search.leg[node] = _distance(search, search.previous[node], node)
            length += search.leg[node]
            node = search.next[node]
        search.leg[node] = _distance(search, search.previous[node], node)
        search.length[agent] = length + search.leg[node]
    return search.length.max()


@njit(cache=True, nogil=True)
def anneal(search: Search, iterations: int, hot: float, cold: float, best: float, enough: float) -> float:
    """Simulated annealing from temperature ``hot`` to ``cold`` (units of length, geometric), from the current tours.

    ``search.best`` changes whenever the makespan falls below ``best``; a makespan of at most ``enough`` ends the search.
    Returns the best makespan.
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
        n_removed, change = _ruin(search, iteration, makespan)
        _sort(search, n_removed)
        change += _recreate(search, n_removed, makespan)
        new_makespan = search.length.max()
        worse = new_makespan - makespan + TOTAL_WEIGHT * change
        if worse < -temperature * log(1.0 - _random(search)):
            makespan = new_makespan
            total += change
            if makespan < best - FINE:
                best = makespan
                search.best[:] = search.next
        else:
            _undo(search, n_removed)
        temperature *= cooling
    return best


@njit(cache=True, nogil=True)
def _ruin(search, iteration, makespan):
    """Remove strings of cities around a random city; how many cities, and the change of the total length."""
    n_agents = search.length.shape[0]
    n = search.tour.shape[0] - n_agents
    longest_string = min(MAX_STRING, max(1.0, (n - 1) / n_agents))
    n_strings = int(_random(search) * (4.0 * MEAN_REMOVED / (1.0 + longest_string) - 1.0) + 1.0)
    centre = 1 + int(_random(search) * (n - 1))
    if _random(search) < LONGEST_CHANCE:
        for _ in range(2 * n_agents):
            if search.length[search.tour[centre]] >= makespan - FINE:
                break
            centre = 1 + int(_random(search) * (n - 1))
    n_removed, change = 0, 0.0
    for k in range(-1, search.near.shape[1]):
        city = centre if k < 0 else search.near[centre, k]
        agent = search.tour[city]
        if agent < 0 or search.ruined[agent] == iteration:
            continue
        search.ruined[agent] = iteration
        before = search.length[agent]
        n_removed = _remove_string(search, n_removed, city, agent, longest_string)
        change += search.length[agent] - before
        n_strings -= 1
        if n_strings == 0:
            break
    return n_removed, change


@njit(cache=True, nogil=True)
def _remove_string(search, n_removed, city, agent, longest_string):
    """Remove a string of its tour around ``city``, perhaps without some cities in its middle; the new n_removed."""
    n = search.tour.shape[0] - search.length.shape[0]
    count = search.count[agent]
    n_remove = int(_random(search) * min(float(count), longest_string) + 1.0)
    n_keep = 0
    if 1 < n_remove < count and _random(search) < SPLIT_CHANCE:
        n_keep = 1
        while n_remove + n_keep < count and _random(search) < KEEP_MORE:
            n_keep += 1
    span = n_remove + n_keep
    # the string's first city: up to span - 1 before this one, as the ends of the tour allow
    first, steps = city, int(_random(search) * span)
    behind = 0
    while behind < steps and search.previous[first] < n:
        first = search.previous[first]
        behind += 1
    last, ahead = city, 0
    while behind + ahead < span - 1 and search.next[last] < n:
        last = search.next[last]
        ahead += 1
    while behind + ahead < span - 1:
        first = search.previous[first]
        behind += 1
    keep_from = 1 + int(_random(search) * (n_remove - 1))
    node = first
    for i in range(span):
        following = search.next[node]
        if i < keep_from or i >= keep_from + n_keep:
            search.city_log[0, n_removed] = node
            search.place_log[n_removed] = search.previous[node]
            search.tour_log[0, n_removed] = agent
            search.length_log[0, n_removed] = search.length[agent]
            shorter = search.leg[node] + search.leg[following]
            _unlink(search, node)
            search.length[agent] += search.leg[following] - shorter
            n_removed += 1
        node = following
    return n_removed


@njit(cache=True, nogil=True)
def _sort(search, n_removed):
    """Order in which the removed cities go back: random, farthest from the depot first, or nearest first (4 : 2 : 1)."""
    depot = search.tour.shape[0] - 1
    rule = _random(search) * 7.0
    for i in range(n_removed):
        city = search.city_log[0, i]
        if rule < 4.0:
            key = _random(search)
        else:
            key = _distance(search, depot, city) * (-1.0 if rule < 6.0 else 1.0)
        while i > 0 and search.key[i - 1] > key:
            search.key[i], search.city_log[1, i] = search.key[i - 1], search.city_log[1, i - 1]
            i -= 1
        search.key[i], search.city_log[1, i] = key, city


@njit(cache=True, nogil=True)
def _recreate(search, n_removed, makespan):
    """Put the removed cities back, each at its cheapest place; the change of the total length."""
    balance = _random(search) < BALANCE_CHANCE
    change = 0.0
    for i in range(n_removed):
        city = search.city_log[1, i]
        place, growth = _cheapest_place(search, city, makespan, balance)
        agent = search.tour[place]
        search.tour_log[1, i] = agent
        search.length_log[1, i] = search.length[agent]
        search.length[agent] += growth
        change += growth
        _link(search, city, place)
    return change


@njit(cache=True, nogil=True)
def _cheapest_place(search, city, makespan, balance):
    """The node after which ``city`` goes, and by how much its tour grows."""
    n_agents = search.length.shape[0]
    n = search.tour.shape[0] - n_agents
    n_near = search.near.shape[1]
    home = _distance(search, n, city)
    blink = int(_random(search) * BLINK)
    least, place, place_growth = inf, n, 0.0
    for k in range(n_near + n_agents):
        node = search.near[city, k] if k < n_near else n + k - n_near
        to_node = search.near_distance[city, k] if k < n_near else home
        agent = search.tour[node]
        if agent < 0 or k == blink:
            continue
        length = search.length[agent]
        offset = length if balance else 0.0
        for side in range(2):  # before or after the node
            end = node if side == 0 else search.next[node]
            # An edge's other node is farther than this one, or the edge has had its turn there: a cheap bound
            if 2.0 * to_node - search.leg[end] + offset >= least:
                continue
            other = search.previous[node] if side == 0 else end
            growth = to_node + _distance(search, other, city) - search.leg[end]
            cost = offset + growth
            if not balance and length + growth > makespan:
                cost += (length + growth - makespan) / TOTAL_WEIGHT
            if cost < least:
                least, place, place_growth = cost, search.previous[end], growth
    return place, place_growth


@njit(cache=True, nogil=True)
def _undo(search, n_removed):
    for i in range(n_removed - 1, -1, -1):
        _unlink(search, search.city_log[1, i])
        search.length[search.tour_log[1, i]] = search.length_log[1, i]
    for i in range(n_removed - 1, -1, -1):
        _link(search, search.city_log[0, i], search.place_log[i])
        search.length[search.tour_log[0, i]] = search.length_log[0, i]


@njit(cache=True, nogil=True, inline="always")
def _link(search, city, place):
    """Put ``city`` after ``place``; the length of the tour is the caller's to change."""
    following = search.next[place]
    search.next[place], search.previous[city] = city, place
    search.next[city], search.previous[following] = following, city
    search.leg[city] = _distance(search, place, city)
    search.leg[following] = _distance(search, city, following)
    search.tour[city] = search.tour[place]
    search.count[search.tour[place]] += 1


@njit(cache=True, nogil=True, inline="always")
def _unlink(search, city):
    """Take ``city`` off its tour; the length of the tour is the caller's to change."""
    before, following = search.previous[city], search.next[city]
    search.next[before], search.previous[following] = following, before
    search.leg[following] = _distance(search, before, following)
    search.count[search.tour[city]] -= 1
    search.tour[city] = -1


@njit(cache=True, nogil=True, inline="always")
def _distance(search, a, b):
    dx, dy = search.x[a] - search.x[b], search.y[a] - search.y[b]
    return sqrt(dx * dx + dy * dy)


@njit(cache=True, nogil=True, inline="always")
def _random(search):
    """Uniform in [0, 1): xorshift64*."""
    z = search.random[0]
    z ^= z >> np.uint64(12)
    z ^= z << np.uint64(25)
    z ^= z >> np.uint64(27)
    search.random[0] = z
    return float((z * np.uint64(2685821657736338717)) >> np.uint64(11)) * 2.0**-53
