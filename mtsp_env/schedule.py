"""When every agent is where: the legs of a team's tours with their times, and the state of affairs at one moment.

Animations and the HTML view are made from these. Time is measured in units of distance at speed 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from mtsp_env.instance import Instance
from mtsp_env.tours import TOLERANCE, Leg, Log, leg_times

BARELY = 1 - 1e-9  # the largest share of the way after which an agent has not arrived


@dataclass(frozen=True)
class Moment:
    """Where a team is at one time.

    Attributes:
        paths: one array (k, 2) per agent, the points of the way that it has driven so far; the last is its position.
        lengths: (m,) how far each agent has driven, in units of the unit square.
        owner: (n,) the agent that has reached each node; -1: none.
        waits: (m,) bool, the agents that stand at the depot and will set off later.
    """

    paths: list[np.ndarray]
    lengths: np.ndarray
    owner: np.ndarray
    waits: np.ndarray


class Drive(NamedTuple):
    """The part of a leg that an agent drives before it arrives or breaks down."""

    node: int  # to which it sets off
    departed: float
    until: float  # when it arrives or breaks down; inf: never, it does not move
    share: float  # of the way that it has driven by then; 1: it arrives


def make_log(
    instance: Instance,
    tours: Sequence[Sequence[int]] | None = None,
    log: Sequence[Sequence[Sequence[float]]] | None = None,
) -> Log:
    """The checked ``log``, or that of ``tours``, whose agents all set off at time 0 and never wait.

    Args:
        instance: the problem; with ``tours``, without ``appears`` and ``breaks``, because such events decide when its
            tours are driven.
        tours: one per agent, from the depot; a tour that does not end there is driven as far as it goes.
        log: one list of (node, departed, arrived, ready) per agent. An arrival at infinity is a leg that the agent
            never ends.

    Raises:
        ValueError: not exactly one of ``tours`` and ``log``, or one that does not fit the instance.
    """
    if (tours is None) == (log is None):
        raise ValueError("expected either tours or a log")
    if tours is not None:
        check_paths(instance, tours)
        if instance.waiting_counts:
            raise ValueError(f"the instance has the fields {list(instance.world)}; pass the log of a game, not tours")
        return [_follow(instance, agent, tour) for agent, tour in enumerate(tours)]
    assert log is not None
    if len(log) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} lists of legs, one per agent, got {len(log)}")
    return [_check_legs(instance, agent, legs) for agent, legs in enumerate(log)]


def check_paths(instance: Instance, tours: Sequence[Sequence[int]]) -> None:
    """Raise ValueError unless there is one path per agent, from the depot over nodes that exist."""
    if len(tours) != instance.n_agents:
        raise ValueError(f"expected {instance.n_agents} tours, one per agent, got {len(tours)}")
    for agent, tour in enumerate(tours):
        if len(tour) == 0 or tour[0] != 0:
            raise ValueError(f"tour {agent} must begin at the depot 0, got {list(tour)[:5]}")
        outside = [node for node in tour if not 0 <= node < instance.n_nodes]
        if outside:
            raise ValueError(f"tour {agent} visits node {outside[0]}, outside 0..{instance.n_nodes - 1}")


def _follow(instance: Instance, agent: int, tour: Sequence[int]) -> list[Leg]:
    legs: list[Leg] = []
    ready = 0.0
    for here, node in pairwise(tour):
        if here == node == 0:  # staying at the depot is no leg
            continue
        travel, visit = leg_times(instance, agent, len(legs), int(here), int(node))
        legs.append(Leg(int(node), ready, ready + travel, ready + travel + visit))
        ready = legs[-1].ready
    return legs


def _check_legs(instance: Instance, agent: int, legs: Sequence[Sequence[float]]) -> list[Leg]:
    checked: list[Leg] = []
    ready = 0.0
    for number, values in enumerate(legs):
        where = f"leg {number} of agent {agent}"
        if len(values) != 4:
            raise ValueError(f"{where} must be (node, departed, arrived, ready), got {tuple(values)}")
        leg = Leg(int(values[0]), *map(float, values[1:]))
        if leg.node != values[0] or not 0 <= leg.node < instance.n_nodes:
            raise ValueError(f"{where} goes to node {values[0]}, outside 0..{instance.n_nodes - 1}")
        if not (math.isfinite(leg.departed) and ready - 1e-6 <= leg.departed <= leg.arrived <= leg.ready):
            raise ValueError(
                f"{where} must depart at {ready:g} or later, then arrive, then be ready, got {tuple(leg[1:])}"
            )
        checked.append(leg)
        ready = leg.ready
    return checked


def end_time(log: Log) -> float:
    """The time at which the last leg that ends at all has ended; 0 without legs."""
    return max((leg.arrived for legs in log for leg in legs if math.isfinite(leg.arrived)), default=0.0)


def drives(instance: Instance, agent: int, legs: Sequence[Leg]) -> list[Drive]:
    """How far one agent gets on each of its legs of a checked log."""
    breaks = math.inf if instance.breaks is None else float(instance.breaks[agent])
    parts, here = [], 0
    for k, leg in enumerate(legs):
        until, share = leg.arrived, 1.0
        # Of legs that a breakdown cuts off, those for a city arrive at infinity, those for the depot at the breakdown.
        if until >= breaks and (leg.node == 0 or math.isinf(until)):
            travel, until = leg_times(instance, agent, k, here, leg.node)[0], breaks
            if math.isinf(leg.arrived) or leg.departed + travel > breaks + TOLERANCE:
                driven = max(breaks - leg.departed, 0.0)
                share = min(driven / travel, BARELY) if travel > 0.0 and math.isfinite(breaks) else 0.0
        parts.append(Drive(leg.node, leg.departed, until, share))
        here = leg.node
    return parts


def moment(instance: Instance, log: Log, time: float) -> Moment:
    """Where the team of a log is at ``time``, at least 0. On its way, an agent moves at an even speed."""
    nodes = instance.nodes
    owner = np.full(len(nodes), -1)
    paths, waits = [], np.zeros(len(log), bool)
    for agent, legs in enumerate(log):
        points, here = [nodes[0]], 0
        for node, departed, until, share in drives(instance, agent, legs):
            if departed > time:
                waits[agent] = here == 0
                break
            if until <= time and share == 1.0:
                points.append(nodes[node])
                owner[node], here = agent, node
                continue
            if until > time:
                share *= (time - departed) / (until - departed)  # 0 if it never arrives
            points.append(points[-1] + share * (nodes[node] - points[-1]))
            here = -1  # on the way
        paths.append(np.array(points))
    lengths = np.array([np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in paths])
    return Moment(paths, lengths, owner, waits)
