"""Games to play, the oracle's way of playing them, and every face that must play them the same.

To test another face against the oracle, add a class with the five methods of ``RulesFace`` and a line of ``FACES``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import step_mdp

from helpers.oracle import Oracle
from mtsp_env import Instance, mtsp_v0, rules
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Problem

# Games, and the players that choose the actions


@dataclass(frozen=True)
class Game:
    """B games of one size under one set of rules; a row has its own nodes and its own player."""

    nodes: np.ndarray  # (B, n, 2)
    n_agents: int
    rules: rules.Rules
    players: tuple[Callable[[Oracle, np.random.Generator], int], ...]  # B
    seed: int


@dataclass(frozen=True)
class Moment:
    """A decision, as every face must show it."""

    agent: int
    tick: int
    cities: np.ndarray  # (n, 2)
    agents: np.ndarray  # (m, 3)
    visited: np.ndarray  # (n,)
    action_mask: np.ndarray  # (n,)


def pick_any(oracle: Oracle, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(oracle.legal_actions())))


def pick_home(oracle: Oracle, rng: np.random.Generator) -> int:
    """Goes to the depot or stays there with probability 0.6 or more if that is legal."""
    return 0 if oracle.legal_actions()[0] and rng.random() < 0.6 else pick_any(oracle, rng)


def pick_nearest(oracle: Oracle, rng: np.random.Generator) -> int:
    """The nearest unvisited city; now and then the depot."""
    legal = oracle.legal_actions()
    if (legal[0] and rng.random() < 0.1) or not any(legal[1:]):
        return 0
    distance = np.hypot(*np.array(oracle.observe().cities).T)
    return 1 + int(np.argmin(np.where(legal, distance, np.inf)[1:]))


PLAYERS = (pick_any, pick_home, pick_nearest)
PLACES: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "uniform": lambda rng, n: rng.random((n, 2)),
    "grid": lambda rng, n: rng.integers(0, 11, (n, 2)) / 10,  # ties; coincident cities; cities on the depot
    "line": lambda rng, n: np.stack([rng.integers(0, 101, n) / 100, np.full(n, 0.5)], axis=1),  # whole ticks only
    "piles": lambda rng, n: np.array([[0.2, 0.2], [0.2, 0.8], [0.8, 0.2]])[rng.integers(0, 3, n)],
    "one place": lambda rng, n: np.tile(rng.random(2), (n, 1)),
}


def random_game(seed: int, batch: int = 4) -> Game:
    rng = np.random.default_rng(seed)
    n, m = int(rng.integers(2, 61)), int(rng.integers(1, 13))
    kinds = ["uniform", *rng.choice(list(PLACES), batch - 1)]
    game_rules = rules.make_rules(
        n,
        m,
        speed=float(rng.choice([0.1, 0.01])),
        depot=str(rng.choice(rules.DEPOTS)),
        reward=str(rng.choice(rules.REWARDS)),
        max_decisions=None if rng.random() < 0.75 else int(rng.integers(1, n + m)),
    )
    players = tuple(PLAYERS[i] for i in rng.integers(0, len(PLAYERS), batch))
    return Game(np.stack([PLACES[kind](rng, n) for kind in kinds]), m, game_rules, players, seed)


@dataclass(frozen=True)
class Trace:
    """One row as the oracle played it."""

    moments: list[Moment]
    actions: list[int]
    rewards: list[float]
    end: Oracle


def play(game: Game) -> list[Trace]:
    """Every row of the game, played by the oracle: the traces that all faces must reproduce."""
    traces, game_rules = [], game.rules
    for row, player in enumerate(game.players):
        rng = np.random.default_rng([game.seed, row])
        oracle = Oracle(
            game.nodes[row],
            game.n_agents,
            game_rules.speed,
            game_rules.depot,
            game_rules.reward,
            game_rules.max_decisions,
        )
        trace = Trace([], [], [], oracle)
        while not oracle.done:
            trace.moments.append(Moment(oracle.agent, oracle.tick, *map(np.array, oracle.observe())))
            trace.actions.append(player(oracle, rng))
            oracle.step(trace.actions[-1])
            trace.rewards.append(oracle.reward)
        traces.append(trace)
    return traces


@cache
def play_random(seed: int) -> tuple[Game, list[Trace]]:
    """``random_game(seed)`` and its traces, played once for all faces."""
    game = random_game(seed)
    return game, play(game)


# Faces: all implementations of the rules. A face is built from (nodes (B, n, 2), n_agents, rules) and has the five
# methods below; `step` is given an action for each row, 0 for rows that are over.


class RulesFace:
    """``mtsp_env.rules`` itself; ``array`` makes the arrays of a library."""

    reward_tolerance = 1e-9

    def __init__(self, array: Callable, nodes: np.ndarray, n_agents: int, game_rules: rules.Rules):
        self.array, self.game_rules = array, game_rules
        self.state = rules.start(Problem(n_agents, {"nodes": array(nodes)}))
        self.paid = None

    def moments(self) -> list[Moment]:
        state, seen = self.state, rules.observe(self.state, self.game_rules)
        *seen, agent = map(np.asarray, seen)
        return [Moment(*row) for row in zip(agent, np.asarray(rules.now(state)), *seen, strict=True)]

    def step(self, actions: list[int]) -> None:
        before, self.state = self.state, rules.depart(self.state, self.game_rules, self.array(actions))
        self.paid = rules.reward(before, self.state, self.game_rules)

    def rewards(self) -> list[float]:
        return self.paid.tolist()

    def over(self) -> list[tuple[bool, bool]]:
        """(terminated, truncated) of each row."""
        ends = rules.all_visited(self.state), rules.truncated(self.state, self.game_rules)
        return list(zip(*(end.tolist() for end in ends), strict=True))

    def outcomes(self) -> list[tuple[float, list[list[int]]]]:
        """(cost, closed tours) of each row."""
        cost = rules.final_cost(self.state, self.game_rules).tolist()
        visits, destination = np.asarray(self.state.visits), np.asarray(self.state.destination)
        return list(zip(cost, map(rules.tours, visits, destination), strict=True))


class AECFace:
    """``mtsp_v0.raw_env``, one for each row, read after every step as a user reads it."""

    reward_tolerance = 1e-9

    def __init__(self, nodes: np.ndarray, n_agents: int, game_rules: rules.Rules):
        size = nodes.shape[1], n_agents
        self.envs = [
            mtsp_v0.raw_env(*size, game_rules.speed, game_rules.depot, game_rules.reward, game_rules.max_decisions)
            for _ in nodes
        ]
        for env, row in zip(self.envs, nodes, strict=True):
            env.reset(options={"instance": Instance(row, n_agents)})

    def moments(self) -> list[Moment]:
        return [self._moment(env) for env in self.envs]

    @staticmethod
    def _moment(env: mtsp_v0.raw_env) -> Moment:
        seen, agent = env.last()[0], env.possible_agents.index(env.agent_selection)
        assert seen["observation"].pop("agent") == agent
        return Moment(agent, env.now, **seen["observation"], action_mask=seen["action_mask"])

    def step(self, actions: list[int]) -> None:
        for env, action in zip(self.envs, actions, strict=True):
            if not (any(env.terminations.values()) or any(env.truncations.values())):
                env.step(action)

    def rewards(self) -> list[float]:
        assert all(len(set(env.rewards.values())) == 1 for env in self.envs)  # the same to every agent
        return [env.rewards["agent_0"] for env in self.envs]

    def over(self) -> list[tuple[bool, bool]]:
        return [(all(env.terminations.values()), all(env.truncations.values())) for env in self.envs]

    def outcomes(self) -> list[tuple[float, list[list[int]]]]:
        infos = [env.infos[env.possible_agents[-1]] for env in self.envs]
        return [(info["makespan"], env.tours) for info, env in zip(infos, self.envs, strict=True)]


class BatchedFace:
    """``BatchedMTSP``, stepped and read as TorchRL does it."""

    reward_tolerance = 1e-5  # float32

    def __init__(self, nodes: np.ndarray, n_agents: int, game_rules: rules.Rules):
        size = nodes.shape[1], n_agents, nodes.shape[:1]
        self.env = BatchedMTSP(*size, game_rules.speed, game_rules.depot, game_rules.reward, game_rules.max_decisions)
        given = TensorDict({"game": {"nodes": torch.tensor(nodes)}}, batch_size=nodes.shape[:1])
        self.td = self.env.reset(given, set_state=True)

    def moments(self) -> list[Moment]:
        columns = [self.td["agent"], self.td["game", "ready"].amin(1)]
        columns += [self.td[key] for key in ("cities", "agents", "visited", "action_mask")]
        return [Moment(*row) for row in zip(*(column.numpy() for column in columns), strict=True)]

    def step(self, actions: list[int]) -> None:
        any_legal = self.td["action_mask"].to(torch.uint8).argmax(1)  # for rows that are over
        action = torch.where(self.td["done"][:, 0], any_legal, torch.tensor(actions))
        self.td = step_mdp(self.env.step(self.td.set("action", action)), exclude_reward=False)

    def rewards(self) -> list[float]:
        return self.td["reward"][:, 0].tolist()

    def over(self) -> list[tuple[bool, bool]]:
        assert torch.equal(self.td["done"], self.td["terminated"] | self.td["truncated"])
        return list(zip(self.td["terminated"][:, 0].tolist(), self.td["truncated"][:, 0].tolist(), strict=True))

    def outcomes(self) -> list[tuple[float, list[list[int]]]]:
        return list(zip(self.env.makespan(self.td).tolist(), self.env.tours(self.td), strict=True))


FACES: dict[str, Callable] = {
    "numpy": partial(RulesFace, np.array),
    "torch": partial(RulesFace, torch.tensor),
    "aec": AECFace,
    "batched": BatchedFace,
}


def check_face(name: str, game: Game, traces: list[Trace]) -> None:
    """Replay the oracle's actions on the face: every decision and every end must be the same."""
    face = FACES[name](game.nodes, game.n_agents, game.rules)
    last = [len(trace.actions) - 1 for trace in traces]
    for k in range(max(last) + 1):
        running = [row for row, end in enumerate(last) if k <= end]
        moments = face.moments()
        for row in running:
            check_moment(moments[row], traces[row].moments[k], f"row {row}, decision {k} of {game.rules}")
        face.step([trace.actions[k] if k < len(trace.actions) else 0 for trace in traces])
        rewards, over = face.rewards(), face.over()
        for row in running:
            end, where = traces[row].end, f"row {row}, decision {k} of {game.rules}"
            assert rewards[row] == pytest.approx(traces[row].rewards[k], abs=face.reward_tolerance), where
            truth = (not end.truncated, end.truncated) if k == last[row] else (False, False)
            assert over[row] == truth, where
    for row, (cost, tours) in enumerate(face.outcomes()):
        assert cost == pytest.approx(traces[row].end.cost, abs=1e-9)
        assert tours == traces[row].end.tours


def check_moment(seen: Moment, truth: Moment, where: str) -> None:
    assert (seen.agent, seen.tick) == (truth.agent, truth.tick), where
    assert np.array_equal(seen.action_mask, truth.action_mask), where
    assert np.array_equal(seen.visited, truth.visited), where
    assert seen.cities.shape == truth.cities.shape and np.abs(seen.cities - truth.cities).max() <= 1e-6, where
    assert not np.any(seen.agents[seen.agent]), where  # its own row: exactly zero
    assert seen.agents.shape == truth.agents.shape and np.abs(seen.agents - truth.agents).max() <= 1e-6, where
