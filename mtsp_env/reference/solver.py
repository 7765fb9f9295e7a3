"""The reference solver: simulated annealing by ruin and recreate.

This is own code because no library reaches as short a makespan in as little time. Measured on one busy core, on five
uniform instances each of (n, m) = (50, 5), (100, 5) and (200, 10): the makespan of PyVRP 0.14, with a limit on each
tour's length that bisection lowers from the same greedy insertion, was 2 to 12 % longer after 0.1 s, 0.05 to 1.2 %
after 1 s and 0.01 to 0.4 % after 5 s. That of OR-Tools 9.15, guided local search with a cost on the longest tour, was
1 to 11 % longer after 5 s. ``python -m benchmarks libraries`` repeats the comparison.
"""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours, check_arrays, check_plain
from mtsp_env.machine import check_memory, usable_cores
from mtsp_env.reference import sisr
from mtsp_env.reference.search import as_order, as_tours, new_search, place_agents, remaining_order
from mtsp_env.tours import check_prefixes, check_tours, farthest_trip, is_closed, makespan, path_lengths

ITERATIONS_PER_NODE = 500  # if neither seconds nor iterations are given
# First and last temperature. The unit is the makespan times sqrt(m / n), the length of a few average legs.
START_TEMPERATURE, END_TEMPERATURE = 0.1, 0.0025
# A single annealing may settle for a bad division of the cities among the agents, most often if the cities cluster.
# There are four, each twice as long as the one before and from the best tours so far: 0.3 % shorter on average.
ROUNDS = [0, 1 / 15, 3 / 15, 7 / 15, 1]  # their beginnings and ends, as fractions of the whole search
MIN_TURN_SECONDS = 5e-4  # least time between two looks at the clock, so that calls of the kernel cost little
FIRST_GUESS, FIRST_GUESS_PER_AGENT = 1e-5, 3e-8  # seconds of an iteration, until the first ones have been timed
BYTES_PER_NODE, BYTES_PER_AGENT = 2000, 200  # measured: what a search needs at its peak, with its tours as lists
OPTIMALITY_TOLERANCE = 1e-9  # a makespan this close to the lower bound is optimal


def improve(
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    prefixes: Sequence[Sequence[int]] | None = None,
) -> Tours:
    """Near-optimal tours for ``instance``, never worse than the given ``tours``.

    With ``prefixes``, plans the remaining tours of a team that is already under way.

    The search ends after ``seconds`` or ``iterations``, whichever comes first; if neither is given, after 500
    iterations per node. It ends early if the makespan equals the trip to the farthest city and back, which is optimal.

    Args:
        instance: the problem; it must be plain.
        tours: start from these; if None, or if greedy insertion is shorter, start from greedy insertion.
        seconds: limit on the wall time, above 0. Preparation takes O(n log n + n m) time and is never cut short: 0.01 s
            at n = 1000, 0.2 s at n = 20,000. Compiling or loading the kernels, once per process, does not count
            (``compile_kernels``).
        iterations: limit on the iterations, at least 0. One takes 2 to 4 microseconds, longer with hundreds of agents.
            Without ``seconds`` the result depends on the arguments alone.
        seed: a whole number of at least 0.
        prefixes: how each agent's tour begins (``mtsp_env.tours.check_prefixes``). [0, 3, 5]: the agent has visited
            city 3 and is at city 5 or on its way there; [0]: it has not left yet; [0, 3, 0]: it is home for good.
            The objective is still the length of the whole tours.

    Returns:
        One tour per agent, [0, ..., 0]; a copy of ``tours`` if the search has found nothing shorter.

    Raises:
        ValueError: the instance has world fields, the tours do not solve it or do not begin with the prefixes, no tours
            that solve it begin with the prefixes, a number is outside its range, or the search does not fit into the
            memory.
    """
    check_plain(instance)
    if seconds is not None:
        check_seconds("seconds", seconds)
    _check_search(iterations, seed)
    _check_fits(instance.n_nodes, instance.n_agents)
    fixed = None if prefixes is None else check_prefixes(instance, prefixes)
    start = None
    if tours is not None:
        check_tours(instance, tours)
        start = [[int(node) for node in tour] for tour in tours]
        for agent, (tour, prefix) in enumerate(zip(start, fixed or [], strict=False)):
            if tour[: len(prefix)] != prefix or (is_closed(prefix) and tour != prefix):
                raise ValueError(f"tour {agent} must begin with its prefix {prefix}, got {tour}")
    compile_kernels()
    solution = _solve(instance.nodes, instance.n_agents, start, seconds, iterations, seed, prefixes=fixed)
    if start is not None and makespan(instance, start) <= makespan(instance, solution):
        return start
    return solution


def improve_batch(
    nodes: np.ndarray,
    n_agents: int,
    iterations: int | None = None,
    seed: int = 0,
    threads: int | None = None,
    tidy: bool = False,
    prefixes: Sequence[Sequence[Sequence[int]]] | None = None,
) -> list[Tours]:
    """Near-optimal tours for every instance of a batch, several threads at a time.

    Unless ``tidy``, row b is ``improve(Instance(nodes[b], n_agents), iterations=iterations, seed=seed,
    prefixes=prefixes[b])``. It depends neither on the other rows nor on the number of threads.

    Args:
        nodes: (B, n, 2), coordinates in [0, 1]; row 0 of each instance is the depot.
        n_agents: m, at least 1.
        iterations: limit on the iterations of each search, at least 0; by default 500 per node.
        seed: a whole number of at least 0, the same for every row.
        threads: at least 1; by default one for each core that this process may use.
        tidy: minimise the makespan plus 1 % of the total length, and never end early. Tours that do not set the
            makespan then become short as well, which helps if a policy learns from them.
        prefixes: how the tours of each instance begin, see ``improve``.

    Returns:
        The tours of each instance, B lists.

    Raises:
        ValueError: the nodes are not a batch of instances, no tours that solve an instance begin with its prefixes, a
            number is outside its range, or a search does not fit into the memory.
    """
    nodes = np.asarray(nodes, dtype=np.float64)
    if nodes.ndim != 3:
        raise ValueError(f"nodes must have shape (B, n, 2), got {nodes.shape}")
    if len(nodes):
        check_arrays({"nodes": nodes}, n_agents)
    check_count("n_agents", n_agents, minimum=1)
    _check_search(iterations, seed)
    _check_fits(nodes.shape[1], n_agents)
    threads = len(usable_cores()) if threads is None else threads
    check_count("threads", threads, minimum=1)
    fixed: list[Tours | None] = [None] * len(nodes)
    if prefixes is not None:
        if len(prefixes) != len(nodes):
            raise ValueError(f"expected prefixes for {len(nodes)} instances, got {len(prefixes)}")
        fixed = [check_prefixes(Instance(row, n_agents), begun) for row, begun in zip(nodes, prefixes, strict=True)]
    compile_kernels()
    with ThreadPoolExecutor(threads) as pool:
        solve = functools.partial(_solve, n_agents=n_agents, iterations=iterations, seed=seed, tidy=tidy)
        return list(pool.map(lambda row, prefixes: solve(row, prefixes=prefixes), nodes, fixed))


def _check_search(iterations: int | None, seed: int) -> None:
    if iterations is not None:
        check_count("iterations", iterations, minimum=0)
    check_count("seed", seed, minimum=0)


def _check_fits(n_nodes: int, n_agents: int) -> None:
    check_memory("n_nodes", n_nodes, BYTES_PER_NODE)
    check_memory("n_agents", n_agents, BYTES_PER_AGENT)


@functools.cache
def compile_kernels() -> None:
    """Compile every kernel, or load it from disk, unless this process has done so.

    ``improve`` and ``improve_batch`` call this themselves; call it first to keep compilation out of a measured time.
    """
    _solve(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), 1, [[0, 1, 2, 0]], None, 1, 0)


def _solve(
    nodes: np.ndarray,
    n_agents: int,
    tours: Tours | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    tidy: bool = False,
    prefixes: Tours | None = None,
) -> Tours:
    """``improve`` without its checks."""
    started = time.perf_counter()
    bound = farthest_trip(nodes)  # the other part of tours.lower_bound, the spanning tree, is never attained
    if prefixes is None:
        # At most one agent per city is of use
        search = new_search(nodes, min(n_agents, len(nodes) - 1), seed)
        start = None if tours is None else as_order(tours, len(search.best) - 1)
        _optimise(search, 1, start, bound, tidy, seconds, iterations, started)
        return as_tours(sisr.best_order(search), n_agents)

    heads = [prefix[-1] for prefix in prefixes if prefix[-1] != 0]
    unvisited = sorted(set(range(1, len(nodes))).difference(*prefixes))
    if not unvisited:
        return [prefix if is_closed(prefix) else [*prefix, 0] for prefix in prefixes]
    remaining = [0, *heads, *unvisited]  # the nodes of the remaining problem, in which node i is remaining[i]
    search = new_search(nodes[remaining], n_agents, seed)
    place_agents(search, prefixes, path_lengths(nodes, prefixes))
    bound = max(bound, sisr.sum_lengths(search))  # every agent must at least go home from its head
    start = None if tours is None else remaining_order(tours, prefixes, remaining)
    _optimise(search, 1 + len(heads), start, bound, tidy, seconds, iterations, started)
    rest = as_tours(sisr.best_order(search), n_agents)
    return [
        prefix if is_closed(prefix) else [*prefix, *(remaining[node] for node in tour[1 if prefix == [0] else 2 :])]
        for prefix, tour in zip(prefixes, rest, strict=True)
    ]


def _optimise(
    search: sisr.Search,
    first_unvisited: int,
    start: np.ndarray | None,
    bound: float,
    tidy: bool,
    seconds: float | None,
    iterations: int | None,
    started: float,
) -> None:
    """Insert the cities from ``first_unvisited`` on greedily, load the tours ``start`` if they are better, and anneal.

    ``bound`` is a lower bound on the makespan, at which the search ends.
    """
    n = len(search.near)
    home = np.hypot(search.x[:n] - search.x[0], search.y[:n] - search.y[0])
    sisr.insert_greedily(search, first_unvisited + np.argsort(-home[first_unvisited:], kind="stable"))
    greedy = best = sisr.sum_lengths(search)
    if start is not None:
        inserted = sisr.best_order(search)
        sisr.load_tours(search, start)
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
    _anneal(search, best, target, weight, unit, seconds, iterations, started)


def _anneal(
    search: sisr.Search,
    best: float,
    target: float,
    weight: float,
    unit: float,
    seconds: float | None,
    iterations: int | None,
    started: float,
) -> None:
    """Anneal in rounds until ``seconds`` after ``started``, or for ``iterations``.

    Temperatures are in units of ``unit``, a length; ``best``, ``target`` and ``weight`` are those of ``sisr.anneal``.
    """
    if iterations == 0:
        return
    seconds = math.inf if seconds is None else seconds
    limit = 2**62 if iterations is None else iterations
    turn_seconds = max(seconds / 100, MIN_TURN_SECONDS)  # a kernel does not see the clock, so it is called in turns
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
                START_TEMPERATURE * (END_TEMPERATURE / START_TEMPERATURE) ** ((p - begin) / (end - begin))
                for p in (turn_begin, turn_end)
            )
            best = sisr.anneal(search, turn, hot * unit, cold * unit, best, target, weight)
            before, now = now, time.perf_counter()
            per_iteration = max((now - before) / turn, 1e-7)  # a coarse clock may not have moved
            done += turn
