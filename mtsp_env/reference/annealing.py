"""The search itself: greedy insertion, and simulated annealing in rounds until the time or the iterations are over."""

from __future__ import annotations

import itertools
import math
import time

import numpy as np

from mtsp_env.reference import sisr

ITERATIONS_PER_NODE = 500  # if neither seconds nor iterations are given
# First and last temperature. The unit is the makespan times sqrt(m / n), the length of a few average legs.
START_TEMPERATURE, END_TEMPERATURE = 0.1, 0.0025
# A single annealing may settle for a bad division of the cities among the agents, most often if the cities cluster.
# There are four, each twice as long as the one before and from the best tours so far: 0.3 % shorter on average.
ROUNDS = [0, 1 / 15, 3 / 15, 7 / 15, 1]  # their beginnings and ends, as fractions of the whole search
MIN_TURN_SECONDS = 5e-4  # least time between two looks at the clock, so that calls of the kernel cost little
FIRST_GUESS, FIRST_GUESS_PER_AGENT = 1e-5, 3e-8  # seconds of an iteration, until the first ones have been timed
OPTIMALITY_TOLERANCE = 1e-9  # a makespan this close to the lower bound is optimal


def optimise(
    search: sisr.Search,
    first_unvisited: int,
    start: np.ndarray | None,
    bound: float,
    tidy: bool,
    seconds: float | None,
    iterations: int | None,
    started: float,
    temperature: float = START_TEMPERATURE,
) -> None:
    """Insert the cities from ``first_unvisited`` on greedily, load the tours ``start`` if they are better, and anneal.

    Cities that are missing in ``start`` are inserted greedily there. ``bound`` is a lower bound on the makespan, at
    which the search ends. The search begins at ``temperature``: the lower, the more of the first tours it keeps.
    """
    n = len(search.near)
    home = np.hypot(search.x[:n] - search.x[0], search.y[:n] - search.y[0])
    farthest_first = first_unvisited + np.argsort(-home[first_unvisited:], kind="stable")
    sisr.insert_greedily(search, farthest_first)
    greedy = best = sisr.sum_lengths(search)
    if start is not None:
        inserted = sisr.best_order(search)
        missing = farthest_first[~np.isin(farthest_first, start)]
        search.tour[missing] = -1
        sisr.load_tours(search, start)
        best = sisr.sum_lengths(search)
        if len(missing):
            sisr.insert_greedily(search, missing)
            best = sisr.sum_lengths(search)
        if best >= greedy:
            sisr.load_tours(search, inserted)
            best = sisr.sum_lengths(search)

    unit, weight, target = greedy * math.sqrt(len(search.length) / n), 0.0, bound + OPTIMALITY_TOLERANCE
    if tidy:
        weight, target = sisr.TOTAL_WEIGHT, -math.inf
        best += weight * float(search.length.sum())
    if seconds is None and iterations is None:
        iterations = ITERATIONS_PER_NODE * n
    _anneal(search, best, target, weight, unit, seconds, iterations, started, temperature)


def _anneal(
    search: sisr.Search,
    best: float,
    target: float,
    weight: float,
    unit: float,
    seconds: float | None,
    iterations: int | None,
    started: float,
    temperature: float,
) -> None:
    """Anneal in rounds until ``seconds`` after ``started``, or for ``iterations``.

    ``temperature`` is the first one, in units of ``unit``, a length; ``best``, ``target`` and ``weight`` are those of
    ``sisr.anneal``.
    """
    if iterations == 0:
        return
    seconds = math.inf if seconds is None else seconds
    limit = 2**62 if iterations is None else iterations
    turn_seconds = max(seconds / 100, MIN_TURN_SECONDS)  # a kernel does not see the clock, so it is called in turns
    last = min(temperature, END_TEMPERATURE)
    per_iteration, done, now = FIRST_GUESS + FIRST_GUESS_PER_AGENT * len(search.length), 0, time.perf_counter()

    def progress(now: float, done: int) -> float:  # the fraction of the search that is over
        return max((now - started) / seconds, done / limit)

    for begin, end in itertools.pairwise(ROUNDS):
        sisr.load_tours(search, sisr.best_order(search))
        while best > target and (turn_begin := progress(now, done)) < end:
            turn = min(turn_seconds, started + end * seconds - now) / per_iteration
            turn = int(max(min(turn, math.ceil(end * limit) - done), 1))
            turn_end = min(progress(now + turn * per_iteration, done + turn), end)
            hot, cold = (
                temperature * (last / temperature) ** ((p - begin) / (end - begin)) for p in (turn_begin, turn_end)
            )
            best = sisr.anneal(search, turn, hot * unit, cold * unit, best, target, weight)
            before, now = now, time.perf_counter()
            per_iteration = max((now - before) / turn, 1e-7)  # a coarse clock may not have moved
            done += turn
