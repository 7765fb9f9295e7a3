"""Teams under way, and the best completions of their tours, by trying all of them."""

import itertools
import math
from collections.abc import Collection

from hypothesis import strategies as st

from mtsp_env import Instance, makespan
from mtsp_env.instance import Tours
from mtsp_env.tours import is_closed

points = st.tuples(*[st.integers(0, 3).map(lambda k: k / 3) | st.floats(0, 1)] * 2)  # many coincide


@st.composite
def teams_under_way(draw: st.DrawFn, max_nodes: int = 12) -> tuple[Instance, Tours, Tours]:
    """An instance, prefixes of its tours, some of them closed, and tours that begin with them."""
    instance = Instance(draw(st.lists(points, min_size=2, max_size=max_nodes)), draw(st.integers(1, 5)))
    tours: Tours = [[0] for _ in range(instance.n_agents)]
    for city in draw(st.permutations(range(1, instance.n_nodes))):
        tours[draw(st.integers(0, instance.n_agents - 1))].append(city)
    prefixes = [tour[: draw(st.integers(1, len(tour)))] for tour in tours]
    tours = [[*tour, 0] for tour in tours]
    for agent, tour in enumerate(tours):
        if tour == [*prefixes[agent], 0] and draw(st.booleans()):
            prefixes[agent] = tour
    unvisited = set(range(instance.n_nodes)).difference(*prefixes)
    if unvisited and all(len(prefix) > 1 and prefix[-1] == 0 for prefix in prefixes):
        prefixes[0] = [0]
    return instance, prefixes, tours


def least_makespan(instance: Instance, prefixes: Tours, stopped: Collection[int] = ()) -> float:
    """The least makespan of all tours that begin with the prefixes, by trying every assignment and every order.

    Agents that have ``stopped`` stay where they are.
    """
    unvisited = sorted(set(range(1, instance.n_nodes)).difference(*prefixes))
    going = [a for a, prefix in enumerate(prefixes) if a not in stopped and not is_closed(prefix)]
    best = math.inf
    for order in itertools.permutations(unvisited):
        for agents in itertools.combinations_with_replacement(going, len(order)):
            tours = [list(prefix) for prefix in prefixes]
            for city, agent in zip(order, agents, strict=True):
                tours[agent].append(city)
            closed = [tour if agent in stopped else [*tour, 0] for agent, tour in enumerate(tours)]
            best = min(best, makespan(instance, closed))
    return best


def choices_of(instance: Instance, prefixes: Tours, agent: int) -> list[int]:
    """The nodes to which an agent that is not home for good may go; the depot, if it is one of them, comes last."""
    unvisited = sorted(set(range(1, instance.n_nodes)).difference(*prefixes))
    others_out = any(not is_closed(prefix) for other, prefix in enumerate(prefixes) if other != agent)
    return unvisited + [0] * (others_out or not unvisited)


def decided(prefixes: Tours, agent: int, node: int) -> Tours:
    """The prefixes after ``agent`` has set off for ``node``."""
    return [[*prefix, node] if number == agent else prefix for number, prefix in enumerate(prefixes)]
