"""Self-organising maps, alone and as the start of the evolutionary algorithm, after Lupoaie et al. 2019.

The article (reference in ``ea.py``) starts an evolutionary algorithm and an ant colony from self-organising maps. We
had access to its abstract and introduction only. The maps here follow S. Somhom, A. Modares, T. Enkawa,
"Competition-based neural network for the multiple travelling salesmen problem with minmax objective", Computers &
Operations Research 26 (1999); how they start the evolution is our choice:

- Each agent has a closed ring of neurons, 2.5 for each city of a fair share. The first neuron of a ring stays at the
  depot. The rings begin as small circles through the depot, in evenly spread directions.
- In an epoch every city is presented once, in random order. The neuron with the smallest distance * (length of its ring
  / mean length of the rings) wins, so that long rings win less often; in one epoch a neuron wins at most one city. The
  winner and its neighbours on the ring, d neurons away, move towards the city by 0.6 exp(-(d / width)^2) of the
  distance. The width shrinks geometrically from a fifth of the ring to 0.3 neurons in 100 epochs, or in fewer if time
  is short.
- A ring's tour is the order of the neurons that won in the last epoch. No local search follows.
- Alone (``guided=False``): maps are trained one after the other until time is up, and the best tours count. The DAN
  paper's row "SOM" is probably of this kind: its time does not grow with the number of agents, unlike that of its row
  "EA", and at n = 50 its tours are worse than those of "EA", which an evolution started from maps would improve on.
- Guided (``guided=True``, the article's subject): the evolutionary algorithm of ``ea.py``. Its first population are the
  tours of maps trained for up to 0.3 of the time, and mutants of them if they are too few. (Mutations that bring a city
  next to its neighbour on a map, instead of one of its nearest cities, did not help.)
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Iterator

import numpy as np
from numba import njit

from benchmarks.solvers import ea
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import lower_bound, makespan

NEURONS = 2.5  # per city of an agent's fair share
RADIUS = 0.1  # of the initial rings, relative to the farthest city's distance from the depot
EPOCHS = 100
WIDE, NARROW = 0.2, 0.3  # initial width, relative to the ring; final width, in neurons
RATE = 0.6  # share of the distance to the city by which the winner moves
REACH = 3.0  # in widths; neurons farther from the winner do not move
MAP_SHARE = 0.3  # share of the time for maps, if guided


def solve(
    instance: Instance,
    seconds: float,
    seed: int,
    guided: bool = True,
    maps: int | None = None,
    generations: int | None = None,
) -> Tours:
    """Tours after ``seconds``, or earlier if they reach the lower bound.

    Args:
        instance: the instance.
        seconds: wall time. One map is always trained for at least two epochs; the compilation of its kernel is not
            counted.
        seed: seed of the random generator.
        guided: start the evolutionary algorithm from the maps; otherwise there are only maps.
        maps: maximum number of maps; by default the size of the population if guided, else no limit.
        generations: maximum number of generations. If ``seconds`` suffice for them and for the maps, the result depends
            on the arguments alone.

    Raises:
        ValueError: maps below 1, or generations below 0.
    """
    if maps is not None:
        check_count("maps", maps, minimum=1)
    if generations is not None:
        check_count("generations", generations, minimum=0)
    _compile()
    started, rng = time.perf_counter(), np.random.default_rng(seed)
    if not guided:
        return min(train_maps(instance, started + seconds, maps, rng), key=lambda tours: makespan(instance, tours))

    tours = list(train_maps(instance, started + MAP_SHARE * seconds, min(maps or math.inf, ea.POPULATION), rng))
    chromosomes = np.array([ea.encode(one, instance) for one in tours])
    partners = ea.nearest_partners(instance)
    population = np.resize(chromosomes, (ea.POPULATION, chromosomes.shape[1]))  # repeated
    population[len(tours) :] = ea.mutate(population[len(tours) :], partners, rng)
    return ea.evolve(instance, population, partners, started + seconds, generations, rng)


def train_maps(instance: Instance, end: float, count: float | None, rng: np.random.Generator) -> Iterator[Tours]:
    """Yield the tours of at least one and at most ``count`` maps, trained until ``end`` (``time.perf_counter``).

    If time is short, the first map has fewer epochs, and a later one is abandoned. It stops at the lower bound.
    """
    optimal = lower_bound(instance) + ea.TOLERANCE
    for number in itertools.count():
        if number == count or (number and time.perf_counter() >= end):
            return
        tours = train(instance, end, hurry=number == 0, rng=rng)
        if tours is None:
            return
        yield tours
        if makespan(instance, tours) <= optimal:
            return


def train(instance: Instance, end: float, hurry: bool, rng: np.random.Generator) -> Tours | None:
    """The tours of one map. If time is short, it has fewer epochs with ``hurry``, and without it there are none."""
    nodes, n_cities = instance.nodes, instance.n_nodes - 1
    rings = first_rings(nodes, min(instance.n_agents, n_cities), rng)  # (m, k, 2)
    lengths = np.ones(len(rings))
    winner = np.zeros(len(nodes), dtype=np.int64)
    wide = max(WIDE * rings.shape[1], NARROW)
    started, progress = time.perf_counter(), 0.0
    for epoch in range(1, EPOCHS + 1):
        show(nodes, 1 + rng.permutation(n_cities), rings, lengths, winner, wide * (NARROW / wide) ** progress)
        if progress == 1.0:
            break
        progress, now = epoch / (EPOCHS - 1), time.perf_counter()
        if now >= end and not hurry:
            return None
        if hurry:
            progress = max(progress, min((now - started) / max(end - started, 1e-9), 1.0))

    tours: Tours = [[0] for _ in range(instance.n_agents)]
    for city in 1 + np.argsort(winner[1:]):
        tours[winner[city] // rings.shape[1]].append(int(city))
    return [[*tour, 0] for tour in tours]


def first_rings(nodes: np.ndarray, n_agents: int, rng: np.random.Generator) -> np.ndarray:
    """Small circles through the depot, float64 (m, k, 2); their first neurons are at the depot."""
    size = 1 + math.ceil(NEURONS * (len(nodes) - 1) / n_agents)  # k
    radius = RADIUS * np.linalg.norm(nodes - nodes[0], axis=1).max()
    outwards = 2 * np.pi * (rng.random() + np.arange(n_agents) / n_agents)[:, None]  # (m, 1)
    angle = outwards + np.pi + 2 * np.pi * np.arange(size) / size  # (m, k)
    unit = np.stack([np.cos(outwards) + np.cos(angle), np.sin(outwards) + np.sin(angle)], axis=-1)
    return nodes[0] + radius * unit


@njit(cache=True)
def show(
    nodes: np.ndarray, order: np.ndarray, rings: np.ndarray, lengths: np.ndarray, winner: np.ndarray, width: float
) -> None:
    """Run one epoch: present the cities in ``order``, move ``rings`` and record the winners.

    Args:
        nodes: float64 (n, 2).
        order: int64 (n - 1,), the cities in random order.
        rings: float64 (m, k, 2), changed in place. The first neuron of each neither moves nor wins.
        lengths: float64 (m,), lengths of the rings, changed in place.
        winner: int64 (n,), changed in place: each city's ring * k + neuron.
        width: width of the neighbourhood, in neurons.
    """
    n_rings, size = rings.shape[:2]
    reach = min(int(REACH * width), (size - 1) // 2)
    taken = np.zeros((n_rings, size), dtype=np.bool_)
    for city in order:
        x, y = nodes[city]
        mean = lengths.mean()
        best, ring, neuron = np.inf, -1, -1
        for r in range(n_rings):
            handicap = (lengths[r] / mean) ** 2 if mean > 0.0 else 1.0
            for k in range(1, size):
                if not taken[r, k]:
                    score = ((rings[r, k, 0] - x) ** 2 + (rings[r, k, 1] - y) ** 2) * handicap
                    if score < best:
                        best, ring, neuron = score, r, k
        taken[ring, neuron] = True
        winner[city] = ring * size + neuron
        for away in range(-reach, reach + 1):
            k = (neuron + away) % size
            if k > 0:
                step = RATE * math.exp(-((away / width) ** 2))
                rings[ring, k, 0] += step * (x - rings[ring, k, 0])
                rings[ring, k, 1] += step * (y - rings[ring, k, 1])
        lengths[ring] = 0.0
        for k in range(size):  # the neuron before the first is the last
            lengths[ring] += math.hypot(
                rings[ring, k, 0] - rings[ring, k - 1, 0], rings[ring, k, 1] - rings[ring, k - 1, 1]
            )


@functools.cache
def _compile() -> None:
    """Compile the kernel, or load it from disk, before the clock starts."""
    train(Instance([[0.0, 0.0], [1.0, 0.0]], 1), math.inf, False, np.random.default_rng(0))
