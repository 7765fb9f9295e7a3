"""Plan once, then hand new or orphaned cities to the nearest agent: what a dispatcher without a replanner would do."""

from __future__ import annotations

import numpy as np

from mtsp_env import rules
from mtsp_env.instance import Instance, Tours
from mtsp_env.reference import plan_rest


class PlanOnce:
    """A policy for one game: the reference solver plans at its first decision, and never again.

    A city that has appeared since, or that a broken agent leaves behind, goes to the living agent whose destination is
    nearest. That agent inserts it where it lengthens the route least. An agent without cities goes home and waits.
    If an agent must leave the depot, it takes its nearest open city from the agent that has it.

    Args:
        iterations: number of iterations of the search for the plan, at least 0.
        seed: seed of that search.
    """

    def __init__(self, iterations: int, seed: int = 0):
        self.iterations, self.seed = iterations, seed
        self._routes: Tours | None = None  # the cities that each agent still sets off for, in order

    def __call__(self, game: rules.State, game_rules: rules.Rules) -> int:
        """The deciding agent's next node in the game (B = 1, NumPy arrays)."""
        agent, cities = int(rules.agent_to_decide(game)[0]), open_cities(game)
        alive = np.ones(game.problem.n_agents, bool) if game.alive is None else game.alive[0]
        if self._routes is None:
            self._routes = self._plan(game, cities)
        routes, left = self._routes, set(cities)
        for a, route in enumerate(routes):
            route[:] = [city for city in route if city in left] if alive[a] else []
        nodes, destination = game.problem.nodes[0], game.destination[0]
        for city in sorted(left.difference(*routes)):
            distance = np.where(alive, np.hypot(*(nodes[destination] - nodes[city]).T), np.inf)
            nearest = int(np.argmin(distance))
            insert_cheaply(routes[nearest], city, int(destination[nearest]), nodes)
        if not routes[agent] and not rules.legal_actions(game, game_rules, np.array([agent]))[0, 0]:
            city = min(cities, key=lambda city: np.hypot(*(nodes[city] - nodes[destination[agent]])))
            next(route for route in routes if city in route).remove(city)
            routes[agent].append(city)
        return routes[agent].pop(0) if routes[agent] else 0

    def _plan(self, game: rules.State, cities: list[int]) -> Tours:
        arrays, m = game.problem.arrays, game.problem.n_agents
        known = {name: arrays[name][0] for name in ("nodes", "speeds", "service") if name in arrays}
        instance = Instance(n_agents=m, **known)
        return plan_rest(instance, [0] * m, np.zeros(m), cities, iterations=self.iterations, seed=self.seed)


def open_cities(game: rules.State) -> list[int]:
    """The cities of one game that are known now and unvisited."""
    is_open = ~game.visited[0]
    if game.appear_tick is not None:
        is_open &= game.appear_tick[0] <= rules.now(game)[0]
    return [int(city) for city in np.flatnonzero(is_open) if city]


def insert_cheaply(route: list[int], city: int, start: int, nodes: np.ndarray) -> None:
    """Insert ``city`` into ``route``, which goes from node ``start`` over its cities home, where it costs least."""
    path = nodes[[start, *route, 0]]  # (k + 2, 2)
    to_city = np.hypot(*(path - nodes[city]).T)
    detour = to_city[:-1] + to_city[1:] - np.hypot(*np.diff(path, axis=0).T)
    route.insert(int(np.argmin(detour)), city)
