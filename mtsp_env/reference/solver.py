"""The reference solver: simulated annealing by ruin and recreate.

Kept because no library does as well by the makespan. On five uniform instances each of n, m = 50, 5; 100, 5; 200, 10
and one busy core, PyVRP 0.14, whose limit on each tour a bisection brings down from the same greedy insertion, was
2 to 12 % longer after 0.1 s, 0.05 to 1.2 % after 1 s, and almost level, 0.01 to 0.4 %, after 5 s; OR-Tools 9.15, guided
local search with a cost on the longest tour, was 1 to 11 % longer after 5 s (``python -m benchmarks.libraries``).
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
from mtsp_env.instance import Instance, Tours, check_arrays
from mtsp_env.machine import usable_cores
from mtsp_env.reference import sisr
from mtsp_env.reference.search import as_order, as_tours, new_search, rest_as_order, set_off
from mtsp_env.tours import check_prefixes, check_tours, farthest_trip, is_closed, makespan, path_lengths

ITERATIONS_PER_NODE = 500  # where neither seconds nor iterations are given
HOT, COLD = 0.1, 0.0025  # first and last temperature, in units of makespan * sqrt(m / n), a few mean legs
# Annealing once may settle for a bad division of the cities among the agents, above all where cities cluster. So it is
# done four times, each time twice as long as before, from the best tours so far (0.3 % better on average).
ROUNDS = [0, 1 / 15, 3 / 15, 7 / 15, 1]  # where they begin and end, as fractions of the whole
TURN_SECONDS = 5e-4  # at least, between looks at the clock, so that the calls cost little
CLOSED = 1e-9  # a makespan this near the lower bound is optimal


def improve(
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    prefixes: Sequence[Sequence[int]] | None = None,
) -> Tours:
    """Near-optimal tours for ``instance``, never worse than the given ``tours``.

    With ``prefixes`` the agents are under way, and the rest of their tours is planned: for who has to replan a team.

    The search takes ``seconds`` or ``iterations``, whichever is over first (neither: 500 iterations for each node), and
    ends early where the makespan is the farthest out-and-back trip, which none can beat.

    Args:
        instance: the problem.
        tours: where to start; where they are worse than greedy insertion, or None, it starts from that.
        seconds: of wall time, above 0. Preparation is O(n^2), and is not cut short: 0.01 s at n = 1000.
            Compiling or loading the kernels, once per process, does not count (``compile_kernels``).
        iterations: at least 0; 2 to 4 microseconds each, longer with hundreds of agents. Without ``seconds`` the result
            depends on nothing but the arguments.
        seed: a whole number of at least 0.
        prefixes: how each agent's tour begins (``mtsp_env.tours.check_prefixes``): [0, 3, 5] went to city 3 and is at
            or on the way to city 5, [0] has not left yet, [0, 3, 0] is home for good. The cost stays the length of the
            whole tours.

    Returns:
        One tour per agent, [0, ..., 0]; ``tours`` themselves, copied, where nothing better was found.

    Raises:
        ValueError: tours that do not solve the instance or do not begin with the prefixes, prefixes that no tours begin
            with, or a number outside its range.
    """
    if seconds is not None:
        check_seconds("seconds", seconds)
    _check_search(iterations, seed)
    begun = None if prefixes is None else check_prefixes(instance, prefixes)
    given = None
    if tours is not None:
        check_tours(instance, tours)
        given = [[int(node) for node in tour] for tour in tours]
        for agent, (tour, prefix) in enumerate(zip(given, begun or [], strict=False)):
            if tour[: len(prefix)] != prefix or (is_closed(prefix) and tour != prefix):
                raise ValueError(f"tour {agent} must begin with its prefix {prefix}, got {tour}")
    compile_kernels()
    solution = _solve(instance.nodes, instance.n_agents, given, seconds, iterations, seed, prefixes=begun)
    if given is not None and makespan(instance, given) <= makespan(instance, solution):
        return given
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
    """Near-optimal tours for each row of ``nodes`` (B, n, 2), the rows spread over ``threads``.

    Row b is ``improve(Instance(nodes[b], n_agents), iterations=iterations, seed=seed, prefixes=prefixes[b])``, whatever
    the other rows and the number of threads (None: one for each core that this process may use). ``tidy`` also keeps
    the tours short that do not set the makespan, for which a search otherwise does no more than it must: the makespan
    plus 1 % of the total length counts, and no search ends early. Tours to learn from should be tidy.

    Raises:
        ValueError: nodes that are not B instances, prefixes that no tours begin with, or a number outside its range.
    """
    nodes = np.asarray(nodes, dtype=np.float64)
    if nodes.ndim != 3:
        raise ValueError(f"nodes must have shape (B, n, 2), got {nodes.shape}")
    if len(nodes):
        check_arrays({"nodes": nodes}, n_agents)
    check_count("n_agents", n_agents, minimum=1)
    _check_search(iterations, seed)
    threads = len(usable_cores()) if threads is None else threads
    check_count("threads", threads, minimum=1)
    begun: list[Tours | None] = [None] * len(nodes)
    if prefixes is not None:
        if len(prefixes) != len(nodes):
            raise ValueError(f"expected prefixes for {len(nodes)} instances, got {len(prefixes)}")
        begun = [check_prefixes(Instance(row, n_agents), its) for row, its in zip(nodes, prefixes, strict=True)]
    compile_kernels()
    with ThreadPoolExecutor(threads) as pool:
        solve = functools.partial(_solve, n_agents=n_agents, iterations=iterations, seed=seed, tidy=tidy)
        return list(pool.map(lambda row, prefixes: solve(row, prefixes=prefixes), nodes, begun))


def _check_search(iterations: int | None, seed: int) -> None:
    if iterations is not None:
        check_count("iterations", iterations, minimum=0)
    check_count("seed", seed, minimum=0)


@functools.cache
def compile_kernels() -> None:
    """Have every kernel compiled, or loaded from disk, once per process: for who wants to have it done before a clock
    runs. Both functions above do it where it is needed."""
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
    enough = farthest_trip(nodes)  # lower_bound's other part, the spanning tree, is never attained
    if prefixes is None:
        # More agents than cities are of no use
        search = new_search(nodes, min(n_agents, len(nodes) - 1), seed)
        start = None if tours is None else as_order(tours, len(search.best) - 1)
        _optimise(search, 1, start, enough, tidy, seconds, iterations, started)
        return as_tours(sisr.best_order(search), n_agents)

    heads = [prefix[-1] for prefix in prefixes if prefix[-1] != 0]
    free = sorted(set(range(1, len(nodes))).difference(*prefixes))
    if not free:
        return [prefix if is_closed(prefix) else [*prefix, 0] for prefix in prefixes]
    kept = [0, *heads, *free]  # what is left of the instance; its nodes are numbered anew
    search = new_search(nodes[kept], n_agents, seed)
    set_off(search, prefixes, path_lengths(nodes, prefixes))
    enough = max(enough, sisr.sum_lengths(search))  # of everybody going home at once
    start = None if tours is None else rest_as_order(tours, prefixes, kept)
    _optimise(search, 1 + len(heads), start, enough, tidy, seconds, iterations, started)
    rest = as_tours(sisr.best_order(search), n_agents)
    return [
        prefix if is_closed(prefix) else [*prefix, *(kept[node] for node in tour[1 if prefix == [0] else 2 :])]
        for prefix, tour in zip(prefixes, rest, strict=True)
    ]


def _optimise(
    search: sisr.Search,
    first_free: int,
    start: np.ndarray | None,
    enough: float,
    tidy: bool,
    seconds: float | None,
    iterations: int | None,
    started: float,
) -> None:
    """Put the cities from ``first_free`` on onto the tours, or start from better ones (``start``), and improve them."""
    n = len(search.near)
    home = np.hypot(search.x[:n] - search.x[0], search.y[:n] - search.y[0])
    sisr.insert_greedily(search, first_free + np.argsort(-home[first_free:], kind="stable"))
    greedy = best = sisr.sum_lengths(search)
    if start is not None:
        inserted = sisr.best_order(search)
        sisr.load_tours(search, start)
        best = sisr.sum_lengths(search)
        if best >= greedy:
            sisr.load_tours(search, inserted)
            best = sisr.sum_lengths(search)

    unit, weight, enough = greedy * math.sqrt(len(search.length) / n), 0.0, enough + CLOSED
    if tidy:
        weight, enough = sisr.TOTAL_WEIGHT, -math.inf
        best += weight * float(search.length.sum())
    if seconds is None and iterations is None:
        iterations = ITERATIONS_PER_NODE * n
    _anneal(search, best, enough, weight, unit, seconds, iterations, started)


def _anneal(
    search: sisr.Search,
    best: float,
    enough: float,
    weight: float,
    unit: float,
    seconds: float | None,
    iterations: int | None,
    started: float,
) -> None:
    """Anneal between HOT and COLD ``unit``s of length until ``seconds`` after ``started``, or for ``iterations``.

    ``best``, ``enough`` and ``weight`` are those of ``sisr.anneal``.
    """
    if iterations == 0:
        return
    seconds = math.inf if seconds is None else seconds
    limit = 2**62 if iterations is None else iterations
    turn_seconds = max(seconds / 100, TURN_SECONDS)  # a kernel does not see the clock, so it is called in turns
    per_iteration, done, now = 1e-5, 0, time.perf_counter()

    def progress(now: float, done: int) -> float:
        return max((now - started) / seconds, done / limit)

    for begin, end in itertools.pairwise(ROUNDS):
        sisr.load_tours(search, sisr.best_order(search))
        while best > enough and (over := progress(now, done)) < end:
            turn = min(turn_seconds, started + end * seconds - now) / per_iteration
            turn = int(max(min(turn, math.ceil(end * limit) - done), 1))
            then = min(progress(now + turn * per_iteration, done + turn), end)
            hot, cold = (HOT * (COLD / HOT) ** ((p - begin) / (end - begin)) for p in (over, then))
            best = sisr.anneal(search, turn, hot * unit, cold * unit, best, enough, weight)
            before, now = now, time.perf_counter()
            per_iteration = max((now - before) / turn, 1e-7)  # a coarse clock may not have moved
            done += turn
