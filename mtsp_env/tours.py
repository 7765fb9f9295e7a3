"""The only judge of tours: lengths, makespan, validity, and a lower bound. A solver's own cost is never trusted."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from mtsp_env.instance import Instance, Tours, check_plain
from mtsp_env.spanning_tree import spanning_tree_length


def path_lengths(nodes: np.ndarray, paths: Sequence[Sequence[int]]) -> np.ndarray:
    """Length of each path, a list of rows of ``nodes`` (n, 2): float64 (len(paths),)."""
    return np.array([np.linalg.norm(np.diff(nodes[list(path)], axis=0), axis=1).sum() for path in paths])


def tour_lengths(instance: Instance, tours: Sequence[Sequence[int]]) -> np.ndarray:
    """Length of each tour, float64 (len(tours),), in units of the unit square.

    Multiply by ``instance.scale`` for the units of the file that the instance was read from.

    Raises:
        ValueError: the instance is not plain.
    """
    check_plain(instance)
    return path_lengths(instance.nodes, tours)


def makespan(instance: Instance, tours: Sequence[Sequence[int]]) -> float:
    """Length of the longest tour, in units of the unit square: the paper's objective (Sec. 3), to be minimised.

    Raises:
        ValueError: the instance is not plain.
    """
    return float(tour_lengths(instance, tours).max(initial=0.0))


def check_tours(instance: Instance, tours: Sequence[Sequence[int]]) -> None:
    """Check that ``tours`` solve ``instance``.

    There must be one tour per agent, each from the depot to the depot, that together visit every city exactly once. A
    tour may pass the depot in the middle, as the environment's depot rule "open" allows; the tour of an agent that
    stays at home is ``[0, 0]``.

    Raises:
        ValueError: the tours do not solve the instance; the message names the tour or the cities.
    """
    if len(tours) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} tours, one per agent, got {len(tours)}")
    paths = [np.asarray(tour) for tour in tours]
    for agent, path in enumerate(paths):
        if path.ndim != 1 or not np.issubdtype(path.dtype, np.integer) or len(path) < 2:
            raise ValueError(f"tour {agent} must be a list of at least 2 node numbers, got {path.tolist()}")
        outside = path[(path < 0) | (path >= instance.n_nodes)]
        if len(outside):
            raise ValueError(f"tour {agent} visits node {outside[0]}, outside 0..{instance.n_nodes - 1}")
        if path[0] != 0 or path[-1] != 0:
            raise ValueError(f"tour {agent} must begin and end at the depot 0, got {path[0]} and {path[-1]}")
    count = np.bincount(np.concatenate(paths).astype(np.int64), minlength=instance.n_nodes)
    missing = np.flatnonzero(count[1:] == 0) + 1
    if len(missing):
        raise ValueError(f"{_cities(missing)} missing from the tours")
    repeated = np.flatnonzero(count[1:] > 1) + 1
    if len(repeated):
        raise ValueError(f"{_cities(repeated)} visited more than once")


def check_prefixes(instance: Instance, prefixes: Sequence[Sequence[int]]) -> Tours:
    """Check the beginnings of tours, one per agent, and return them as lists of ints.

    [0, 3, 5]: the agent has visited city 3 and is at city 5 or on its way there; [0]: it has not left yet; [0, 3, 0]:
    it is home for good. ``rules.tours(..., close=False)`` returns a game's tours in this form.

    Raises:
        ValueError: no tours that solve the instance begin with these prefixes.
    """
    if len(prefixes) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} prefixes, one per agent, got {len(prefixes)}")
    lists = [[_node_number(agent, node) for node in prefix] for agent, prefix in enumerate(prefixes)]
    seen: set[int] = set()
    for agent, prefix in enumerate(lists):
        if not prefix or prefix[0] != 0:
            raise ValueError(f"prefix {agent} must begin at the depot 0, got {prefix}")
        for node in prefix:
            if not 0 <= node < instance.n_nodes:
                raise ValueError(f"prefix {agent} visits node {node}, outside 0..{instance.n_nodes - 1}")
            if node and node in seen:
                raise ValueError(f"city {node} is in the prefixes more than once")
            seen.add(node)
        if 0 in prefix[1:-1]:
            raise ValueError(f"prefix {agent} must not pass the depot in the middle, got {prefix}")
    if len(seen) < instance.n_nodes and all(map(is_closed, lists)):
        raise ValueError(f"all agents are home for good, and {instance.n_nodes - len(seen)} cities are left")
    return lists


def _node_number(agent: int, node: Any) -> int:
    try:
        number = operator.index(node)
    except TypeError:
        number = None
    if number is None or isinstance(node, (bool, np.bool_)):
        raise ValueError(f"prefix {agent} must be a list of node numbers, got {node!r} in it")
    return number


def is_closed(prefix: Sequence[int]) -> bool:
    """Whether an agent whose tour begins with ``prefix`` is home for good."""
    return len(prefix) > 1 and prefix[-1] == 0


def _cities(numbers: np.ndarray) -> str:
    listed = ", ".join(str(number) for number in numbers[:5])
    return f"city {listed}" if len(numbers) == 1 else f"cities {listed}{', ...' if len(numbers) > 5 else ''}"


def farthest_trip(nodes: np.ndarray) -> float:
    """Length of the trip to the city farthest from the depot and back, a lower bound on the makespan. nodes (n, 2)."""
    nodes = np.asarray(nodes, dtype=np.float64)
    return 2.0 * float(np.linalg.norm(nodes - nodes[0], axis=1).max())


def lower_bound(instance: Instance) -> float:
    """A lower bound on the makespan: the larger of ``farthest_trip`` and the minimum spanning tree's length over m.

    The m tours together contain a spanning tree of all nodes, so the longest is at least the tree's length over m. For
    time and memory see ``spanning_tree_length``.

    Raises:
        ValueError: the instance is not plain.
    """
    check_plain(instance)
    return max(farthest_trip(instance.nodes), spanning_tree_length(instance.nodes) / instance.n_agents)
