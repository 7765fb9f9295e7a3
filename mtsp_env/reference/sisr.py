"""Kernels of the reference solver: ruin and recreate by string removals (SISR), compiled with Numba.

Source: Christiaens & Vanden Berghe 2020, "Slack Induction by String Removals for Vehicle Routing Problems". The
objective here is that of the MinMax mTSP: the makespan plus ``TOTAL_WEIGHT`` times the total length. An iteration
removes strings of neighbouring cities from a few tours and puts the cities back greedily; simulated annealing keeps the
result or undoes it.

An iteration takes O(m) time, independent of n: a city goes next to one of its ``N_NEAR`` nearest cities or next to the
depot, lengths are kept up to date, rejected changes are undone from a log, and tours are linked lists. In these lists
nodes 1..n-1 are the cities. Node n + a is agent a's own copy of the depot, both the start and the end of its tour. Node
0 is unused.

An agent that is under way has a *head*: the city that it is at or going to, the last one that is fixed. The leg to a
head has length -inf, so that the place before it is never the cheapest; the inner loop needs no test for heads.

Legs are distances, tours are times. In plain problems these are the same, and ``pace`` and ``service`` are None: Numba
then compiles kernels without them, so that plain problems do not pay for worlds.

All kernels are in this file because Numba's cache on disk notices changes only in a compiled function's own file.
"""

from __future__ import annotations

from math import inf, log, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit, types
from numba.extending import overload

# Chosen on uniform instances of 50 to 1000 nodes. Halving or doubling any of them changes little, except N_NEAR.
TOTAL_WEIGHT = 0.01  # of the total length, relative to the makespan
N_NEAR = 40  # nearest cities next to which a city may go; about half of them are removed when it is put back
MEAN_REMOVED = 10.0  # cities removed per iteration, approximately (the paper's c-bar)
MAX_STRING = 10.0  # largest number of cities in a string (the paper's L-max)
SPLIT_CHANCE = 0.5  # that a string keeps some cities in its middle (the paper's alpha)
LEAVE_CHANCE = 0.5  # that it keeps one more
LONGEST_CHANCE = 0.5  # that the first string is from the longest tour, which alone sets the makespan
BALANCE_CHANCE = 0.5  # that cities go where the tour stays shortest, not where the objective grows least
BLINK = 300  # each nearest city is overlooked as a place with a chance of 1 / BLINK
REFRESH = 4096  # iterations after which the lengths are summed again, to remove rounding errors
TOLERANCE = 1e-12  # lengths closer than this are equal


class Search(NamedTuple):
    """The arrays of a search: N = n + m nodes (m copies of the depot at the end), K = min(N_NEAR, n - 2)."""

    x: np.ndarray  # (N,) float64
    y: np.ndarray  # (N,) float64
    near: np.ndarray  # (n, K) int64, each city's nearest cities, nearest first
    near_distance: np.ndarray  # (n, K) float64
    previous: np.ndarray  # (N,) int32
    next: np.ndarray  # (N,) int32
    leg: np.ndarray  # (N,) float64, distance from the previous node
    tour: np.ndarray  # (N,) int32, the agent on whose tour the node is; -1: on none
    length: np.ndarray  # (m,) float64, time of each tour; if plain, its length
    n_movable: np.ndarray  # (m,) int32, cities on each tour that may be moved: all but the head
    head: np.ndarray  # (m,) int32, the fixed first city of each tour; 0: none; the agent's depot: the tour is closed
    driven: np.ndarray  # (m,) float64, time of each tour up to its head, the visit there included
    ruined: np.ndarray  # (m,) int64, the last iteration that removed a string from the tour
    best: np.ndarray  # (N,) int32, ``next`` of the best tours so far
    random: np.ndarray  # (1,) uint64, state of the random number generator, not 0
    city_log: np.ndarray  # (2, n) int32, cities removed (row 0) and put back (row 1), in order
    place_log: np.ndarray  # (n,) int32, the node before each removed city
    tour_log: np.ndarray  # (2, n) int32, the tour of each logged city
    length_log: np.ndarray  # (2, n) float64, the length of that tour before the change
    key: np.ndarray  # (n,) float64, sort keys of the removed cities
    pace: np.ndarray | None = None  # (m,) float64, time per distance of each agent; None: 1
    service: np.ndarray | None = None  # (N,) float64, time that a visit takes, 0 at the depots; None if pace is None


@njit(cache=True, nogil=True)
def nearest_cities(x: np.ndarray, y: np.ndarray, n_near: int) -> tuple[np.ndarray, np.ndarray]:
    """``near`` and ``near_distance`` of a Search for nodes with the coordinates ``x`` and ``y`` (n,). O(n^2) time."""
    n = x.shape[0]
    near, distance = np.zeros((n, n_near), np.int64), np.zeros((n, n_near))
    for city in range(1, n if n_near else 0):
        n_listed = 0
        for other in range(1, n):
            square = (x[city] - x[other]) ** 2 + (y[city] - y[other]) ** 2
            if other == city or (n_listed == n_near and square >= distance[city, n_listed - 1]):
                continue
            n_listed = min(n_listed + 1, n_near)
            i = n_listed - 1
            while i > 0 and distance[city, i - 1] > square:
                distance[city, i], near[city, i] = distance[city, i - 1], near[city, i - 1]
                i -= 1
            distance[city, i], near[city, i] = square, other
    return near, np.sqrt(distance)


@njit(cache=True, nogil=True)
def insert_greedily(search: Search, order: np.ndarray) -> None:
    """Put the cities of ``order`` on the tours in this order, each where its tour stays shortest.

    The places are those next to one of the city's nearest cities or next to the depot, so this takes O(n m) time. If
    there are heads, call ``load_tours`` and ``sum_lengths`` first; otherwise the tours must be empty.
    """
    depot, fastest = search.tour.shape[0] - search.length.shape[0], _fastest(search.pace)
    for city in order:
        cheapest = _cheapest_near(search, city, inf, True, -1)
        home = _distance(search, depot, city)
        shortest = _time(search.pace, search.service, fastest, 2.0 * home, city)
        for agent in range(search.length.shape[0]):
            if cheapest[0] <= shortest:  # no tour that visits the city is shorter
                break
            if search.length[agent] < cheapest[0]:
                cheapest = _cheaper(search, city, depot + agent, home, inf, True, cheapest)
        _, place, growth = cheapest
        search.length[search.tour[place]] += growth
        _link(search, city, place)
    search.best[:] = search.next


@njit(cache=True, nogil=True)
def load_tours(search: Search, order: np.ndarray) -> None:
    """Replace the tours by ``order`` (n - 1 + m,): for each tour its cities, the head first, and then a 0."""
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
    """The best tours so far in the form of ``load_tours``, int64 (n - 1 + m,)."""
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
    """Compute the tours' times and the legs from the coordinates; returns the makespan."""
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
            length += _time(search.pace, search.service, agent, search.leg[node], node)
            if node >= depot:
                break
        search.length[agent] = length
    return search.length.max()


@njit(cache=True, nogil=True)
def anneal(
    search: Search, iterations: int, hot: float, cold: float, best: float, target: float, weight: float
) -> float:
    """Anneal the current tours from temperature ``hot`` to ``cold`` (lengths), with geometric cooling.

    The score is the makespan plus ``weight`` times the total length. Tours with a score below ``best`` are copied to
    ``search.best``; a score of at most ``target`` ends the search. Returns the best score.
    """
    makespan = sum_lengths(search)
    total = search.length.sum()
    search.ruined[:] = -1
    temperature, cooling = hot, (cold / hot) ** (1.0 / max(1, iterations))
    for iteration in range(iterations):
        if best <= target:
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
            if score < best - TOLERANCE:
                best = score
                search.best[:] = search.next
        else:
            _undo(search, n_removed, n_back)
        temperature *= cooling
    return best


# The steps of an iteration are compiled into their only caller: calls with so many arrays would take 10 % of the time


@njit(cache=True, inline="always")
def _ruin(search: Search, iteration: int, makespan: float) -> tuple[int, float]:
    """Remove strings of cities around a random city; returns (n_removed, decrease of the total length)."""
    n_agents = search.length.shape[0]
    n_cities = search.tour.shape[0] - n_agents - 1
    max_string = min(MAX_STRING, max(1.0, n_cities / n_agents))
    n_strings = int(_random(search) * (4.0 * MEAN_REMOVED / (1.0 + max_string) - 1.0) + 1.0)
    centre = 1 + int(_random(search) * n_cities)
    if _random(search) < LONGEST_CHANCE:
        for _ in range(2 * n_agents):
            if search.length[search.tour[centre]] >= makespan - TOLERANCE:
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
    """Remove a string of ``agent``'s tour around ``city``, or both ends of a longer string; returns ``n_removed``."""
    depot = search.tour.shape[0] - search.length.shape[0]
    count = search.n_movable[agent]
    n_remove = int(_random(search) * min(float(count), max_string) + 1.0)
    n_leave = 0
    if 1 < n_remove < count and _random(search) < SPLIT_CHANCE:
        n_leave = 1
        while n_remove + n_leave < count and _random(search) < LEAVE_CHANCE:
            n_leave += 1
    span = n_remove + n_leave
    # The string begins up to span - 1 cities before ``city``, as far as the ends of the tour allow
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
            search.length[agent] -= _time(search.pace, search.service, agent, legs - search.leg[following], node)
        node = following
    return n_removed


@njit(cache=True, inline="always")
def _sort(search: Search, n_removed: int) -> None:
    """Choose the order in which cities go back: random, farthest from the depot first, or nearest first (4 : 2 : 1)."""
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
    """Put the removed cities back, each at its cheapest place; returns (n_back, growth of the total length, makespan).

    Stops early once the makespan plus the weighted growth has reached ``limit``, since this sum never falls.
    """
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
    """The cheapest place for ``city``; returns (node before it, growth of the tour)."""
    depot = search.tour.shape[0] - search.length.shape[0]
    cheapest = _cheapest_near(search, city, makespan, balance, int(_random(search) * BLINK))
    home = _distance(search, depot, city)
    for node in range(depot, search.tour.shape[0]):  # never overlooked, so that there is always a place
        cheapest = _cheaper(search, city, node, home, makespan, balance, cheapest)
    _, place, growth = cheapest
    return place, growth


@njit(cache=True, inline="always")
def _cheapest_near(search: Search, city: int, makespan: float, balance: bool, blink: int) -> tuple[float, int, float]:
    """The cheapest place next to a near city, number ``blink`` excepted: (cost, node before, growth of the tour)."""
    cheapest = (inf, search.tour.shape[0] - search.length.shape[0], 0.0)
    for k in range(search.near.shape[1]):
        node = search.near[city, k]
        if search.tour[node] >= 0 and k != blink:
            cheapest = _cheaper(search, city, node, search.near_distance[city, k], makespan, balance, cheapest)
    return cheapest


@njit(cache=True, inline="always")
def _cheaper(
    search: Search,
    city: int,
    node: int,
    to_node: float,
    makespan: float,
    balance: bool,
    cheapest: tuple[float, int, float],
) -> tuple[float, int, float]:
    """The cheapest of ``cheapest`` (cost, node before, growth of the tour) and the places before and after ``node``."""
    least, place, place_growth = cheapest
    agent = search.tour[node]
    length = search.length[agent]
    offset = length if balance else 0.0
    for side in range(2):  # before the node, after it
        end = node if side == 0 else search.next[node]
        # Quick bound: either the leg's other end is at least as far from the city, or the leg has been tried from there
        least_detour = 2.0 * to_node - search.leg[end]
        if _time(search.pace, search.service, agent, least_detour, city) + offset >= least:
            continue
        other = search.previous[node] if side == 0 else end
        detour = to_node + _distance(search, other, city) - search.leg[end]
        growth = _time(search.pace, search.service, agent, detour, city)
        cost = offset + growth
        if not balance and length + growth > makespan:
            cost += (length + growth - makespan) / TOTAL_WEIGHT
        if cost < least:
            least, place, place_growth = cost, search.previous[end], growth
    return least, place, place_growth


@njit(cache=True, inline="always")
def _undo(search: Search, n_removed: int, n_back: int) -> None:
    """Undo an iteration, last change first."""
    for i in range(n_back - 1, -1, -1):
        _unlink(search, search.city_log[1, i])
        search.length[search.tour_log[1, i]] = search.length_log[1, i]
    for i in range(n_removed - 1, -1, -1):
        _link(search, search.city_log[0, i], search.place_log[i])
        search.length[search.tour_log[0, i]] = search.length_log[0, i]


@njit(cache=True, inline="always")
def _link(search: Search, city: int, place: int) -> None:
    """Put ``city`` after the node ``place``; the caller updates the tour's length."""
    following = search.next[place]
    search.next[place], search.previous[city] = city, place
    search.next[city], search.previous[following] = following, city
    search.leg[city] = _distance(search, place, city)
    search.leg[following] = _distance(search, city, following)
    search.tour[city] = search.tour[place]
    search.n_movable[search.tour[place]] += 1


@njit(cache=True, inline="always")
def _unlink(search: Search, city: int) -> None:
    """Take ``city`` off its tour; the caller updates the tour's length."""
    before, following = search.previous[city], search.next[city]
    search.next[before], search.previous[following] = following, before
    search.leg[following] = _distance(search, before, following)
    search.n_movable[search.tour[city]] -= 1
    search.tour[city] = -1


# Numba picks one of the implementations below as it compiles a kernel, and compiles it into its callers. It compares
# signatures, so overloads have no annotations


def _time(pace: np.ndarray | None, service: np.ndarray | None, agent: int, distance: float, node: int) -> float:
    """How long ``agent`` takes for ``distance`` and for its visit to ``node``."""
    return distance if pace is None or service is None else pace[agent] * distance + service[node]


@overload(_time, inline="always")
def _compile_time(pace, service, agent, distance, node):  # type: ignore[no-untyped-def]
    if isinstance(pace, types.NoneType):
        return lambda pace, service, agent, distance, node: distance
    return lambda pace, service, agent, distance, node: pace[agent] * distance + service[node]


def _fastest(pace: np.ndarray | None) -> int:
    """The fastest agent."""
    return 0 if pace is None else int(pace.argmin())


@overload(_fastest, inline="always")
def _compile_fastest(pace):  # type: ignore[no-untyped-def]
    if isinstance(pace, types.NoneType):
        return lambda pace: 0
    return lambda pace: pace.argmin()


@njit(cache=True, inline="always")
def _distance(search: Search, a: int, b: int) -> float:
    dx, dy = search.x[a] - search.x[b], search.y[a] - search.y[b]
    return sqrt(dx * dx + dy * dy)


@njit(cache=True, inline="always")
def _random(search: Search) -> float:
    """A random number, uniform in [0, 1) (xorshift64*)."""
    z = search.random[0]
    z ^= z >> np.uint64(12)
    z ^= z << np.uint64(25)
    z ^= z >> np.uint64(27)
    search.random[0] = z
    return float((z * np.uint64(2685821657736338717)) >> np.uint64(11)) * 2.0**-53
