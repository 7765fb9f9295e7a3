"""Plans in a canonical form: of all equivalent plans, the one that a network can learn."""

from __future__ import annotations

import numpy as np

from mtsp_env.instance import Tours
from mtsp_env.tours import is_closed


def canonical(nodes: np.ndarray, tours: Tours, prefixes: Tours | None = None) -> Tours:
    """The same tours, in the one order and direction that a network can learn.

    Agents are alike and tours have no direction, so that any solution is one of m! 2^m equivalent ones, and a network
    that is shown them at random learns their average. Here tours run counter-clockwise, and agents take them in the
    order of the angle at which their centroids are seen from the depot. No agent stays at home (depot rule "final"): an
    idle agent takes over a city, which makes no tour longer. All this applies to agents that are still at the depot;
    agents that have left it continue as planned.

    Args:
        nodes: (n, 2) coordinates.
        tours: tours of m < n agents.
        prefixes: what each agent has already driven; None: nothing.
    """
    prefixes = [[0]] * len(tours) if prefixes is None else prefixes
    rests = [[node for node in tour[len(prefix) :] if node != 0] for tour, prefix in zip(tours, prefixes, strict=True)]
    waiting = [agent for agent, prefix in enumerate(prefixes) if len(prefix) == 1]
    for agent in waiting:
        spare = [len(rest) - (other in waiting) for other, rest in enumerate(rests)]
        if not rests[agent] and max(spare) > 0:
            rests[agent].append(rests[np.argmax(spare)].pop())

    for agent, rest in zip(waiting, in_order(nodes, [rests[agent] for agent in waiting]), strict=True):
        rests[agent] = rest
    return [prefix if is_closed(prefix) else [*prefix, *rest, 0] for prefix, rest in zip(prefixes, rests, strict=True)]


def in_order(nodes: np.ndarray, rests: Tours) -> Tours:
    """Tours of alike agents that are at the depot, counter-clockwise and in the order of their angles.

    Args:
        nodes: (n, 2) coordinates.
        rests: the cities of each tour, in order.
    """

    def angle(rest: list[int]) -> float:
        east, north = nodes[rest].mean(0) - nodes[0] if rest else (-1.0, 0.0)  # empty tours come last
        return float(np.arctan2(north, east))

    return sorted((counter_clockwise(nodes, rest) for rest in rests), key=angle)


def counter_clockwise(nodes: np.ndarray, rest: list[int]) -> list[int]:
    """The cities of a closed tour in the order in which it runs counter-clockwise."""
    x, y = (nodes[rest] - nodes[0]).T  # the depot is the origin and adds nothing
    twice_the_area = float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum())  # the shoelace formula
    return rest if twice_the_area >= 0 else rest[::-1]
