"""The only judge of tours and of logs: lengths, makespan, validity, and a lower bound.

A solver's own cost is never trusted.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from mtsp_env.instance import Instance, Tours, check_plannable
from mtsp_env.spanning_tree import spanning_tree_length

TOLERANCE = 1e-6  # of the times in a log


class Leg(NamedTuple):
    """One leg of an agent, in units of time on the clock."""

    node: int  # to which it sets off
    departed: float
    arrived: float  # inf: it broke down on the way
    ready: float  # when the visit ends; it decides again at the next tick


Log = list[list[Leg]]
"""The legs of each agent, in order. Staying at the depot is no leg."""


def path_lengths(nodes: np.ndarray, paths: Sequence[Sequence[int]]) -> np.ndarray:
    """Length of each path, a list of rows of ``nodes`` (n, 2): float64 (len(paths),)."""
    return np.array([np.linalg.norm(np.diff(nodes[list(path)], axis=0), axis=1).sum() for path in paths])


def tour_lengths(instance: Instance, tours: Sequence[Sequence[int]]) -> np.ndarray:
    """Length of each tour, float64 (len(tours),), in units of the unit square.

    Multiply by ``instance.scale`` for the units of the file that the instance was read from.
    """
    return path_lengths(instance.nodes, tours)


def tour_times(instance: Instance, tours: Sequence[Sequence[int]]) -> np.ndarray:
    """How long each tour takes, one tour per agent, visits included: float64 (m,). If plain, the same as its length.

    Raises:
        ValueError: a world with ``appears`` or ``breaks``, whose makespan also depends on when agents depart.
    """
    if instance.world == ():
        return path_lengths(instance.nodes, tours)
    if instance.waiting_counts:
        raise ValueError(f"tours alone have no makespan in a world with {list(instance.world)}: use check_log")
    times = np.zeros(len(tours))
    for agent, tour in enumerate(tours):
        legs = [(a, b) for a, b in pairwise(tour) if a != 0 or b != 0]  # staying at the depot is no leg
        times[agent] = sum(sum(leg_times(instance, agent, k, *leg)) for k, leg in enumerate(legs))
    return times


def leg_times(instance: Instance, agent: int, k: int, start: int, end: int) -> tuple[float, float]:
    """How long the ``k``-th leg of an agent takes, and the visit after it."""
    time = math.dist(instance.nodes[start], instance.nodes[end])
    if instance.speeds is not None:
        time /= instance.speeds[agent]
    if instance.traffic is not None:
        time *= instance.traffic[agent, k % instance.traffic.shape[1]]
    return float(time), 0.0 if instance.service is None else float(instance.service[end])


def makespan(instance: Instance, tours: Sequence[Sequence[int]]) -> float:
    """Time of the longest tour, the paper's objective (Sec. 3), to be minimised; if plain, its length.

    Raises:
        ValueError: a world with ``appears`` or ``breaks``: use ``check_log``.
    """
    return float(tour_times(instance, tours).max(initial=0.0))


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


def longest_trip(instance: Instance) -> float:
    """A lower bound on the makespan: the fastest agent goes to one city, visits it and comes home."""
    if not instance.world:
        return farthest_trip(instance.nodes)
    fastest = 1.0 if instance.speeds is None else float(instance.speeds.max())
    visits = 0.0 if instance.service is None else instance.service
    return float((2.0 * np.linalg.norm(instance.nodes - instance.nodes[0], axis=1) / fastest + visits).max())


def lower_bound(instance: Instance) -> float:
    """A lower bound on the makespan: the larger of ``longest_trip`` and what all tours need together, shared evenly.

    The tours together contain a spanning tree of all nodes, and all visits: without world fields, the longest of the m
    tours is at least the tree's length over m. For time and memory see ``spanning_tree_length``.

    Raises:
        ValueError: the instance has other world fields than ``speeds`` and ``service``.
    """
    check_plannable(instance.world)
    length, speed = spanning_tree_length(instance.nodes), float(instance.n_agents)  # of the whole team
    if instance.speeds is not None:
        speed = float(instance.speeds.sum())
    if instance.service is not None:  # an agent that visits cannot drive: time s costs at least s times the least speed
        length += float(instance.service.sum()) * (1.0 if instance.speeds is None else float(instance.speeds.min()))
    return max(longest_trip(instance), length / speed)


# Logs


def check_log(instance: Instance, log: Sequence[Sequence[Sequence]], speed: float | None = None) -> float:
    """Check that a log solves ``instance``, and return its makespan.

    Each agent's legs are (node, departed, arrived, ready), as in ``Leg``: it takes as long as the world says, departs
    when it is ready, or later if it is at the depot, for cities that have appeared, before it breaks down itself, and
    comes home in the end. Every city is reached exactly once.

    Args:
        instance: plain or with any world.
        log: one list of legs per agent, as ``env.unwrapped.log`` of a finished game.
        speed: distance per tick of the game, to check that agents decide at the very next tick. None: a tick is at
            most as long as the shortest time between two departures of the log, and agents may be late by as much.

    Raises:
        ValueError: the log does not solve the instance; the message names the agent and the leg.
    """
    if len(log) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} lists of legs, one per agent, got {len(log)}")
    legs = [[_as_leg(instance, agent, entry) for entry in entries] for agent, entries in enumerate(log)]
    tick = _longest_tick(legs) if speed is None else speed
    own_times = [_check_legs(instance, agent, own, tick, speed is not None) for agent, own in enumerate(legs)]
    _check_visits(instance, legs)
    return max(own_times)


def _as_leg(instance: Instance, agent: int, entry: Sequence) -> Leg:
    try:
        node, *times = entry
        leg = Leg(int(node), *map(float, times))
    except (TypeError, ValueError) as error:
        raise ValueError(f"agent {agent}: a leg must be (node, departed, arrived, ready), got {entry!r}") from error
    if leg.node != node or not 0 <= leg.node < instance.n_nodes:
        raise ValueError(f"agent {agent} sets off for node {node!r}, outside 0..{instance.n_nodes - 1}")
    return leg


def _longest_tick(legs: Log) -> float:
    """No tick is longer than this, because all departures are at whole numbers of ticks."""
    departures = np.unique([0.0, *(leg.departed for own in legs for leg in own)])
    gaps = np.diff(departures)
    return float(gaps[gaps > TOLERANCE].min(initial=math.inf))


def _check_legs(instance: Instance, agent: int, legs: Sequence[Leg], tick: float, exact: bool) -> float:
    """Check the legs of one agent; returns its own time at the end.

    Own time is continuous: a leg adds what it takes, not what the clock rounds it up to. If waiting counts, an agent
    that leaves the depot for a city has the clock's time.
    """
    breaks = math.inf if instance.breaks is None else float(instance.breaks[agent])
    stops = max(_round_up(breaks, tick), tick) if exact else breaks + tick  # it arrives by then, or not at all
    here, ready, own_time = 0, 0.0, 0.0
    for k, leg in enumerate(legs):
        where = f"agent {agent}, leg {k} to node {leg.node}:"
        _check_departure(leg, here, ready, tick, exact, where)
        if leg.departed >= breaks - TOLERANCE:
            raise ValueError(f"{where} it departs at {leg.departed:g}, but broke down at {breaks:g}")
        if instance.appears is not None and leg.departed < instance.appears[leg.node] - TOLERANCE:
            raise ValueError(
                f"{where} it departs at {leg.departed:g}, but the city appears at {instance.appears[leg.node]:g}"
            )
        travel, visit = leg_times(instance, agent, k, here, leg.node)
        arrives = leg.departed + travel
        if leg.arrived == math.inf and k == len(legs) - 1 and arrives > breaks - TOLERANCE:
            return breaks
        if leg.node == 0:
            arrives = min(arrives, breaks)  # a return leg counts up to the breakdown
        elif (_round_up(arrives, tick) if exact else arrives) > stops + TOLERANCE:
            raise ValueError(f"{where} it arrives at {arrives:g}, but broke down at {breaks:g}")
        for name, said, right in (("arrives", leg.arrived, arrives), ("is ready", leg.ready, arrives + visit)):
            if not abs(said - right) <= TOLERANCE:
                raise ValueError(f"{where} it {name} at {right:g}, got {said:g}")
        if here == 0 and leg.node != 0 and instance.waiting_counts:
            own_time = leg.departed
        own_time += travel + visit
        here, ready = leg.node, max(leg.ready, leg.departed + tick if exact else 0.0)
    if here == 0:
        return min(own_time, breaks)
    if stops > (_round_up(ready, tick) if exact else ready + 2 * tick) + TOLERANCE:
        raise ValueError(f"agent {agent} does not come home from node {here}")
    return breaks


def _round_up(time: float, tick: float) -> float:
    """The first tick at or after ``time``, as a time."""
    return time if math.isinf(time) else math.ceil(time / tick - 1e-9) * tick  # as the rules round


def _check_departure(leg: Leg, here: int, ready: float, tick: float, exact: bool, where: str) -> None:
    """It departs at the first tick at which it is ready, or later from the depot."""
    if here == leg.node == 0:
        raise ValueError(f"{where} staying at the depot is no leg")
    soonest = _round_up(ready, tick) if exact else ready
    latest = math.inf if here == 0 else soonest if exact else ready + tick
    if not soonest - TOLERANCE <= leg.departed <= latest + TOLERANCE:
        when = f"at {soonest:g}" if latest == soonest else f"between {soonest:g} and {latest:g}"
        raise ValueError(f"{where} it departs {when}, got {leg.departed:g}")
    if exact and abs(leg.departed - round(leg.departed / tick) * tick) > TOLERANCE * tick:
        raise ValueError(f"{where} it departs at a whole number of ticks of {tick:g}, got {leg.departed:g}")


def _check_visits(instance: Instance, legs: Log) -> None:
    """Every city is reached once, and before that only by agents that broke down on the way."""
    attempts: list[list[tuple[float, int, Leg]]] = [[] for _ in range(instance.n_nodes)]
    for agent, own in enumerate(legs):
        for leg in own:
            attempts[leg.node].append((leg.departed, agent, leg))
    missing = np.array([city for city, tries in enumerate(attempts) if city and _never_reached(tries)], dtype=int)
    if len(missing):
        raise ValueError(f"{_cities(missing)} missing from the log")
    for city, tries in enumerate(attempts[1:], start=1):
        for (_, agent, leg), (departed, other, _) in pairwise(sorted(tries)):
            if leg.arrived != math.inf or instance.breaks is None or instance.breaks[agent] > departed + TOLERANCE:
                raise ValueError(f"agent {other} sets off for city {city} at {departed:g}, which agent {agent} visits")


def _never_reached(tries: Sequence[tuple[float, int, Leg]]) -> bool:
    return all(leg.arrived == math.inf for _, _, leg in tries)
