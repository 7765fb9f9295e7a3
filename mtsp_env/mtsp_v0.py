"""The PettingZoo face: an AEC environment in which each agent decides when it arrives (paper, Sec. 4)."""

from __future__ import annotations

import operator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import AECEnv
from pettingzoo.utils import wrappers

from mtsp_env import rules, world
from mtsp_env.distributions import Generator, check_distribution, distribution_name, sample, scenario_shapes
from mtsp_env.instance import Instance, Problem, Tours, batch, check_plannable
from mtsp_env.log import write_log
from mtsp_env.tours import Log, makespan

if TYPE_CHECKING:
    from mtsp_env.render import Viewer


def env(**kwargs: Any) -> AECEnv:
    """``raw_env`` with PettingZoo's checks on the order of calls. Takes the arguments of ``raw_env``."""
    return _OrderEnforcingWrapper(raw_env(**kwargs))


class _OrderEnforcingWrapper(wrappers.OrderEnforcingWrapper):
    """PettingZoo's, whose ``num_agents`` fails before the first reset."""

    @property
    def num_agents(self) -> int:
        return self.env.num_agents


class raw_env(AECEnv):
    """The MinMax mTSP, one decision at a time.

    ``agent_selection`` is the agent that has just arrived. It observes a dict of

    - ``observation``: ``cities`` (n, 2) float32, node coordinates minus its own; ``agents`` (m, 3) float32, every
      agent's destination minus its own position, and the time that it still needs, in the plain problem a distance;
      ``visited`` (n,) bool, the global mask; ``agent``, its index, a scalar int64. In worlds also some of
      ``agent_speeds``, ``agent_alive``, ``service``, ``agent_known`` and ``city_known``.
    - ``action_mask``: (n,) int8, its legal next nodes. ``env.action_space(agent).sample(mask)`` picks one of them.

    Its action is the node to go to next. When every city is visited all agents terminate at once, with the reward
    -makespan. The last infos hold ``makespan`` (in the unit square; if truncated, with the penalty); with
    ``reference``, also ``reference_makespan``, of near-optimal tours for the same instance, and ``regret``,
    ``makespan / reference_makespan - 1``: 0.1 means 10 % longer. ``env.unwrapped.tours`` are the tours, during a game
    and after it, and ``env.unwrapped.log`` is the log of all legs with their times.

    With ``scenario``, the game is played in a world in which cities appear, agents break down, roads delay or agents
    differ; docs/problem.md says what each world field means. Use the depot rule "wait" there: an agent with nothing to
    do is asked again only when something happens.

    A running game can be copied (``copy.deepcopy``) and pickled; the copy goes on exactly as the original would.

    Rewards: every agent is paid the same. A learner that shares one set of parameters must pay agent i
    ``env.rewards[i]`` right after i's own ``step``. ``env.last()`` returns what has accumulated since i's last
    decision. With shaped rewards that includes what the other agents' decisions paid, so summed over all decisions it
    counts every payment m times. With sparse rewards, both are the same: -makespan at the end.

    The depot rule here is the paper's, "open". ``dan_policy.solve`` plays "final", so that its tours are complete
    whatever a policy does.

    PettingZoo's ``parallel_to_aec`` and ``aec_to_parallel`` do not fit agents that act one at a time;
    ``pettingzoo.utils.conversions.turn_based_aec_to_parallel`` does.

    Args:
        n_nodes: n, the depot included, at least 2.
        n_agents: m, at least 1.
        speed: distance per tick of the clock, at least 1e-9.
        depot: "open" (the paper), "wait" or "final", see ``mtsp_env.rules.Rules``.
        reward: "sparse" or "shaped", see ``mtsp_env.rules.Rules``.
        max_decisions: truncation, by default after 20 (n + m) decisions.
        distribution: where the nodes lie: a key of ``mtsp_env.DISTRIBUTIONS``, or a function ``(rng, batch, n_nodes,
            n_agents) -> dict of arrays``, see ``mtsp_env.distributions``.
        render_mode: None, "rgb_array" or "human" (both need the extra ``render``).
        reference: measure regret, in the plain problem or a world whose only fields are ``speeds`` and ``service``.
            ``mtsp_env.reference.improve`` solves the instance as its first episode ends, with its default iterations
            and seed, so the same instance always has the same ``reference_makespan``: about 0.1 s at n = 50, 3 s at
            n = 1000 (extra ``reference``).
        info_tours: put ``tours`` into the last infos as well. Lists of unequal lengths break the batches of some
            libraries.
        scenario: the world: a key of ``mtsp_env.SCENARIOS``, or a function of the same form. It decides which world
            fields all instances of this environment have; a function is called once at creation to find out.
        view: an agent knows the nearest ``view`` open cities only; None: all.
        hearing: an agent hears only of agents whose destination is at most this far away; None: of all.

    Raises:
        ImportError: ``reference`` without Numba.
        ValueError: an argument outside its range, an instance of another size or with other world fields, or an illegal
            action; nothing changes.
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
        distribution: str | Generator = "uniform",
        render_mode: str | None = None,
        reference: bool = False,
        info_tours: bool = False,
        scenario: str | Generator = "plain",
        view: int | None = None,
        hearing: float | None = None,
    ):
        super().__init__()
        self.rules = rules.make_rules(n_nodes, n_agents, speed, depot, reward, max_decisions, view, hearing)
        check_distribution(distribution)
        self.world = tuple(scenario_shapes(scenario, 1, n_nodes, n_agents))  # its instances' world fields
        rules.check_world(self.world, self.rules)
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"unknown render_mode {render_mode!r}; choose from {self.metadata['render_modes']}")
        for name, value in (("reference", reference), ("info_tours", info_tours)):
            if not isinstance(value, (bool, np.bool_)):
                raise ValueError(f"{name} must be True or False, got {value!r}")
        if reference:
            import mtsp_env.reference  # noqa: F401  says at once if Numba is missing

            check_plannable(self.world)
        self.n_nodes, self.n_agents = n_nodes, n_agents
        self.distribution, self.scenario, self.render_mode = distribution, scenario, render_mode
        self.reference, self.info_tours = reference, info_tours

        self.possible_agents = [f"agent_{i}" for i in range(n_agents)]
        self._index = {name: np.array([i]) for i, name in enumerate(self.possible_agents)}  # (B,) with B = 1
        self._extra = rules.observed_fields(self.world, self.rules)
        self._all_knowing = replace(self.rules, view=None, hearing=None)  # for state()
        self.observation_spaces = {a: self._make_observation_space() for a in self.possible_agents}
        self.action_spaces = {a: spaces.Discrete(n_nodes) for a in self.possible_agents}
        shared = rules.observed_fields(self.world, self._all_knowing)
        size = 3 * n_nodes + 4 * n_agents + sum(n_nodes if f.shape == ("n",) else n_agents for f in shared.values())
        self.state_space = spaces.Box(0.0, np.float32(3e38), (size,), np.float32)
        self._rng = np.random.default_rng()
        self._legal: np.ndarray | None = None  # (n,) the deciding agent's mask, once it is known
        self._viewer: Viewer | None = None
        self.agents: list[str] = []

    @property
    def num_agents(self) -> int:
        """m before the first reset and during an episode; 0 once the agents of a finished one have been stepped out."""
        return len(self.agents) if hasattr(self, "game") else self.n_agents

    def __getstate__(self) -> dict[str, Any]:
        """Everything but the window: copies of a running game go on by themselves."""
        return {**self.__dict__, "_viewer": None}

    def observation_space(self, agent: str) -> spaces.Space:
        """Dict(observation=Dict(cities, agents, visited, agent, and the keys of the world), action_mask)."""
        return self.observation_spaces[agent]

    def _make_observation_space(self) -> spaces.Dict:
        n, m = self.n_nodes, self.n_agents
        longest = np.inf if self.world else np.sqrt(2.0)  # remaining time
        low = np.tile(np.array([-1, -1, 0], np.float32), (m, 1))
        high = np.tile(np.array([1, 1, longest], np.float32), (m, 1))
        observation: dict[str, spaces.Space] = {
            "cities": spaces.Box(-1.0, 1.0, (n, 2), np.float32),
            "agents": spaces.Box(low, high, dtype=np.float32),
            "visited": spaces.Box(0, 1, (n,), np.bool_),
            "agent": spaces.Discrete(m),
        }
        for name, field in self._extra.items():
            dtype = np.dtype(field.dtype).type
            observation[name] = spaces.Box(0, 1 if dtype is np.bool_ else np.inf, field.sizes(n, m), dtype)  # type: ignore[arg-type]
        return spaces.Dict({"observation": spaces.Dict(observation), "action_mask": spaces.Box(0, 1, (n,), np.int8)})

    def action_space(self, agent: str) -> spaces.Space:
        """Discrete(n): the node to go to next."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict | None = None) -> None:
        """A fresh instance of the distribution, or ``options["instance"]``; all agents at the depot at tick 0.

        Raises:
            ValueError: an unknown option, or an instance with another n or m than this environment.
        """
        options = {} if options is None else options
        known = isinstance(options, dict) and options.keys() <= {"instance"}
        if not known and options != {"options": 1}:  # which PettingZoo's api_test passes
            raise ValueError(f"options must be a dict with the key 'instance' at most, got {options!r}")
        instance = options.get("instance")
        if instance is not None and not isinstance(instance, Instance):
            raise ValueError(f"options['instance'] must be an Instance, got {type(instance).__name__}")
        if instance is not None and (instance.n_nodes, instance.n_agents) != (self.n_nodes, self.n_agents):
            raise ValueError(
                f"the instance has n_nodes={instance.n_nodes}, n_agents={instance.n_agents}, this environment "
                f"n_nodes={self.n_nodes}, n_agents={self.n_agents}"
            )
        if instance is not None:
            self._check_fields(batch([instance]))
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        if instance is None:
            drawn = sample(self.distribution, self._rng, 1, self.n_nodes, self.n_agents, self.scenario)
            self._check_fields(drawn)
            instance = drawn.instance(0, distribution_name(self.distribution))
        self.game = rules.start(batch([instance]), self.rules)
        self.instance = instance
        self._decisions: list[int] = []  # the nodes picked so far, for the log
        self._legal = None

        self.agents = list(self.possible_agents)
        self.agent_selection = self.agents[0]
        self.rewards = dict.fromkeys(self.agents, 0.0)
        self._cumulative_rewards = dict.fromkeys(self.agents, 0.0)
        self.terminations = dict.fromkeys(self.agents, False)
        self.truncations = dict.fromkeys(self.agents, False)
        self.infos: dict[str, dict[str, Any]] = {a: {} for a in self.agents}
        if self.render_mode == "human":
            self.render()

    def observe(self, agent: str) -> dict:
        """What ``agent`` sees now; an agent underway sees the world from its destination."""
        seen = rules.observe(self.game, self.rules, self._index[agent])
        if agent == self.agent_selection:
            self._legal = seen.action_mask[0]  # step() checks against it
        observation = {
            "cities": seen.cities[0],
            "agents": seen.agents[0],
            "visited": seen.visited[0],
            "agent": seen.agent[0],
        }
        for name in self._extra:
            observation[name] = getattr(seen, name)[0]
        return {"observation": observation, "action_mask": seen.action_mask[0].astype(np.int8)}

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
        self._decisions.append(action)

        self._cumulative_rewards[self.agent_selection] = 0.0
        self.agent_selection = self.possible_agents[rules.agent_to_decide(self.game)[0]]
        self._legal = None
        terminated = bool(rules.terminated(self.game)[0])
        truncated = not terminated and int(self.game.decisions[0]) >= self.rules.max_decisions
        if terminated or truncated or self.rules.reward == "shaped":
            self.rewards = dict.fromkeys(self.agents, float(rules.reward(before, self.game, self.rules)[0]))
            self._accumulate_rewards()
        if terminated or truncated:
            self._end(terminated)
        if self.render_mode == "human":
            self.render()

    def _end(self, terminated: bool) -> None:
        """End the episode for all agents at once, with the same last info for each."""
        self.terminations = dict.fromkeys(self.agents, terminated)
        self.truncations = dict.fromkeys(self.agents, not terminated)
        cost = float(rules.final_cost(self.game, self.rules)[0])
        last: dict[str, Any] = {"makespan": cost}
        if self.info_tours:
            last["tours"] = self.tours
        if self.reference:
            best = _reference_makespan(self.instance)
            regret = cost / best - 1.0 if best > 0.0 else 0.0  # all nodes in one place: nothing to regret
            last |= {"reference_makespan": best, "regret": regret}
        self.infos = {a: dict(last) for a in self.agents}

    def _check_action(self, action: int | None) -> int:
        name = self.agent_selection
        try:
            node = operator.index(action)  # type: ignore[arg-type]
        except TypeError:
            raise ValueError(
                f"{name} must pick a node as a whole number in 0..{self.n_nodes - 1}, got {type(action).__name__} "
                f"{action!r}"
            ) from None
        if isinstance(action, (bool, np.bool_)) or not 0 <= node < self.n_nodes:
            raise ValueError(f"{name} must pick a node in 0..{self.n_nodes - 1}, got {action!r}")
        if self._legal is None:
            self._legal = rules.legal_actions(self.game, self.rules, self._index[name])[0]
        if not self._legal[node]:
            why = "is not open to it now" if node == 0 or not self.game.visited[0, node] else "is visited already"
            raise ValueError(f"{name} may not go to node {node}: it {why}; see action_mask")
        return node

    def _check_fields(self, problem: Problem) -> None:
        if problem.world != self.world:
            raise ValueError(
                f"this environment plays instances with the world fields {list(self.world)}, as its scenario draws "
                f"them, got one with {list(problem.world)}"
            )

    @property
    def tours(self) -> Tours:
        """Every agent's tour so far; once the episode is over, each ends at the depot, but those of broken agents."""
        alive = None if self.game.alive is None else self.game.alive[0]
        return rules.tours(self.game.visits[0], self.game.destination[0], self._is_over, alive)

    @property
    def log(self) -> Log:
        """Every agent's legs so far, in units of time; see ``mtsp_env.tours.Leg`` and ``check_log``.

        It shows a leg under way as if nothing will interrupt it. After the episode it also contains the return legs.
        """
        return write_log(batch([self.instance]), self.rules, self._decisions, self._is_over)

    @property
    def _is_over(self) -> bool:
        return any(self.terminations.values()) or any(self.truncations.values()) or not self.agents

    @property
    def now(self) -> int:
        """The clock: the tick of the decision at hand."""
        return int(rules.now(self.game)[0])

    def state(self) -> np.ndarray:
        """What is known to all agents together, and their own times: float32 (3 n + 4 m,), more in worlds.

        Nodes (x, y, visited), agents (destination x, y; g; own time after the current leg, as announced if there is
        traffic on it), then those of ``agent_speeds``, ``agent_alive``, ``service`` and ``city_known`` that the world
        has. Nothing in it depends on what happens later.
        """
        game, m = self.game, self.n_agents
        seen = rules.observe(game, self._all_knowing)
        decider = rules.agent_to_decide(game)
        own_time = world.known_own_times(game, self.rules, decider, rules.now(game))
        nodes = self.instance.nodes
        if seen.city_known is not None:
            nodes = np.where(seen.city_known[0][:, None], nodes, nodes[0])
        per_node = np.concatenate([nodes, seen.visited[0][:, None]], axis=1)
        per_agent = np.concatenate([nodes[game.destination[0]], seen.agents[0][:, 2:], own_time.reshape(m, 1)], axis=1)
        extra = [array[0] for name, array in seen.arrays().items() if name in rules.OBSERVED]
        return np.concatenate([per_node.ravel(), per_agent.ravel(), *extra]).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """ "rgb_array": the picture, uint8 (height, width, 3). "human": shown in a window, None.

        Cities are hidden until they appear. A grey disc marks where an agent has broken down, and the legend says who
        has, and who waits at the depot.
        """
        if self.render_mode is None:
            raise ValueError(f"render() needs a render_mode; choose from {self.metadata['render_modes']} at creation")
        from mtsp_env.render import Viewer

        if self._viewer is None:
            self._viewer = Viewer(show=self.render_mode == "human")
        game, now = self.game, self.now
        known = None if game.appear_tick is None else game.appear_tick[0] <= now
        alive = np.ones(self.n_agents, bool) if game.alive is None else game.alive[0]
        waits = alive & (game.destination[0] == 0) & (game.leg[0] == 0.0) & (game.ready[0] > now)
        return self._viewer.draw(self.instance, self.tours, known, ~alive, waits & (not self._is_over))

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


@lru_cache(maxsize=1024)  # a test set is played by many policies, or many times by one that learns
def _reference_makespan(instance: Instance) -> float:
    from mtsp_env.reference import improve

    return makespan(instance, improve(instance))
