"""An evolutionary algorithm in the spirit of Lupoaie, Chili, Breaban, Raschip 2019 (the paper's row "EA").

V.-I. Lupoaie, I.-A. Chili, M. E. Breaban, M. Raschip, "SOM-Guided Evolutionary Search for Solving MinMax
Multiple-TSP", IEEE CEC 2019, arXiv:1907.11910. We had access to its abstract and introduction only. Neither describes
the evolutionary algorithm, and the DAN paper does not either, so every choice below is ours:

- *Chromosome*: a permutation of all cities and m - 1 break points. A break point ends one tour and begins the next; two
  in a row are an idle agent. The operators of the TSP apply to cities and break points alike.
- *Fitness*: the longest tour plus a fraction of the mean tour, so that shortening any tour is rewarded.
- *First population*: random permutations.
- *Parents*: winners of tournaments of two, as many as the population has members.
- *Crossover* (linear order crossover, Falkenauer and Bouffouix 1991), for 3 in 10 children: a slice of the first parent
  stays in place, and the rest follows in the second parent's order.
- *Mutation*, for all children except half of those with a crossover: reverse a slice (2-opt; a slice with break points
  moves cities between tours), move 1 to 3 neighbours elsewhere, or swap two, with equal probability. 7 in 10 bring a
  random city next to one of its 10 nearest; the others act at random places.
- *Survivors*: the fittest of parents and children, so that the best is never lost, and one of each fitness.

NumPy applies every step to the whole population at once.
"""

from __future__ import annotations

import math
import time

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import lower_bound

POPULATION = 40
MEAN_WEIGHT = 0.1  # weight of the mean tour in the fitness; that of the longest is 1
TOURNAMENT = 2
CROSSOVER = 0.3  # share of the children with a crossover
MUTATION_TOO = 0.5  # share of these that are also mutated
NEAR = 0.7  # share of the mutations that bring a city next to a partner
N_NEAR = 10
LONGEST_MOVE = 3  # cities
SAME = 1e-9  # difference up to which two fitness values are equal
TOLERANCE = 1e-9  # a makespan within this of the lower bound is optimal


def solve(instance: Instance, seconds: float, seed: int, generations: int | None = None) -> Tours:
    """Tours of the evolutionary algorithm after ``seconds``, or earlier if they reach the lower bound.

    Args:
        instance: the instance.
        seconds: wall time.
        seed: seed of the random generator.
        generations: maximum number of generations; if ``seconds`` suffice for them, the result depends on the arguments
            alone.

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
    """The best tours bred from ``population``.

    Args:
        instance: the instance.
        population: int64 (P, L), chromosomes.
        partners: int64 (n, K), as for ``mutate``.
        end: time at which to stop (``time.perf_counter``).
        generations: maximum number of generations; None for no limit.
        rng: random generator.
    """
    optimal = lower_bound(instance) + TOLERANCE
    distance = symbol_distances(instance)
    longest, fitness = evaluate(population, instance.n_nodes, distance)
    size, done, least, best = len(population), 0, math.inf, population[0]
    while True:
        leader = int(np.argmin(longest))
        if longest[leader] < least:  # it need not be the fittest and may not survive
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
    """L: the number of cities and break points. Agents beyond the number of cities stay at home."""
    return instance.n_nodes - 2 + min(instance.n_agents, instance.n_nodes - 1)


def encode(tours: Tours, instance: Instance) -> np.ndarray:
    """The chromosome of ``tours``, int64 (L,), with idle agents last."""
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
    """Makespan and fitness of each chromosome, float64 (P,) each; smaller is fitter.

    Args:
        population: int64 (P, L).
        n_nodes: number of nodes.
        distance: float64 (L + 1, L + 1), between symbols; 0 and the break points stand for the depot.
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
    """The distances between symbols that ``evaluate`` takes, float64 (L + 1, L + 1)."""
    place = np.zeros((chromosome_length(instance) + 1, 2)) + instance.nodes[0]
    place[: instance.n_nodes] = instance.nodes
    return np.linalg.norm(place[:, None] - place, axis=-1)


def nearest_partners(instance: Instance) -> np.ndarray:
    """The nearest cities of each node, int64 (n, K); those of the depot are not used."""
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)
    distance[:, 0] = np.inf
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1)[:, : min(N_NEAR, instance.n_nodes - 2)]


# Operators, on all chromosomes (P, L) at once


def breed(population: np.ndarray, fitness: np.ndarray, partners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Breed as many children (P, L) as there are members."""
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
    """Indices of ``count`` members, each the fittest of TOURNAMENT random ones."""
    drawn = rng.integers(len(fitness), size=(count, TOURNAMENT))
    return drawn[np.arange(count), np.argmin(fitness[drawn], axis=1)]


def cross(first: np.ndarray, second: np.ndarray, cuts: np.ndarray) -> np.ndarray:
    """Children (P, L) with the slice ``cuts`` (P, 2) of ``first``, and the rest in the order of ``second``."""
    place = np.arange(first.shape[1])
    kept = (place >= cuts[:, :1]) & (place < cuts[:, 1:])  # (P, L)
    is_kept = np.zeros((len(first), first.shape[1] + 1), dtype=bool)  # by symbol
    np.put_along_axis(is_kept, first, kept, axis=1)
    children = first.copy()
    children[~kept] = second[~np.take_along_axis(is_kept, second, axis=1)]  # equally many in each row
    return children


def mutate(parents: np.ndarray, partners: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Mutants (P, L) of ``parents`` (P, L).

    Two places are drawn, either at random or as those of a city and one of its ``partners`` (n, K). The slice between
    them is reversed, or rotated so that its end comes next to the other place, or its two ends are swapped.
    """
    size, length = parents.shape
    each, place = np.arange(size), np.arange(length)
    one, other = rng.integers(length, size=(2, size))
    symbol = parents[each, one]
    near = np.flatnonzero((symbol < len(partners)) & (rng.random(size) < NEAR))
    if partners.shape[1]:
        wanted = partners[symbol[near], rng.integers(partners.shape[1], size=len(near))]
        other[near] = np.argmax(parents[near] == wanted[:, None], axis=1)

    after = rng.integers(2, size=size)  # the slice excludes the first place, or the second
    begin, end = np.minimum(one, other) + after, np.maximum(one, other) + after  # empty if the places are the same
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
    """Indices of the ``count`` fittest, best first; duplicates in fitness come last."""
    order = np.argsort(fitness, kind="stable")
    first = np.diff(fitness[order], prepend=-np.inf) > SAME
    return np.concatenate([order[first], order[~first]])[:count]
