"""An evolutionary algorithm, after Lupoaie, Chili, Breaban, Raschip 2019 (the paper's row "EA").

V.-I. Lupoaie, I.-A. Chili, M. E. Breaban, M. Raschip, "SOM-Guided Evolutionary Search for Solving MinMax
Multiple-TSP", IEEE CEC 2019, arXiv:1907.11910. Only its abstract and introduction were at hand; neither says how its
evolutionary algorithm is made, and the DAN paper says nothing either. So every choice below is ours:

- *Chromosome*: one string of all cities and m - 1 break points, which say where one tour ends and the next begins; two
  in a row are an idle agent. It is a permutation, so the operators of the TSP serve both halves.
- *Fitness*: the longest tour, plus a little of the mean tour, without which shortening any other tour counts nothing.
- *First population*: random permutations.
- *Parents*: tournaments of two, as many as the population has members.
- *Crossover* (linear order crossover, Falkenauer and Bouffouix 1991), of 3 in 10 children: a slice of the first parent
  stays where it is, the rest follows in the second parent's order.
- *Mutation*, of all children but half of those crossed over: reverse a slice (2-opt; a slice with break points hands
  cities from tour to tour), move 1 to 3 neighbours elsewhere, or swap two, with equal chances. 7 in 10 bring a random
  city next to one of its 10 nearest, the others act at random places.
- *Survivors*: the fittest of parents and children together (so the best is never lost), one of each fitness.

Everything is done for the whole population at once, with NumPy.
"""

from __future__ import annotations

import math
import time

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import lower_bound

POPULATION = 40
MEAN_WEIGHT = 0.1  # of the mean tour in the fitness, where the longest has 1
TOURNAMENT = 2
CROSSOVER = 0.3  # of the children
MUTATION_TOO = 0.5  # of the children of a crossover
NEAR = 0.7  # of the mutations bring a city next to a partner
N_NEAR = 10
LONGEST_MOVE = 3  # cities
SAME = 1e-9  # fitness, but for rounding
CLOSED = 1e-9  # a makespan this near the lower bound is optimal


def solve(instance: Instance, seconds: float, seed: int, generations: int | None = None) -> Tours:
    """Tours of the evolutionary algorithm after ``seconds``, or earlier where they meet the lower bound.

    Args:
        instance: the problem.
        seconds: of wall time.
        seed: of all that is random.
        generations: stop after so many; where ``seconds`` suffice for them, the result depends on the arguments alone.

    Raises:
        ValueError: generations below 0.
    """
    if generations is not None:
        check_count("generations", generations, minimum=0)
    end = time.perf_counter() + seconds
    rng = np.random.default_rng(seed)
    first = np.arange(1, chromosome_length(instance) + 1)
    population = rng.permuted(np.tile(first, (POPULATION, 1)), axis=1)
    return evolve(instance, population, nearest_partners(instance), end, generations, rng)


def evolve(
    instance: Instance,
    population: np.ndarray,
    partners: np.ndarray,
    end: float,
    generations: int | None,
    rng: np.random.Generator,
) -> Tours:
    """The best tours bred from ``population`` until ``end``, or in so many ``generations``.

    Args:
        instance: the problem.
        population: int64 (P, L), chromosomes.
        partners: int64 (n, K), as ``mutate`` takes them.
        end: of ``time.perf_counter``.
        generations: None: no limit.
        rng: for all that is random.
    """
    optimal = lower_bound(instance) + CLOSED
    distance = symbol_distances(instance)
    longest, fitness = evaluate(population, instance.n_nodes, distance)
    size, done, least, best = len(population), 0, math.inf, population[0]
    while True:
        leader = int(np.argmin(longest))
        if longest[leader] < least:  # not always the fittest, so that a later generation may not have it
            least, best = longest[leader], population[leader]
        if least <= optimal or done == generations or time.perf_counter() >= end:
            return decode(best, instance)
        children = breed(population, fitness, partners, rng)
        everyone = np.concatenate([population, children])  # (2 P, L)
        scores = evaluate(children, instance.n_nodes, distance)
        longest, fitness = np.concatenate([longest, scores[0]]), np.concatenate([fitness, scores[1]])
        chosen = survivors(fitness, size)
        population, longest, fitness = everyone[chosen], longest[chosen], fitness[chosen]
        done += 1


# Chromosomes: permutations of 1..L. 1 to n - 1 are the cities, the others the break points between tours.


def chromosome_length(instance: Instance) -> int:
    """L: all cities, and a break point between any two agents; agents beyond the number of cities stay at home."""
    return instance.n_nodes - 2 + min(instance.n_agents, instance.n_nodes - 1)


def encode(tours: Tours, instance: Instance) -> np.ndarray:
    """The chromosome of ``tours``, int64 (L,); idle agents come last."""
    breaks = list(range(instance.n_nodes, chromosome_length(instance) + 1))
    string: list[int] = []
    for cities in (tour[1:-1] for tour in tours):
        if string and cities:
            string.append(breaks.pop())
        string += cities
    return np.array(string + breaks)


def decode(chromosome: np.ndarray, instance: Instance) -> Tours:
    """The tours of a chromosome (L,), one per agent."""
    tours: Tours = [[0]]
    for symbol in chromosome.tolist():
        if symbol < instance.n_nodes:
            tours[-1].append(symbol)
        else:
            tours.append([0])
    return [[*tour, 0] for tour in tours] + [[0, 0] for _ in range(instance.n_agents - len(tours))]


def evaluate(population: np.ndarray, n_nodes: int, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Makespan and fitness of each chromosome, float64 (P,) each; small is fit.

    Args:
        population: int64 (P, L).
        n_nodes: n.
        distance: float64 (L + 1, L + 1) between symbols, where 0 and the break points stand for the depot.
    """
    size, length = population.shape
    path = np.zeros((size, length + 2), dtype=np.int64)  # from the depot to the depot
    path[:, 1:-1] = population
    so_far = distance.take(path[:, :-1] * (length + 1) + path[:, 1:]).cumsum(axis=1)  # (P, L + 1)
    ends = np.nonzero(path[:, 1:-1] >= n_nodes)[1].reshape(size, -1)  # (P, m - 1)
    lengths = np.diff(np.take_along_axis(so_far, ends, axis=1), axis=1, prepend=0.0, append=so_far[:, -1:])  # (P, m)
    longest = lengths.max(axis=1)
    return longest, longest + MEAN_WEIGHT * lengths.mean(axis=1)


def symbol_distances(instance: Instance) -> np.ndarray:
    """What ``evaluate`` takes, float64 (L + 1, L + 1)."""
    place = np.zeros((chromosome_length(instance) + 1, 2)) + instance.nodes[0]
    place[: instance.n_nodes] = instance.nodes
    return np.linalg.norm(place[:, None] - place, axis=-1)


def nearest_partners(instance: Instance) -> np.ndarray:
    """The nearest cities of each node, int64 (n, K); those of the depot are of no use."""
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)
    distance[:, 0] = np.inf
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1)[:, : min(N_NEAR, instance.n_nodes - 2)]


# Operators, on all chromosomes (P, L) at once


def breed(population: np.ndarray, fitness: np.ndarray, partners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """As many children as there are members."""
    size, length = population.shape
    children = population[tournament(fitness, size, rng)]
    mutants = np.ones(size, dtype=bool)
    crossed = np.flatnonzero(rng.random(size) < CROSSOVER)
    if len(crossed):
        others = population[tournament(fitness, len(crossed), rng)]
        cuts = np.sort(rng.integers(length + 1, size=(len(crossed), 2)), axis=1)
        children[crossed] = cross(children[crossed], others, cuts)
        mutants[crossed] = rng.random(len(crossed)) < MUTATION_TOO
    children[mutants] = mutate(children[mutants], partners, rng)
    return children


def tournament(fitness: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Numbers of ``count`` members, each the fittest of TOURNAMENT that were drawn."""
    drawn = rng.integers(len(fitness), size=(count, TOURNAMENT))
    return drawn[np.arange(count), np.argmin(fitness[drawn], axis=1)]


def cross(first: np.ndarray, second: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """Children (P, L) that hold the slice ``cuts`` (P, 2) of ``first`` and the rest in the order of ``second``."""
    place = np.arange(first.shape[1])
    kept = (place >= cuts[:, :1]) & (place < cuts[:, 1:])  # (P, L)
    is_kept = np.zeros((len(first), first.shape[1] + 1), dtype=bool)  # by symbol
    np.put_along_axis(is_kept, first, kept, axis=1)
    children = first.copy()
    children[~kept] = second[~np.take_along_axis(is_kept, second, axis=1)]  # row by row, as many in each
    return children


def mutate(parents: np.ndarray, partners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mutants (P, L) of ``parents`` (P, L).

    Two places are drawn: at random, or a city's and that of one of its ``partners`` (n, K), cities. The slice from one
    up to before the other is reversed, or rotated so that its near end meets the other place, or its ends are swapped.
    """
    size, length = parents.shape
    each, place = np.arange(size), np.arange(length)
    one, other = rng.integers(length, size=(2, size))
    symbol = parents[each, one]
    near = np.flatnonzero((symbol < len(partners)) & (rng.random(size) < NEAR))
    if partners.shape[1]:
        wanted = partners[symbol[near], rng.integers(partners.shape[1], size=len(near))]
        other[near] = np.argmax(parents[near] == wanted[:, None], axis=1)

    after = rng.integers(2, size=size)  # the slice is after the first of the two places, or before the second
    begin, end = np.minimum(one, other) + after, np.maximum(one, other) + after  # the slice; empty where they are one
    moved = rng.integers(1, LONGEST_MOVE + 1, size=size)
    shift = np.where(after, -moved, moved)
    kind = rng.integers(3, size=size)
    begin, end, shift, kind = (a[:, None] for a in (begin, end, shift, kind))
    inside = (place >= begin) & (place < end)
    back = begin + end - 1 - place
    round_ = begin + (place - begin + shift) % np.maximum(end - begin, 1)
    ends = np.where((place == begin) | (place == end - 1), back, place)
    source = np.where(kind == 0, back, np.where(kind == 1, round_, ends))
    return np.take_along_axis(parents, np.where(inside, source, place), axis=1)


def survivors(fitness: np.ndarray, count: int) -> np.ndarray:
    """Numbers of the ``count`` fittest, best first; of those with one fitness the second and later come last."""
    order = np.argsort(fitness, kind="stable")
    first = np.diff(fitness[order], prepend=-np.inf) > SAME
    return np.concatenate([order[first], order[~first]])[:count]
