"""Algorithm 1 of the paper, written out literally and slowly, to test ``mtsp_env.rules`` against it.

Ticks pass one by one, a loop over the agents runs inside each, and an agent's remaining travel distance g is lowered at
the end of its turn in that loop. Plain Python floats and lists; nothing of ``mtsp_env`` is imported.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Sequence
from typing import NamedTuple

TICK_TOLERANCE = 1e-9  # a leg within this of a whole number of ticks counts as that number


class Seen(NamedTuple):
    """What the deciding agent sees."""

    cities: list[tuple[float, float]]  # n: node minus own position
    agents: list[tuple[float, float, float]]  # m: destination minus own position, remaining g
    visited: list[bool]  # n
    action_mask: list[bool]  # n


class Oracle:
    """One game; read ``agent``, ``tick`` and ``observe()``, then ``step(action)`` until ``done``.

    Args:
        nodes: n pairs of coordinates, the depot first.
        n_agents: m.
        speed: distance per tick.
        depot: "open" or "final".
        reward: "sparse" or "shaped".
        max_decisions: the game is cut off after this many; by default 20 (n + m).
    """

    def __init__(
        self,
        nodes: Sequence[Sequence[float]],
        n_agents: int,
        speed: float = 0.1,
        depot: str = "open",
        reward: str = "sparse",
        max_decisions: int | None = None,
    ):
        self.nodes = [(float(x), float(y)) for x, y in nodes]
        self.n, self.m = len(self.nodes), n_agents
        self.speed, self.depot, self.reward_rule = speed, depot, reward
        self.max_decisions = 20 * (self.n + self.m) if max_decisions is None else max_decisions

        self.tick = 0
        self.decisions = 0
        self.done = self.truncated = False
        self.reward = 0.0  # of the last decision, the same to every agent
        self.visited = [False] * self.n
        self.paths = [[0] for _ in range(self.m)]  # every choice in turn, waits at the depot included
        self.leg = [0.0] * self.m  # length of the current leg
        self.travelled = [0] * self.m  # ticks spent on it
        self.closed = [False] * self.m  # depot "final": decides no more
        self._algorithm = self._algorithm_1()
        self.agent: int = next(self._algorithm)

    def _algorithm_1(self) -> Generator[int, int, None]:
        """Yields the agent that decides, is sent its choice, and returns when the game is over."""
        while True:
            for i in range(self.m):
                if not self.closed[i] and self._g(i) <= 0:
                    node = yield i
                    self._depart(i, node)
                    if self.done:
                        return
                self.travelled[i] += 1  # g_i <- g_i - speed
            self.tick += 1

    def _g(self, j: int) -> float:
        """Agent j's remaining travel distance at this point of the loop."""
        if self.leg[j] / self.speed - self.travelled[j] <= TICK_TOLERANCE:
            return 0.0
        return self.leg[j] - self.travelled[j] * self.speed

    def _depart(self, i: int, node: int) -> None:
        self.leg[i] = math.dist(self.nodes[self.paths[i][-1]], self.nodes[node])
        self.travelled[i] = 0
        self.paths[i].append(node)
        if node != 0:
            self.visited[node] = True
        elif self.depot == "final":
            self.closed[i] = True
        self.decisions += 1
        complete = all(self.visited[1:])
        self.truncated = not complete and self.decisions >= self.max_decisions
        self.done = complete or self.truncated

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
        """Unvisited cities, and the depot by the depot rule."""
        i, cities_remain = self.agent, not all(self.visited[1:])
        if not cities_remain:
            home = True
        elif self.depot == "open":
            home = not all(self._stands_at_depot(j) for j in range(self.m))
        else:
            has_left = len(self.paths[i]) > 1
            others_out = any(not self.closed[j] for j in range(self.m) if j != i)
            home = has_left and others_out
        return [home, *(not seen for seen in self.visited[1:])]

    def _stands_at_depot(self, j: int) -> bool:
        """Whether agent j is at the depot or arrived there by this tick.

        Agents before the deciding one (j < i) have had their g lowered towards the next tick, at which they arrive.
        """
        ticks = self.travelled[j] - (j < self.agent)
        arrived = ticks >= 1 and self.leg[j] / self.speed - ticks <= TICK_TOLERANCE
        return self.paths[j][-1] == 0 and (self.leg[j] == 0 or arrived)

    def observe(self) -> Seen:
        """What the deciding agent sees, at this point of the loop."""
        x, y = self.nodes[self.paths[self.agent][-1]]
        heading = [self.nodes[path[-1]] for path in self.paths]
        return Seen(
            cities=[(cx - x, cy - y) for cx, cy in self.nodes],
            agents=[(hx - x, hy - y, self._g(j)) for j, (hx, hy) in enumerate(heading)],
            visited=list(self.visited),
            action_mask=self.legal_actions(),
        )

    @property
    def tours(self) -> list[list[int]]:
        """Every agent's tour, closed at the depot; waiting there does not repeat it."""
        tours = []
        for path in self.paths:
            tour = [0]
            for node in [*path, 0]:
                if node != 0 or tour[-1] != 0:
                    tour.append(node)
            tours.append(tour if len(tour) > 1 else [0, 0])
        return tours

    @property
    def makespan(self) -> float:
        """The longest tour so far, every agent's return leg counted."""
        return max(
            math.fsum(math.dist(self.nodes[a], self.nodes[b]) for a, b in zip(path, [*path[1:], 0], strict=True))
            for path in self.paths
        )

    @property
    def cost(self) -> float:
        """The makespan and, if the game was cut off, out-and-back trips to all unvisited cities."""
        trips = [2 * math.dist(self.nodes[0], self.nodes[c]) for c in range(1, self.n) if not self.visited[c]]
        return self.makespan + (math.fsum(trips) if self.truncated else 0.0)
