"""The arrays of a search: made from an instance, tours and prefixes, and turned back into tours.

``solver`` calls these functions, and ``annealing`` the compiled kernels in ``sisr``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from mtsp_env.instance import Tours
from mtsp_env.reference import sisr

TREE_FROM = 300  # nodes from which a k-d tree finds the nearest cities sooner than trying all pairs


def new_search(
    nodes: np.ndarray,
    n_agents: int,
    seed: int,
    speeds: np.ndarray | None = None,
    service: np.ndarray | None = None,
) -> sisr.Search:
    """A search over ``nodes`` (n, 2) with empty tours, with the ``speeds`` (m,) and ``service`` (n,) of a world."""
    n, size = len(nodes), len(nodes) + n_agents
    xy = np.concatenate([nodes, np.repeat(nodes[:1], n_agents, axis=0)])  # (N, 2)
    x, y = np.ascontiguousarray(xy[:, 0]), np.ascontiguousarray(xy[:, 1])
    near, near_distance = nearest_cities(x[:n], y[:n], min(sisr.N_NEAR, n - 2))
    pace = None if speeds is None and service is None else np.ones(n_agents) if speeds is None else 1.0 / speeds
    visits = None if pace is None else np.zeros(size)
    if visits is not None and service is not None:
        visits[:n] = service
    itself = np.arange(size, dtype=np.int32)  # an empty tour: the depot before and after itself
    return sisr.Search(
        x=x,
        y=y,
        near=near,
        near_distance=near_distance,
        previous=itself,
        next=itself.copy(),
        leg=np.zeros(size),
        tour=np.maximum(itself - n, -1),
        length=np.zeros(n_agents),
        n_movable=np.zeros(n_agents, np.int32),
        head=np.zeros(n_agents, np.int32),
        driven=np.zeros(n_agents),
        ruined=np.zeros(n_agents, np.int64),
        best=itself.copy(),
        random=np.array([_spread(seed)], np.uint64),
        city_log=np.zeros((2, n), np.int32),
        place_log=np.zeros(n, np.int32),
        tour_log=np.zeros((2, n), np.int32),
        length_log=np.zeros((2, n)),
        key=np.zeros(n),
        pace=pace,
        service=visits,
    )


def nearest_cities(x: np.ndarray, y: np.ndarray, n_near: int) -> tuple[np.ndarray, np.ndarray]:
    """``near`` and ``near_distance`` of a search for nodes with the coordinates ``x`` and ``y`` (n,)."""
    n = len(x)
    if n < TREE_FROM:
        return sisr.nearest_cities(x, y, n_near)
    cities = np.stack([x[1:], y[1:]], axis=1)
    distance, number = KDTree(cities).query(cities, k=n_near + 1)  # (n - 1, n_near + 1) each
    itself = number == np.arange(n - 1)[:, None]
    dropped = np.where(itself.any(axis=1), itself.argmax(axis=1), n_near)  # not listed if many cities coincide with it
    kept = np.arange(n_near + 1) != dropped[:, None]
    near, near_distance = np.zeros((n, n_near), np.int64), np.zeros((n, n_near))
    near[1:] = number[kept].reshape(n - 1, n_near) + 1
    near_distance[1:] = distance[kept].reshape(n - 1, n_near)
    return near, near_distance


def place_agents(search: sisr.Search, heads: Sequence[int | None], driven: np.ndarray) -> None:
    """Put each agent at its head (0: the depot; None: it gets no cities), its own time there being ``driven`` (m,).

    Nodes 1, 2, ... of ``search`` must be the heads that are cities, in the agents' order.
    """
    depot, number, order = len(search.near), 1, []
    for agent, head in enumerate(heads):
        if head is None:
            search.head[agent] = depot + agent
        elif head != 0:
            search.head[agent] = number
            order.append(number)
            number += 1
        order.append(0)
    search.driven[:] = driven
    sisr.load_tours(search, np.array(order, dtype=np.int64))


def remaining_order(heads: Sequence[int | None], routes: Sequence[Sequence[int]], remaining: list[int]) -> np.ndarray:
    """Heads and the ``routes`` after them in the form of ``sisr.load_tours``, int64.

    Node i of the search is node ``remaining[i]`` of the heads and routes.
    """
    number = {node: i for i, node in enumerate(remaining)}
    rests = [[head or 0, *route] for head, route in zip(heads, routes, strict=True)]
    return np.array([i for rest in rests for i in [*(number[node] for node in rest if node != 0), 0]], dtype=np.int64)


def _spread(seed: int) -> int:
    """A seed spread over 64 bits, so that neighbouring seeds differ in many of them (splitmix64); never 0."""
    z = (seed + 0x9E3779B97F4A7C15) % 2**64
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 % 2**64
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % 2**64
    return (z ^ (z >> 31)) | 1


def as_order(tours: Tours, size: int) -> np.ndarray:
    """``tours`` in the form of ``sisr.load_tours``, int64 (size,), with idle agents last.

    Visits to the depot in the middle of a tour are left out: they only make it longer.
    """
    cities = [[node for node in tour if node != 0] for tour in tours]
    order = [node for tour in cities if tour for node in [*tour, 0]]
    return np.array(order + [0] * (size - len(order)), dtype=np.int64)


def as_tours(order: np.ndarray, n_agents: int) -> Tours:
    """Tours from the result of ``sisr.best_order``; agents beyond those of the search stay at home."""
    tours: Tours = [[0]]
    for node in order.tolist():
        tours[-1].append(node)
        if node == 0:
            tours.append([0])
    return tours[:-1] + [[0, 0] for _ in range(n_agents - len(tours) + 1)]
