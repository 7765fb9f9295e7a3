"""Greedy insertion as a slow, literal loop."""

from __future__ import annotations

import math

from mtsp_env import Instance
from mtsp_env.instance import Tours
from mtsp_env.tours import path_lengths


def greedy_insertion(instance: Instance) -> Tours:
    """Tours by inserting the farthest city first, each city where its tour stays shortest."""
    nodes = instance.nodes
    tours = [[0, 0] for _ in range(instance.n_agents)]
    for city in sorted(range(1, instance.n_nodes), key=lambda city: -math.dist(nodes[0], nodes[city])):
        options = [(a, [*tour[:i], city, *tour[i:]]) for a, tour in enumerate(tours) for i in range(1, len(tour))]
        agent, tour = min(options, key=lambda option: path_lengths(nodes, [option[1]])[0])
        tours[agent] = tour
    return tours
