"""Games to play, the oracle's way of playing them, and every face that must play them the same.

To test another face against the oracle, add a class with the five methods of ``RulesFace`` and a line of ``FACES``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
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
from mtsp_env.tours import check_log

# Games, and the players that choose the actions


@dataclass(frozen=True)
class Game:
    """B games of one size under one set of rules; a row has its own nodes and its own player."""

    arrays: dict[str, np.ndarray]  # nodes (B, n, 2) and the fields of the world (B, ...)
    n_agents: int
    rules: rules.Rules
    players: tuple[Callable[[Oracle, np.random.Generator], int], ...]  # B
    seed: int

    @property
    def nodes(self) -> np.ndarray:
        """(B, n, 2)."""
        return self.arrays["nodes"]

    @property
    def world(self) -> dict[str, np.ndarray]:
        """The fields of the world, by name."""
        return {name: array for name, array in self.arrays.items() if name != "nodes"}

    def oracle(self, row: int) -> Oracle:
        """A fresh oracle for one row."""
        world = {name: array[row] for name, array in self.world.items()}
        return Oracle(self.nodes[row], self.n_agents, world=world, **asdict(self.rules))


@dataclass(frozen=True)
class Moment:
    """A decision, as every face must show it."""

    agent: int
    tick: int
    cities: np.ndarray  # (n, 2)
    agents: np.ndarray  # (m, 3)
    visited: np.ndarray  # (n,)
    action_mask: np.ndarray  # (n,)
    extra: dict[str, np.ndarray]  # the keys that only worlds, view and hearing have


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


FIELDS = ("speeds", "service", "appears", "breaks", "traffic")


def random_world(
    rng: np.random.Generator, batch: int, n: int, m: int, fields: Sequence[str], speed: float
) -> dict[str, np.ndarray]:
    """World fields with many ties: half of the times are whole numbers of ticks, some of one value for everybody."""

    def times(shape: tuple[int, ...], most: float) -> np.ndarray:
        drawn = rng.uniform(0.0, most, shape)
        return np.where(rng.random(shape) < 0.5, np.round(drawn / speed) * speed, drawn)

    length = float(rng.choice([0.3, 1.0, 3.0]))  # of the game in which something happens
    breaks = np.where(rng.random((batch, m)) < rng.choice([0.3, 0.9]), times((batch, m), length) + speed / 3, np.inf)
    breaks[np.arange(batch), rng.integers(0, m, batch)] = np.inf
    if rng.random() < 0.5:  # all at once
        breaks[np.isfinite(breaks)] = np.round(length / 3 / speed) * speed + speed
    appears = times((batch, n), length) * (rng.random((batch, n)) < rng.choice([0.3, 0.6, 1.0]))
    service = times((batch, n), 0.2) * (rng.random((batch, n)) < 0.7)
    appears[:, 0] = service[:, 0] = 0.0
    world = {
        "speeds": rng.choice([0.5, 1.0, 1.0, 2.0, rng.uniform(0.5, 1.5)], (batch, m)),
        "service": service,
        "appears": appears,
        "breaks": breaks,
        "traffic": rng.choice([0.5, 1.0, 1.0, 2.0, rng.lognormal(0.0, 0.3)], (batch, m, int(rng.integers(1, 5)))),
    }
    return {name: world[name] for name in fields}


def random_world_game(seed: int, batch: int = 4) -> Game:
    """A game in a world of one field, of some or of all; every fourth has ``view`` or ``hearing``, or both."""
    rng = np.random.default_rng([seed, 1])
    n, m, speed = int(rng.integers(2, 16)), int(rng.integers(1, 7)), float(rng.choice([0.1, 0.01]))
    number = (1, 1, 2, 3, 5)[seed % 5]
    fields = (FIELDS[seed // 5 % 5],) if number == 1 else tuple(rng.permutation(FIELDS)[:number].tolist())
    depots = ["open", "wait"] if {"appears", "breaks"} & set(fields) else list(rules.DEPOTS)
    game_rules = rules.make_rules(
        n,
        m,
        speed=speed,
        depot=str(rng.choice(depots)),
        reward=str(rng.choice(rules.REWARDS)),
        max_decisions=None if rng.random() < 0.75 else int(rng.integers(1, 2 * (n + m))),
        view=int(rng.integers(1, n)) if seed % 4 == 0 else None,
        hearing=float(rng.choice([0.0, 0.2, 0.5])) if seed % 8 in (0, 1) else None,
    )
    kinds = rng.choice([*PLACES, "uniform", "uniform"], batch)
    nodes = np.stack([PLACES[kind](rng, n) for kind in kinds])
    players = tuple(PLAYERS[i] for i in rng.integers(0, len(PLAYERS), batch))
    return Game({"nodes": nodes, **random_world(rng, batch, n, m, fields, speed)}, m, game_rules, players, seed)


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
    return Game({"nodes": np.stack([PLACES[kind](rng, n) for kind in kinds])}, m, game_rules, players, seed)


@dataclass(frozen=True)
class Trace:
    """One row as the oracle played it."""

    moments: list[Moment]
    actions: list[int]
    rewards: list[float]
    end: Oracle


def play(game: Game) -> list[Trace]:
    """Every row of the game, played by the oracle: the traces that all faces must reproduce."""
    traces = []
    for row, player in enumerate(game.players):
        rng = np.random.default_rng([game.seed, row])
        oracle = game.oracle(row)
        trace = Trace([], [], [], oracle)
        while not oracle.done:
            *seen, extra = oracle.observe()
            extra = {key: np.array(value) for key, value in extra.items()}
            trace.moments.append(Moment(oracle.agent, oracle.tick, *map(np.array, seen), extra))
            trace.actions.append(player(oracle, rng))
            oracle.step(trace.actions[-1])
            trace.rewards.append(oracle.reward)
        traces.append(trace)
    return traces


@cache
def play_random(seed: int, make: Callable[[int], Game] = random_game) -> tuple[Game, list[Trace]]:
    """``make(seed)`` and its traces, played once for all faces."""
    game = make(seed)
    return game, play(game)


# Faces: all implementations of the rules. A face is built from a game and has the five
# methods below; `step` is given an action for each row, 0 for rows that are over.


class RulesFace:
    """``mtsp_env.rules`` itself; ``array`` makes the arrays of a library."""

    reward_tolerance = 1e-9

    def __init__(self, array: Callable, game: Game):
        self.array, self.game_rules = array, game.rules
        problem = Problem(game.n_agents, {name: array(values) for name, values in game.arrays.items()})
        self.state = rules.start(problem, game.rules)
        self.paid = None

    def moments(self) -> list[Moment]:
        seen = {key: np.asarray(value) for key, value in rules.observe(self.state, self.game_rules).arrays().items()}
        seen["tick"] = np.asarray(rules.now(self.state))
        return [_moment({key: value[row] for key, value in seen.items()}) for row in range(len(seen["tick"]))]

    def step(self, actions: list[int]) -> None:
        before, self.state = self.state, rules.depart(self.state, self.game_rules, self.array(actions))
        self.paid = rules.reward(before, self.state, self.game_rules)

    def rewards(self) -> list[float]:
        return self.paid.tolist()

    def over(self) -> list[tuple[bool, bool]]:
        """(terminated, truncated) of each row."""
        ends = rules.terminated(self.state), rules.truncated(self.state, self.game_rules)
        return list(zip(*(end.tolist() for end in ends), strict=True))

    def outcomes(self) -> list[tuple[float, list[list[int]]]]:
        """(cost, closed tours) of each row."""
        cost = rules.final_cost(self.state, self.game_rules).tolist()
        visits, destination = np.asarray(self.state.visits), np.asarray(self.state.destination)
        alive = [None] * len(cost) if self.state.alive is None else np.asarray(self.state.alive)
        tours = [rules.tours(*row[:2], True, row[2]) for row in zip(visits, destination, alive, strict=True)]
        return list(zip(cost, tours, strict=True))


class AECFace:
    """``mtsp_v0.raw_env``, one for each row, read after every step as a user reads it."""

    reward_tolerance = 1e-9

    def __init__(self, game: Game):
        self.envs = []
        for row in range(len(game.nodes)):
            world = {name: array[row] for name, array in game.world.items()}
            env = mtsp_v0.raw_env(game.nodes.shape[1], game.n_agents, scenario=always(world), **asdict(game.rules))
            env.reset(options={"instance": Instance(game.nodes[row], game.n_agents, **world)})
            self.envs.append(env)

    def moments(self) -> list[Moment]:
        return [self._moment(env) for env in self.envs]

    @staticmethod
    def _moment(env: mtsp_v0.raw_env) -> Moment:
        seen, agent = env.last()[0], env.possible_agents.index(env.agent_selection)
        assert seen["observation"]["agent"] == agent
        assert env.observation_space(env.agent_selection).contains(seen)
        return _moment({"tick": env.now, "action_mask": seen["action_mask"], **seen["observation"]})

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
        for env in self.envs:
            if all(env.terminations.values()):
                for speed in (env.rules.speed, None):
                    assert check_log(env.instance, env.log, speed) == pytest.approx(
                        env.infos["agent_0"]["makespan"], abs=1e-9
                    )
        infos = [env.infos[env.possible_agents[-1]] for env in self.envs]
        return [(info["makespan"], env.tours) for info, env in zip(infos, self.envs, strict=True)]


class BatchedFace:
    """``BatchedMTSP``, stepped and read as TorchRL does it; without ``compiled`` as if there were no Numba."""

    reward_tolerance = 1e-5  # float32

    def __init__(self, game: Game, compiled: bool = True):
        batch, n = game.nodes.shape[:2]
        world = {name: array[0] for name, array in game.world.items()}
        self.env = BatchedMTSP(n, game.n_agents, [batch], scenario=always(world), **asdict(game.rules))
        if not compiled:
            self.env._numpy_rules = rules
        arrays = {name: torch.tensor(array) for name, array in game.arrays.items()}
        self.td = self.env.reset(TensorDict({"game": arrays}, batch_size=[batch]), set_state=True)

    def moments(self) -> list[Moment]:
        others = {"game", "action", "reward", "done", "terminated", "truncated"}
        seen = {key: value.numpy() for key, value in self.td.items() if key not in others}
        seen["tick"] = self.td["game", "ready"].amin(1).numpy()
        return [_moment({key: value[row] for key, value in seen.items()}) for row in range(len(seen["tick"]))]

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


def always(world: dict[str, np.ndarray]) -> Callable:
    """A scenario in which every instance has these fields."""
    return lambda rng, batch, n_nodes, n_agents: {name: np.stack([a] * batch) for name, a in world.items()}


def _moment(seen: dict) -> Moment:
    named = {field.name: seen.pop(field.name) for field in fields(Moment) if field.name != "extra"}
    return Moment(**named, extra=seen)


FACES: dict[str, Callable] = {
    "numpy": partial(RulesFace, np.array),
    "torch": partial(RulesFace, torch.tensor),
    "aec": AECFace,
    "batched": BatchedFace,
    "batched without Numba": partial(BatchedFace, compiled=False),
}


def check_face(name: str, game: Game, traces: list[Trace]) -> None:
    """Replay the oracle's actions on the face: every decision and every end must be the same."""
    face = FACES[name](game)
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
    assert seen.extra.keys() == truth.extra.keys(), where
    for key, value in truth.extra.items():
        assert np.array_equal(seen.extra[key], value.astype(seen.extra[key].dtype)), f"{key}, {where}"
