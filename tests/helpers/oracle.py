"""Algorithm 1 of the paper, written out literally and slowly, to test ``mtsp_env.rules`` against it.

Ticks pass one by one, a loop over the agents runs inside each, and an agent's remaining travel distance g is lowered at
the end of its turn in that loop. In worlds, cities appear and agents break down at the beginning of a tick, by looking
at each of them; there is no queue of events. Plain Python floats and lists; nothing of ``mtsp_env`` is imported.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping, Sequence
from typing import NamedTuple

TICK_TOLERANCE = 1e-9  # a time within this of a whole number of ticks counts as that number


class Seen(NamedTuple):
    """What the deciding agent sees."""

    cities: list[tuple[float, float]]  # n: node minus own position
    agents: list[tuple[float, float, float]]  # m: destination minus own position, remaining g
    visited: list[bool]  # n
    action_mask: list[bool]  # n
    extra: dict[str, list]  # the keys that only worlds, view and hearing have


class Oracle:
    """One game; read ``agent``, ``tick`` and ``observe()``, then ``step(action)`` until ``done``.

    Args:
        nodes: n pairs of coordinates, the depot first.
        n_agents: m.
        speed: distance per tick.
        depot: "open", "wait" or "final".
        reward: "sparse" or "shaped".
        max_decisions: the game is cut off after this many; by default 20 (n + m).
        world: its fields, by name: speeds, service, appears, breaks, traffic.
        view: the number of open cities that an agent knows; None: all.
        hearing: how far an agent hears; None: all others.
    """

    def __init__(
        self,
        nodes: Sequence[Sequence[float]],
        n_agents: int,
        speed: float = 0.1,
        depot: str = "open",
        reward: str = "sparse",
        max_decisions: int | None = None,
        world: Mapping[str, Sequence] | None = None,
        view: int | None = None,
        hearing: float | None = None,
    ):
        self.nodes = [(float(x), float(y)) for x, y in nodes]
        self.n, self.m = len(self.nodes), n_agents
        self.speed, self.depot, self.reward_rule = speed, depot, reward
        self.max_decisions = 20 * (self.n + self.m) if max_decisions is None else max_decisions
        self.world = {} if world is None else dict(world)
        self.speeds = [float(x) for x in self.world.get("speeds", [1.0] * self.m)]
        self.service = [float(x) for x in self.world.get("service", [0.0] * self.n)]
        self.appears = [float(x) for x in self.world.get("appears", [0.0] * self.n)]
        self.breaks = [float(x) for x in self.world.get("breaks", [math.inf] * self.m)]
        self.traffic = [[float(x) for x in row] for row in self.world.get("traffic", [[1.0]] * self.m)]
        self.waiting_counts = "appears" in self.world or "breaks" in self.world
        self.view, self.hearing = view, hearing

        self.tick = 0
        self.decisions = 0
        self.done = self.truncated = False
        self.reward = 0.0  # of the last decision, the same to every agent
        self.visited = [False] * self.n
        self.known = [False] * self.n
        self.paths = [[0] for _ in range(self.m)]  # every choice in turn, waits at the depot included
        self.legs = [0] * self.m  # how many it has begun
        self.since = [0] * self.m  # tick at which it set off on the current one
        self.announced = [0.0] * self.m  # time of the current leg and visit, as announced
        self.lowered = [0] * self.m  # ticks by which that has been lowered
        self.travel = [0.0] * self.m  # time until it arrives
        self.total = [0.0] * self.m  # time until it decides again
        self.own = [0.0] * self.m  # own time after the current leg
        self.alive = [True] * self.m
        self.cut = [False] * self.m  # broke down on the way to the last node of its path
        self.closed = [False] * self.m  # depot "final": decides no more
        self.asleep = [False] * self.m  # depot "wait": until something happens
        self._algorithm = self._algorithm_1()
        self.agent: int = next(self._algorithm)

    def _algorithm_1(self) -> Generator[int, int, None]:
        """Yields the agent that decides, is sent its choice, and returns when the game is over."""
        while True:
            happened = self._events()
            if happened and "breaks" in self.world and self._all_reached():
                self.done = True
                return
            if happened or any(self._decides(j) for j in range(self.m)):
                self.asleep = [False] * self.m
            for i in range(self.m):
                if self._decides(i):
                    if self._ends():
                        return
                    node = yield i
                    self._depart(i, node)
                    if "breaks" not in self.world and all(self.visited[1:]):
                        self.done = True
                        return
                self.lowered[i] += 1  # g_i <- g_i - speed
            self.tick += 1

    def _events(self) -> bool:
        """Cities appear and agents break down, before anyone decides at this tick; whether something happened."""
        happened = False
        for city in range(self.n):
            if not self.known[city] and self._has_passed(self.appears[city], self.tick):
                self.known[city] = happened = True
        for j in range(self.m):
            if self.alive[j] and self.tick > 0 and self._has_passed(self.breaks[j], self.tick):
                self.alive[j], happened = False, True
                node, self.cut[j] = self.paths[j][-1], not self._arrived(j)
                if node != 0 and self.cut[j]:
                    self.visited[node] = False
                if node != 0 or self.cut[j]:
                    self.own[j] = self.breaks[j]
        return happened

    def _has_passed(self, time: float, ticks: int) -> bool:
        return time / self.speed - ticks <= TICK_TOLERANCE

    def _decides(self, j: int) -> bool:
        able = self.alive[j] and not self.closed[j] and not self.asleep[j]
        return able and self._has_passed(self.total[j], self.tick - self.since[j])

    def _arrived(self, j: int) -> bool:
        """Every leg takes a tick at least."""
        ticks = self.tick - self.since[j]
        return len(self.paths[j]) == 1 or (ticks >= 1 and self._has_passed(self.travel[j], ticks))

    def _ends(self) -> bool:
        """At a decision: whether the game is over instead."""
        if "breaks" in self.world and self._all_reached():
            self.done = True
        elif self.decisions >= self.max_decisions:
            self.done = self.truncated = True
        return self.done

    def _all_reached(self) -> bool:
        return all(self.visited[1:]) and not self._underway()

    def _underway(self) -> set[int]:
        """The cities to which living agents are on their way."""
        ways = {self.paths[j][-1] for j in range(self.m) if self.alive[j] and not self._arrived(j)}
        return ways - {0}

    def _depart(self, i: int, node: int) -> None:
        here = self.paths[i][-1]
        self.paths[i].append(node)
        self.since[i], self.lowered[i] = self.tick, 0
        self.announced[i] = self.travel[i] = self.total[i] = 0.0
        self.decisions += 1
        if here == node == 0:  # it stays at the depot, which is no leg
            self.asleep[i], self.closed[i] = self.depot == "wait", self.depot == "final"
            return
        time = math.dist(self.nodes[here], self.nodes[node]) / self.speeds[i]
        self.travel[i] = time * self.traffic[i][self.legs[i] % len(self.traffic[i])]
        self.announced[i], self.total[i] = time + self.service[node], self.travel[i] + self.service[node]
        self.legs[i] += 1
        if self.waiting_counts and here == 0:
            self.own[i] = self.tick * self.speed
        self.own[i] += self.total[i]
        if node != 0:
            self.visited[node] = True
        elif self.depot == "final":
            self.closed[i] = True

    def step(self, action: int) -> None:
        """The deciding agent sets off for ``action``; ``reward`` is what this pays.

        Raises:
            ValueError: an illegal action.
        """
        if self.done or not 0 <= action < self.n or not self.legal_actions()[action]:
            raise ValueError(f"agent {self.agent} may not go to {action}")
        before = self.makespan if self.reward_rule == "shaped" else 0.0
        try:
            self.agent = self._algorithm.send(action)
        except StopIteration:
            self.agent = -1  # nobody decides any more
        if self.reward_rule == "shaped":
            self.reward = before - self.cost
        else:
            self.reward = -self.cost if self.done else 0.0

    def legal_actions(self) -> list[bool]:
        """Unvisited cities that the deciding agent knows, and the depot by the depot rule."""
        i, open_cities = self.agent, self._open_cities()
        if not open_cities:
            home = True
        elif self.depot == "final":
            has_left = len(self.paths[i]) > 1
            others_out = any(not self.closed[j] for j in range(self.m) if j != i)
            home = has_left and others_out
        else:
            home = not all(self._stands_at_depot(j) for j in range(self.m) if self.alive[j])
        known = self._known_to(i)
        return [home, *(city in open_cities and known[city] for city in range(1, self.n))]

    def _open_cities(self) -> set[int]:
        return {city for city in range(1, self.n) if self.known[city] and not self.visited[city]}

    def _stands_at_depot(self, j: int) -> bool:
        return self.paths[j][-1] == 0 and (self.travel[j] == 0.0 or self._arrived(j))

    def _known_to(self, i: int) -> list[bool]:
        """The nodes that agent i knows, the depot included."""
        if self.view is None:
            return list(self.known)
        here = self.paths[i][-1]
        nearest = sorted(self._open_cities(), key=lambda city: (self._distance(here, city), city))[: self.view]
        return [node == 0 or node in nearest for node in range(self.n)]

    def _distance(self, a: int, b: int) -> float:
        """As the rules round it, so that ties are ties: ``math.dist`` rounds better."""
        x, y = self.nodes[a][0] - self.nodes[b][0], self.nodes[a][1] - self.nodes[b][1]
        return math.sqrt(x * x + y * y)

    def _g(self, j: int) -> float:
        """Agent j's announced remaining time at this point of the loop; the deciding agent has arrived."""
        if not self.alive[j] or j == self.agent or self._has_passed(self.announced[j], self.lowered[j]):
            return 0.0
        return self.announced[j] - self.lowered[j] * self.speed

    def observe(self) -> Seen:
        """What the deciding agent sees, at this point of the loop."""
        i, here = self.agent, self.paths[self.agent][-1]
        known, visible = self._known_to(i), [node if knows else 0 for node, knows in enumerate(self._known_to(i))]
        heard = [
            self.hearing is None or j == i or self._distance(here, path[-1]) <= self.hearing
            for j, path in enumerate(self.paths)
        ]
        agents = [(*self._seen_from(here, path[-1]), self._g(j)) for j, path in enumerate(self.paths)]
        extra: dict[str, list] = {}
        if "speeds" in self.world:
            extra["agent_speeds"] = self.speeds
        if "breaks" in self.world:
            extra["agent_alive"] = [a or not hears for a, hears in zip(self.alive, heard, strict=True)]
        if "service" in self.world:
            extra["service"] = [time if knows else 0.0 for time, knows in zip(self.service, known, strict=True)]
        if self.hearing is not None:
            extra["agent_known"] = heard
        if "appears" in self.world or self.view is not None:
            extra["city_known"] = known
        return Seen(
            cities=[self._seen_from(here, node) for node in visible],
            agents=[
                row if hears else (*self._seen_from(here, 0), 0.0) for row, hears in zip(agents, heard, strict=True)
            ],
            visited=[seen or not knows for seen, knows in zip(self.visited, known, strict=True)],
            action_mask=self.legal_actions(),
            extra=extra,
        )

    def _seen_from(self, here: int, node: int) -> tuple[float, float]:
        return self.nodes[node][0] - self.nodes[here][0], self.nodes[node][1] - self.nodes[here][1]

    @property
    def tours(self) -> list[list[int]]:
        """Every agent's tour, closed at the depot; waiting there does not repeat it.

        A broken agent's ends with the last city that it reached, or with the depot if it had set off for it.
        """
        tours = []
        for path, alive, cut in zip(self.paths, self.alive, self.cut, strict=True):
            if cut and path[-1] != 0:
                path = path[:-1]
                while len(path) > 1 and path[-1] == 0:
                    path = path[:-1]
            tour = [0]
            for node in [*path, 0] if alive else path:
                if node != 0 or tour[-1] != 0:
                    tour.append(node)
            tours.append(tour if len(tour) > 1 or not alive else [0, 0])
        return tours

    @property
    def makespan(self) -> float:
        """The largest own time if every agent goes home now."""
        times = []
        for i, path in enumerate(self.paths):
            time = self.own[i]
            if self.alive[i]:
                factor = self.traffic[i][self.legs[i] % len(self.traffic[i])]
                time += math.dist(self.nodes[path[-1]], self.nodes[0]) / self.speeds[i] * factor
            times.append(min(time, self.breaks[i]))
        return max(times)

    @property
    def cost(self) -> float:
        """The makespan and, if the game was cut off, out-and-back trips to all cities that are missing."""
        if not self.truncated:
            return self.makespan
        missing = {city for city in range(1, self.n) if not self.visited[city]}
        begin = self.makespan
        if "breaks" in self.world:
            missing |= self._underway()
        if self.waiting_counts:
            begin = max(begin, self.tick * self.speed, *(self.appears[city] for city in missing))
        slowest, worst = min(self.speeds), max(map(max, self.traffic))
        trips = [2 * math.dist(self.nodes[0], self.nodes[c]) / slowest * worst + self.service[c] for c in missing]
        return begin + math.fsum(trips)
