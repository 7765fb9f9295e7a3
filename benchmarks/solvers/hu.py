"""Hu, Yao & Lee 2020: a network allocates the cities to the agents, then OR-Tools solves the tour of each.

The network is ``benchmarks/policies/hu.py``, which says how it was built and trained. There are weights for teams of 5
and of 10 agents. The tours come from path-cheapest-arc and OR-Tools' default local search, until no move helps.
"""

from __future__ import annotations

import re
import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.solvers import WEIGHTS, NoTours, Unavailable
from benchmarks.solvers.ortools import UNIT, Problem
from dan_policy.registry import load
from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, Tours
from mtsp_env.tours import makespan

NETWORK = "benchmarks.policies.hu:HuAllocator"


def solve(instance: Instance, seconds: float, seed: int, samples: int | None = None) -> Tours:
    """Tours of the likeliest allocation, or the best of it and of allocations that are drawn, within ``seconds``.

    Args:
        instance: the problem.
        seconds: limit on the time.
        seed: seed of the random allocations.
        samples: number of allocations, the likeliest one included; None: that one alone.

    Raises:
        NoTours: not even the tours of the likeliest allocation were done in time.
        Unavailable: no weights for this number of agents, or no package ortools.
        ValueError: ``samples`` is below 1.
    """
    end = time.perf_counter() + seconds
    check_count("samples", 1 if samples is None else samples, minimum=1)
    distance = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=-1)  # (n, n)
    solved: dict[tuple[int, ...], list[int]] = {}  # the tour of each set of cities: likely sets are drawn often
    best = None
    for owner in allocations(instance, seed, samples or 1):
        tours = []
        for agent in range(instance.n_agents):
            cities = tuple((1 + np.flatnonzero(owner == agent)).tolist())
            if cities not in solved:
                left = end - time.perf_counter()
                if left <= 0 and best is not None:
                    return best
                solved[cities] = shortest_tour(distance, cities, left)
            tours.append(solved[cities])
        if best is None or makespan(instance, tours) < makespan(instance, best):
            best = tours
    return best


def allocations(instance: Instance, seed: int, count: int) -> np.ndarray:
    """The agent of each city but the depot, (count, n - 1) int64: the likeliest allocation, then drawn ones."""
    nodes = torch.tensor(instance.nodes, dtype=torch.float32)
    with torch.no_grad():
        scores = _network(WEIGHTS, instance.n_agents).allocate(nodes)[:, 1:]  # (m, n - 1)
    generator = torch.Generator().manual_seed(seed)
    drawn: list[Tensor] = [scores.argmax(0)]
    if count > 1:
        probabilities = scores.softmax(0).T  # (n - 1, m)
        drawn += torch.multinomial(probabilities, count - 1, replacement=True, generator=generator).T
    return torch.stack(drawn).numpy()


def shortest_tour(distance: np.ndarray, cities: tuple[int, ...], seconds: float) -> list[int]:
    """OR-Tools' tour of an agent that visits ``cities``.

    Args:
        distance: (n, n) in lengths of the unit square.
        cities: their numbers.
        seconds: limit on the time.

    Raises:
        NoTours: no tour was found in time.
        Unavailable: the package ortools is missing.
    """
    nodes = np.array([0, *cities])
    if len(nodes) <= 3:
        return [*nodes.tolist(), 0]  # there is no other
    if seconds <= 0:
        raise NoTours("the time was over before every agent had a tour")
    try:
        part = np.rint(distance[np.ix_(nodes, nodes)] * UNIT).astype(np.int64)
        problem = Problem(part, 1, len(part) * int(part.max()), "GREEDY_DESCENT")
    except ImportError as error:
        raise Unavailable(f"package ortools is missing ({error})") from error
    assignment = problem.search(time.perf_counter() + seconds)
    if assignment is None:
        raise NoTours(f"no tour of {len(cities)} cities was found within {seconds:g} s")
    return nodes[problem.tours(assignment)[0]].tolist()


@lru_cache(maxsize=4)
def _network(folder: Path, n_agents: int) -> nn.Module:
    """The allocation network for this number of agents."""
    file = folder / f"hu-{n_agents}.safetensors"
    if not file.exists():
        names = (re.fullmatch(r"hu-(\d+)", path.stem) for path in folder.glob("hu-*.safetensors"))
        known = sorted(int(name[1]) for name in names if name)
        raise Unavailable(f"no weights for {n_agents} agents; there are some for {known}")
    return load(file, network=NETWORK)
