"""The reference solver: simulated annealing by ruin and recreate.

This is own code because no library reaches as short a makespan in as little time. Measured on one busy core, on five
uniform instances each of (n, m) = (50, 5), (100, 5) and (200, 10): the makespan of PyVRP 0.14, with a limit on each
tour's length that bisection lowers from the same greedy insertion, was 2 to 12 % longer after 0.1 s, 0.05 to 1.2 %
after 1 s and 0.01 to 0.4 % after 5 s. That of OR-Tools 9.15, guided local search with a cost on the longest tour, was
1 to 11 % longer after 5 s. ``python -m benchmarks libraries`` repeats the comparison.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours, check_arrays, check_plannable
from mtsp_env.machine import check_memory, usable_cores
from mtsp_env.reference import sisr
from mtsp_env.reference.annealing import START_TEMPERATURE, optimise
from mtsp_env.reference.search import as_order, as_tours, new_search, place_agents, remaining_order
from mtsp_env.tours import check_prefixes, check_tours, is_closed, longest_trip, makespan, tour_times

BYTES_PER_NODE, BYTES_PER_AGENT = 2000, 200  # measured: what a search needs at its peak, with its tours as lists


def improve(
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    prefixes: Sequence[Sequence[int]] | None = None,
    stopped: Collection[int] = (),
) -> Tours:
    """Near-optimal tours for ``instance``, never worse than the given ``tours``.

    Agents may differ in speed, and visits may take time. With ``prefixes``, plans the remaining tours of a team that is
    already under way. In worlds that change (``appears``, ``breaks``, ``traffic``) no tours can be planned in advance:
    there, ``mtsp_env.replan.Replanner`` plans again whenever something happens.

    The search ends after ``seconds`` or ``iterations``, whichever comes first; if neither is given, after 500
    iterations per node. It ends early if the makespan equals the trip to the farthest city and back, which is optimal.

    Args:
        instance: the problem; its only world fields may be ``speeds`` and ``service``.
        tours: start from these; if None, or if greedy insertion is shorter, start from greedy insertion.
        seconds: limit on the wall time, above 0. Preparation takes O(n log n + n m) time and is never cut short: 0.01 s
            at n = 1000, 0.2 s at n = 20,000. Compiling or loading the kernels, once per process, does not count
            (``compile_kernels``).
        iterations: limit on the iterations, at least 0. One takes 2 to 4 microseconds, longer with hundreds of agents.
            Without ``seconds`` the result depends on the arguments alone.
        seed: a whole number of at least 0.
        prefixes: how each agent's tour begins (``mtsp_env.tours.check_prefixes``). [0, 3, 5]: the agent has visited
            city 3 and is at city 5 or on its way there; [0]: it has not left yet; [0, 3, 0]: it is home for good.
            The objective is still the time of the whole tours.
        stopped: agents that go no further, such as broken ones. Their tours are their prefixes, and others visit the
            remaining cities.

    Returns:
        One tour per agent, [0, ..., 0]; a copy of ``tours`` if the search has found nothing shorter.

    Raises:
        ValueError: the instance has other world fields, the tours do not solve it or do not begin with the prefixes, no
            tours that solve it begin with the prefixes, a number is outside its range, or the search does not fit into
            the memory.
    """
    check_plannable(instance.world)
    if seconds is not None:
        check_seconds("seconds", seconds)
    _check_search(iterations, seed)
    _check_fits(instance.n_nodes, instance.n_agents)
    fixed = None if prefixes is None else check_prefixes(instance, prefixes)
    if stopped:
        fixed = _check_stopped(instance, fixed, stopped)
    start = None
    if tours is not None:
        check_tours(instance, [[*tour, 0] if agent in stopped else tour for agent, tour in enumerate(tours)])
        start = [[int(node) for node in tour] for tour in tours]
        for agent, (tour, prefix) in enumerate(zip(start, fixed or [], strict=False)):
            final = is_closed(prefix) or agent in stopped
            if tour[: len(prefix)] != prefix or (final and tour != prefix):
                raise ValueError(f"tour {agent} must {'be' if final else 'begin with'} its prefix {prefix}, got {tour}")
    compile_kernels(worlds=instance.world != ())
    solution = _solve(instance, start, seconds, iterations, seed, prefixes=fixed, stopped=stopped)
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
    instances = [Instance(row, n_agents) for row in nodes]
    fixed: list[Tours | None] = [None] * len(nodes)
    if prefixes is not None:
        if len(prefixes) != len(nodes):
            raise ValueError(f"expected prefixes for {len(nodes)} instances, got {len(prefixes)}")
        fixed = [check_prefixes(instance, begun) for instance, begun in zip(instances, prefixes, strict=True)]
    compile_kernels()
    with ThreadPoolExecutor(threads) as pool:
        solve = functools.partial(_solve, iterations=iterations, seed=seed, tidy=tidy)
        return list(pool.map(lambda instance, prefixes: solve(instance, prefixes=prefixes), instances, fixed))


def plan_rest(
    instance: Instance,
    heads: Sequence[int | None],
    driven: np.ndarray,
    cities: Sequence[int],
    routes: Sequence[Sequence[int]] | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
) -> Tours:
    """The rest of each agent's tour if agents are on their way and only some of the cities are left to visit.

    Minimises the makespan plus 1 % of the total time, so that all tours are short, and never ends early. World fields
    other than ``speeds`` and ``service`` are ignored.

    Args:
        instance: where the nodes are, and what the agents and visits are like.
        heads: the node from which each agent goes on, 0 for the depot; None: it gets no cities. No city twice.
        driven: (m,) own time at which each agent can leave its head.
        cities: the cities to visit, without the heads.
        routes: start from these, the cities after each head in order, if greedy insertion is not shorter. Cities that
            are missing are inserted.
        seconds, iterations, seed: as for ``improve``.

    Returns:
        The cities of each agent after its head, in order; the way home is implied.

    Raises:
        ValueError: every head is None while cities are left.
    """
    if all(head is None for head in heads) and len(cities):
        raise ValueError(f"{len(cities)} cities are left, and every agent has stopped")
    compile_kernels(worlds=instance.speeds is not None or instance.service is not None)
    return _plan_rest(
        instance, heads, driven, cities, routes, 0.0, True, seconds, iterations, seed, time.perf_counter()
    )


def _check_stopped(instance: Instance, prefixes: Tours | None, stopped: Collection[int]) -> Tours:
    """The prefixes, by default of agents that have not left; ValueError unless the other agents can visit the rest."""
    for agent in stopped:
        check_count("an agent in stopped", agent, minimum=0)
        if agent >= instance.n_agents:
            raise ValueError(f"stopped must name agents in 0..{instance.n_agents - 1}, got {agent}")
    prefixes = [[0] for _ in range(instance.n_agents)] if prefixes is None else prefixes
    left = instance.n_nodes - len({0}.union(*prefixes))
    if left and all(agent in stopped or is_closed(prefix) for agent, prefix in enumerate(prefixes)):
        raise ValueError(f"all agents are stopped or home for good, and {left} cities are left")
    return prefixes


def _check_search(iterations: int | None, seed: int) -> None:
    if iterations is not None:
        check_count("iterations", iterations, minimum=0)
    check_count("seed", seed, minimum=0)


def _check_fits(n_nodes: int, n_agents: int) -> None:
    check_memory("n_nodes", n_nodes, BYTES_PER_NODE)
    check_memory("n_agents", n_agents, BYTES_PER_AGENT)


@functools.cache
def compile_kernels(worlds: bool = False) -> None:
    """Compile every kernel, for plain problems or for ``worlds``, or load it from disk, once per process.

    ``improve`` and ``improve_batch`` call this themselves; call it first to keep compilation out of a measured time.
    """
    corner = Instance(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), 1, service=np.zeros(3) if worlds else None)
    _solve(corner, [[0, 1, 2, 0]], None, 1, 0)


def _solve(
    instance: Instance,
    tours: Tours | None = None,
    seconds: float | None = None,
    iterations: int | None = None,
    seed: int = 0,
    tidy: bool = False,
    prefixes: Tours | None = None,
    stopped: Collection[int] = (),
    temperature: float = START_TEMPERATURE,
    enough: float = 0.0,
) -> Tours:
    """``improve`` without its checks, from the first ``temperature`` on, until the makespan is at most ``enough``."""
    started = time.perf_counter()
    n, m = instance.n_nodes, instance.n_agents
    # The other part of tours.lower_bound, the spanning tree, is never attained
    bound = max(longest_trip(instance), enough)
    if prefixes is None and instance.speeds is None:
        # At most one agent per city is of use
        search = new_search(instance.nodes, min(m, n - 1), seed, service=instance.service)
        start = None if tours is None else as_order(tours, len(search.best) - 1)
        optimise(search, 1, start, bound, tidy, seconds, iterations, started, temperature)
        return as_tours(sisr.best_order(search), m)

    prefixes = [[0] for _ in range(m)] if prefixes is None else prefixes
    final = [is_closed(prefix) or agent in stopped for agent, prefix in enumerate(prefixes)]
    heads = [None if final[agent] else prefix[-1] for agent, prefix in enumerate(prefixes)]
    unvisited = sorted(set(range(1, n)).difference(*prefixes))
    routes = None
    if tours is not None:
        routes = [tour[len(prefix) :] for tour, prefix in zip(tours, prefixes, strict=True)]
    driven = tour_times(instance, prefixes)
    bound = enough if stopped else bound  # a stopped agent does not drive home from the farthest city
    limits = (bound, tidy, seconds, iterations, seed, started, temperature)
    rest = _plan_rest(instance, heads, driven, unvisited, routes, *limits)
    return [
        prefix if final[agent] else [*prefix, *route, 0]
        for agent, (prefix, route) in enumerate(zip(prefixes, rest, strict=True))
    ]


def _plan_rest(
    instance: Instance,
    heads: Sequence[int | None],
    driven: np.ndarray,
    cities: Sequence[int],
    routes: Sequence[Sequence[int]] | None,
    bound: float,
    tidy: bool,
    seconds: float | None,
    iterations: int | None,
    seed: int,
    started: float,
    temperature: float = START_TEMPERATURE,
) -> Tours:
    """``plan_rest``, with a lower ``bound`` on the makespan, at which the search ends unless ``tidy``."""
    if not cities:
        return [[] for _ in heads]
    at_cities = [head for head in heads if head]
    remaining = [0, *at_cities, *cities]  # the nodes of the remaining problem, in which node i is remaining[i]
    service = None if instance.service is None else instance.service[remaining]
    search = new_search(instance.nodes[remaining], len(heads), seed, instance.speeds, service)
    place_agents(search, heads, driven)
    bound = max(bound, sisr.sum_lengths(search))  # every agent must at least go home from its head
    start = None if routes is None else remaining_order(heads, routes, remaining)
    optimise(search, 1 + len(at_cities), start, bound, tidy, seconds, iterations, started, temperature)
    rest = as_tours(sisr.best_order(search), len(heads))
    return [[remaining[node] for node in tour[2 if head else 1 : -1]] for head, tour in zip(heads, rest, strict=True)]
