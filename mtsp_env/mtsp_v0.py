"""The PettingZoo face: an AEC environment in which each agent decides when it arrives (paper, Sec. 4)."""

from __future__ import annotations

import operator
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from pettingzoo import AECEnv
from pettingzoo.utils import wrappers

from mtsp_env import rules
from mtsp_env.instance import Instance, Tours, check_distribution, sample_nodes
from mtsp_env.tours import makespan


def env(**kwargs: Any) -> AECEnv:
    """``raw_env`` with PettingZoo's checks on the order of calls. Takes the arguments of ``raw_env``."""
    return wrappers.OrderEnforcingWrapper(raw_env(**kwargs))


class raw_env(AECEnv, EzPickle):
    """The MinMax mTSP, one decision at a time.

    ``agent_selection`` is the agent that has just arrived. It observes a dict of

    - ``observation``: ``cities`` (n, 2), node coordinates minus its own; ``agents`` (m, 3), every agent's destination
      minus its own position, and the distance that it still has to go; ``visited`` (n,), the global mask. All float32.
    - ``action_mask``: (n,) int8, its legal next nodes. ``env.action_space(agent).sample(mask)`` picks one of them.

    Its action is the node to go to next. When every city is visited all agents terminate at once, with the reward
    -makespan. The last infos hold ``makespan`` (in the unit square; with the penalty where truncated) and ``tours``;
    with ``reference``, also ``reference_makespan``, of near-optimal tours for the same instance, and ``regret``,
    ``makespan / reference_makespan - 1``: 0.1 is 10 % longer than need be.

    Args:
        n_nodes: n, the depot included, at least 2.
        n_agents: m, at least 1.
        speed: distance per tick of the clock, at least 1e-9.
        depot: "open" (the paper) or "final", see ``mtsp_env.rules.Rules``.
        reward: "sparse" or "shaped", see ``mtsp_env.rules.Rules``.
        max_decisions: truncation, by default after 20 (n + m) decisions.
        distribution: where instances come from, a key of ``mtsp_env.DISTRIBUTIONS``.
        render_mode: None, "rgb_array" or "human" (both need the extra ``render``).
        reference: measure regret. ``mtsp_env.reference.improve`` solves the instance as its first episode ends, with
            its default iterations and seed, so the same instance always has the same ``reference_makespan``: about
            0.1 s at n = 50, 3 s at n = 1000 (extra ``reference``).

    Raises:
        ImportError: ``reference`` without Numba.
        ValueError: an argument outside its range, an instance of another size, or an illegal action; nothing changes.
    """

    metadata: ClassVar[dict[str, Any]] = {
        "name": "mtsp_v0",
        "render_modes": ["human", "rgb_array"],
        "is_parallelizable": False,
        "render_fps": 5,
    }

    def __init__(
        self,
        n_nodes: int = 50,
        n_agents: int = 5,
        speed: float = 0.01,
        depot: rules.Depot = "open",
        reward: rules.Reward = "sparse",
        max_decisions: int | None = None,
        distribution: str = "uniform",
        render_mode: str | None = None,
        reference: bool = False,
    ):
        EzPickle.__init__(
            self, n_nodes, n_agents, speed, depot, reward, max_decisions, distribution, render_mode, reference
        )
        super().__init__()
        self.rules = rules.make_rules(n_nodes, n_agents, speed, depot, reward, max_decisions)
        check_distribution(distribution)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"unknown render_mode {render_mode!r}; choose from {self.metadata['render_modes']}")
        if not isinstance(reference, (bool, np.bool_)):
            raise ValueError(f"reference must be True or False, got {reference!r}")
        if reference:
            import mtsp_env.reference  # noqa: F401  Numba: only where it is needed, but where it is missing, at once
        self.n_nodes, self.n_agents = n_nodes, n_agents
        self.distribution, self.render_mode, self.reference = distribution, render_mode, reference

        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self._index = {name: np.array([i]) for i, name in enumerate(self.possible_agents)}  # (B,) = (1,), for the rules
        self.observation_spaces = {a: _observation_space(n_nodes, n_agents) for a in self.possible_agents}
        self.action_spaces = {a: spaces.Discrete(n_nodes) for a in self.possible_agents}
        self.state_space = spaces.Box(0.0, np.float32(3e38), (3 * n_nodes + 4 * n_agents,), np.float32)
        self._rng = np.random.default_rng()
        self._legal: np.ndarray | None = None  # (n,) the deciding agent's mask, once it is known
        self._viewer = None
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space:
        """Dict(observation=Dict(cities, agents, visited), action_mask)."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Space:
        """Discrete(n): the node to go to next."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        """A fresh instance of the distribution, or ``options["instance"]``; all agents at the depot at tick 0.

        Raises:
            ValueError: the instance has another n or m than this environment.
        """
        instance = options.get("instance") if isinstance(options, dict) else None
        if instance is not None and not isinstance(instance, Instance):
            raise ValueError(f"options['instance'] must be an Instance, got {type(instance).__name__}")
        if instance is not None and (instance.n_nodes, instance.n_agents) != (self.n_nodes, self.n_agents):
            raise ValueError(
                f"the instance has n_nodes={instance.n_nodes}, n_agents={instance.n_agents}, this environment "
                f"n_nodes={self.n_nodes}, n_agents={self.n_agents}"
            )
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        if instance is None:
            nodes = sample_nodes(self.distribution, self._rng, 1, self.n_nodes)[0]
            instance = Instance(nodes, self.n_agents, self.distribution)
        self.instance = instance
        self.game = rules.start(instance.nodes[None], self.n_agents)
        self._legal = None

        self.agents = list(self.possible_agents)
        self.agent_selection = self.agents[0]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos = {a: {} for a in self.agents}
        if self.render_mode == "human":
            self.render()

    def observe(self, agent: str) -> dict:
        """What ``agent`` sees now; an agent underway sees the world from its destination."""
        seen = rules.observe(self.game, self.rules, self._index[agent])
        if agent == self.agent_selection:
            self._legal = seen.action_mask[0]  # step() checks against it
        return {
            "observation": {
                "cities": seen.cities[0],
                "agents": seen.agents[0],
                "visited": seen.visited[0].astype(np.float32),
            },
            "action_mask": seen.action_mask[0].astype(np.int8),
        }

    def step(self, action: int | None) -> None:
        """The selected agent sets off for node ``action``; the next to arrive is selected.

        Raises:
            ValueError: an illegal action; nothing has changed.
        """
        if self.terminations[self.agent_selection] or self.truncations[self.agent_selection]:
            self._was_dead_step(action)
            return
        action = self._check_action(action)
        before, self.game = self.game, rules.depart(self.game, self.rules, np.array([action]))

        self._cumulative_rewards[self.agent_selection] = 0.0
        self.agent_selection = self.possible_agents[self.game.agent[0]]
        self._legal = None
        terminated = bool(rules.all_visited(self.game)[0])
        truncated = not terminated and int(self.game.decisions[0]) >= self.rules.max_decisions
        if terminated or truncated or self.rules.reward == "shaped":
            self.rewards = dict.fromkeys(self.agents, float(rules.reward(before, self.game, self.rules)[0]))
            self._accumulate_rewards()
        if terminated or truncated:
            self._end(terminated)
        if self.render_mode == "human":
            self.render()

    def _end(self, terminated: bool) -> None:
        """All agents end at once and get the same last info."""
        self.terminations = dict.fromkeys(self.agents, terminated)
        self.truncations = dict.fromkeys(self.agents, not terminated)
        cost = float(rules.final_cost(self.game, self.rules)[0])
        last = {"makespan": cost, "tours": self.tours}
        if self.reference:
            best = _reference_makespan(self.instance)
            regret = cost / best - 1.0 if best > 0.0 else 0.0  # all nodes in one place: nothing to regret
            last |= {"reference_makespan": best, "regret": regret}
        self.infos = {a: dict(last) for a in self.agents}

    def _check_action(self, action: int | None) -> int:
        name = self.agent_selection
        try:
            node = operator.index(action)
        except TypeError:  # None, a float, an array, ...
            node = -1
        if not 0 <= node < self.n_nodes:
            raise ValueError(f"{name} must pick a node in 0..{self.n_nodes - 1}, got {action!r}")
        if self._legal is None:
            self._legal = rules.legal_actions(self.game, self.rules, self.game.agent)[0]
        if not self._legal[node]:
            why = "is not open to it now" if node == 0 else "is visited already"
            raise ValueError(f"{name} may not go to node {node}: it {why}; see action_mask")
        return node

    @property
    def tours(self) -> Tours:
        """Every agent's tour so far; at the end of the episode each is closed at the depot."""
        over = any(self.terminations.values()) or any(self.truncations.values()) or not self.agents
        return rules.tours(self.game.visits[0], self.game.destination[0], close=over)

    @property
    def now(self) -> int:
        """The clock: the tick of the decision at hand."""
        return int(self.game.ready[0].min())

    def state(self) -> np.ndarray:
        """All there is, float32 (3 n + 4 m,): nodes (x, y, visited), agents (destination x, y; g; tour length)."""
        game, m = self.game, self.n_agents
        seen = rules.observe(game, self.rules)
        per_node = np.concatenate([game.nodes[0], game.visited[0][:, None]], axis=1)
        per_agent = np.concatenate(
            [game.nodes[0][game.destination[0]], seen.agents[0][:, 2:], game.length[0].reshape(m, 1)], axis=1
        )
        return np.concatenate([per_node.ravel(), per_agent.ravel()]).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """ "rgb_array": the picture, uint8 (height, width, 3). "human": shown in a window, None."""
        if self.render_mode is None:
            raise ValueError(f"render() needs a render_mode; choose from {self.metadata['render_modes']} at creation")
        from mtsp_env.render import Viewer

        if self._viewer is None:
            self._viewer = Viewer(show=self.render_mode == "human")
        return self._viewer.draw(self.instance, self.tours)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


@lru_cache(maxsize=1024)  # a test set is played by many policies, or many times by one that learns
def _reference_makespan(instance: Instance) -> float:
    from mtsp_env.reference import improve

    return makespan(instance.nodes, improve(instance))


def _observation_space(n_nodes: int, n_agents: int) -> spaces.Dict:
    farthest = np.float32(np.sqrt(2.0))
    low = np.tile(np.array([-1, -1, 0], np.float32), (n_agents, 1))
    high = np.tile(np.array([1, 1, farthest], np.float32), (n_agents, 1))
    return spaces.Dict(
        {
            "observation": spaces.Dict(
                {
                    "cities": spaces.Box(-1.0, 1.0, (n_nodes, 2), np.float32),
                    "agents": spaces.Box(low, high, dtype=np.float32),
                    "visited": spaces.Box(0.0, 1.0, (n_nodes,), np.float32),
                }
            ),
            "action_mask": spaces.Box(0, 1, (n_nodes,), np.int8),
        }
    )
