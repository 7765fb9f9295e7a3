"""The central planner that a practitioner would build today, as a policy for both environments (extra ``reference``).

It plans the tours of the whole team with the reference solver, follows the plan, and plans again whenever something
happens that the plan did not foresee. It is the benchmark for decentralised policies in worlds that change.

>>> replanner = Replanner(milliseconds=5)
>>> env.step(replanner(env))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtsp_env import rules, world
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.instance import Instance, Tours
from mtsp_env.reference import plan_rest

if TYPE_CHECKING:
    from pettingzoo import AECEnv
    from tensordict import TensorDictBase

    from mtsp_env.batched import BatchedMTSP


@dataclass(frozen=True)
class Plan:
    """What the team intends to do.

    Attributes:
        nodes: (n, 2), of the game that it is for.
        alive: (m,) bool, the agents that it counts on.
        routes: the cities that each agent still sets off for, in order; then it goes home.
    """

    nodes: np.ndarray
    alive: np.ndarray
    routes: Tours


class Replanner:
    """Plans all tours centrally, and again at every event, with what is known to everybody at that moment.

    An event is a city that appears, an agent that breaks down, or an agent that decides later than announced. The plan
    begins where everybody is: an agent goes on from its destination when it is announced to be ready there. Nothing
    about the future enters it: no city that has not appeared, no time of a breakdown, no traffic on a leg that is not
    finished; a leg is expected to take as long as announced. Between events it follows its plan.

    Use one for each environment that plays single games: between games it forgets its plan.

    It needs to know everything that anybody knows, and so plays no games with ``view`` or ``hearing``.

    Args:
        milliseconds: time limit of each search, above 0. The greedy insertion with which a search begins is never cut
            short.
        iterations: limit on the iterations of each search, at least 0. Without ``milliseconds``, decisions depend on
            the games alone.
        seed: seed of each search, a whole number of at least 0.

    Raises:
        ValueError: neither milliseconds nor iterations, or a value outside its range.
    """

    def __init__(self, milliseconds: float | None = None, iterations: int | None = None, seed: int = 0):
        if milliseconds is None and iterations is None:
            raise ValueError("a Replanner needs milliseconds or iterations")
        if milliseconds is not None:
            check_seconds("milliseconds", milliseconds, "milliseconds")
        if iterations is not None:
            check_count("iterations", iterations, minimum=0)
        check_count("seed", seed, minimum=0)
        self._seconds = None if milliseconds is None else milliseconds / 1000.0
        self._iterations, self._seed = iterations, seed
        self._plan: Plan | None = None
        self.plans = 0  # made so far, in all games

    def __call__(self, env: AECEnv) -> int:
        """The next node of the deciding agent of an ``mtsp_v0`` environment.

        Raises:
            ValueError: the environment has ``view`` or ``hearing``.
        """
        face = env.unwrapped
        _check_rules(face.rules)
        node, self._plan = self.decide(face.game, face.rules, self._plan)
        return node

    def policy(self, env: BatchedMTSP) -> Callable[[TensorDictBase], TensorDictBase]:
        """A TorchRL policy for ``env``: it reads the state under ``"game"`` and writes ``action`` (B,).

        It plans centrally, one row after the other: a search for one game cannot be batched with those of others.

        Raises:
            ValueError: the environment has ``view`` or ``hearing``.
        """
        import torch

        _check_rules(env.rules)
        plans: list[Plan | None] = [None] * env.batch_size[0]

        def act(tensordict: TensorDictBase) -> TensorDictBase:
            arrays = {name: tensor.cpu().numpy() for name, tensor in tensordict.get("game").items()}
            actions = []
            for row in range(len(plans)):
                own = {name: array[row : row + 1] for name, array in arrays.items()}
                game = rules.state_from_arrays(own, env.n_agents)
                node, plans[row] = self.decide(game, env.rules, plans[row])
                actions.append(node)
            return tensordict.set("action", torch.tensor(actions, device=tensordict.get("action_mask").device))

        return act

    def decide(self, game: rules.State, game_rules: rules.Rules, plan: Plan | None) -> tuple[int, Plan]:
        """The deciding agent's next node in one game (B = 1, NumPy arrays), and the plan from then on.

        ``plan`` is what the last decision in this game returned; None: there is none yet.
        """
        return self.follow(game, game_rules, self.update(game, game_rules, plan))

    def update(self, game: rules.State, game_rules: rules.Rules, plan: Plan | None) -> Plan:
        """The plan for the decision at hand: ``plan`` itself if nothing has happened that it did not foresee."""
        agent = int(rules.agent_to_decide(game)[0])
        cities = _open_cities(game)
        alive = np.ones(len(game.ready[0]), bool) if game.alive is None else game.alive[0]
        if plan is not None and (game.decisions[0] == 0 or not np.array_equal(plan.nodes, game.problem.nodes[0])):
            plan = None  # of another game
        if plan is None or not _is_up_to_date(plan, cities, alive) or _is_late(game, game_rules, agent):
            plan = Plan(game.problem.nodes[0].copy(), alive.copy(), self._search(game, game_rules, cities, alive, plan))
        return plan

    def follow(self, game: rules.State, game_rules: rules.Rules, plan: Plan) -> tuple[int, Plan]:
        """The deciding agent's next node by an up-to-date ``plan``, and the plan from then on."""
        agent = int(rules.agent_to_decide(game)[0])
        routes = [list(route) for route in plan.routes]
        if not routes[agent] and not rules.legal_actions(game, game_rules, np.array([agent]))[0, 0]:
            _take_over(game, routes, agent)
        node = routes[agent].pop(0) if routes[agent] else 0
        return node, Plan(plan.nodes, plan.alive, routes)

    def _search(
        self, game: rules.State, game_rules: rules.Rules, cities: list[int], alive: np.ndarray, plan: Plan | None
    ) -> Tours:
        """The routes of all agents through ``cities``, starting from those of ``plan``."""
        arrays, n_agents = game.problem.arrays, game.problem.n_agents
        if not cities:
            return [[] for _ in range(n_agents)]
        self.plans += 1
        known = {name: arrays[name][0] for name in ("nodes", "speeds", "service") if name in arrays}
        is_closed = (game.ready[0] == rules.NEVER) & (game_rules.depot == "final")
        goes_on = alive & ~is_closed
        heads = [int(node) if goes else None for node, goes in zip(game.destination[0], goes_on, strict=True)]
        free = _free_times(game, game_rules)
        free = np.maximum(free - free[goes_on].min(), 0.0)  # what has passed is the same for all plans
        routes = None
        if plan is not None:
            still_open = set(cities)
            routes = [
                [city for city in route if city in still_open] if goes else []
                for route, goes in zip(plan.routes, goes_on, strict=True)
            ]
        instance = Instance(n_agents=n_agents, **known)
        return plan_rest(instance, heads, free, cities, routes, self._seconds, self._iterations, self._seed)


def _check_rules(game_rules: rules.Rules) -> None:
    if game_rules.view is not None or game_rules.hearing is not None:
        raise ValueError(
            f"a central planner must know every city and agent, but agents have view={game_rules.view}, "
            f"hearing={game_rules.hearing}"
        )


def _open_cities(game: rules.State) -> list[int]:
    """The cities that are known now and unvisited."""
    is_open = ~game.visited[0]
    if game.appear_tick is not None:
        is_open = is_open & (game.appear_tick[0] <= rules.now(game)[0])
    is_open[0] = False
    return np.flatnonzero(is_open).tolist()


def _is_up_to_date(plan: Plan, cities: list[int], alive: np.ndarray) -> bool:
    """Whether the plan visits the open ``cities`` and no others, with the agents that are ``alive``."""
    return np.array_equal(plan.alive, alive) and sorted(city for route in plan.routes for city in route) == cities


def _is_late(game: rules.State, game_rules: rules.Rules, agent: int) -> bool:
    """Whether ``agent``, which decides now, has needed more ticks than announced."""
    if game.legs is None or game.leg[0, agent] == 0.0:  # no traffic, or it has waited at the depot
        return False
    announced = world.ticks_of(game.leg[0], game_rules)[agent]
    return bool(rules.now(game)[0] - game.departed[0, agent] > announced)


def _free_times(game: rules.State, game_rules: rules.Rules) -> np.ndarray:
    """(m,) Own times at which the agents can leave their destinations, as far as is known now."""
    agent, tick = int(rules.agent_to_decide(game)[0]), rules.now(game)[0]
    leg = game.leg[0]
    elapsed = (tick - game.departed[0]) * game_rules.speed
    is_there = leg == 0.0  # it waits at the depot, or is broken
    is_there[agent] = True
    if game.problem.waiting_counts:  # an agent that waits at the depot leaves it at the clock's time
        return tick * game_rules.speed + np.where(is_there, 0.0, np.maximum(leg - elapsed, 0.0))
    return world.known_own_times(game, game_rules, np.array([agent]), rules.now(game))[0]


def _take_over(game: rules.State, routes: Tours, agent: int) -> None:
    """Give ``agent``, which must leave the depot but has nothing to do, the city of its shortest trip.

    If agents are equally fast, this makes no tour longer than the longest of the plan.
    """
    nodes = game.problem.nodes[0]
    trip = 2.0 * np.hypot(*(nodes - nodes[0]).T)
    if "speeds" in game.problem.arrays:
        trip = trip / game.problem.arrays["speeds"][0, agent]
    if "service" in game.problem.arrays:
        trip = trip + game.problem.arrays["service"][0]
    city = min((city for route in routes for city in route), key=lambda city: trip[city])
    for route in routes:
        if city in route:
            route.remove(city)
    routes[agent].append(city)
