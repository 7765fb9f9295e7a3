"""The rules against a literal Algorithm 1 (``oracle.py``) through every face, and what must hold of every game."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from helpers.faces import FACES, PLAYERS, Game, check_face, pick_any, pick_home, play, play_random
from helpers.oracle import Oracle
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, makespan, rules
from mtsp_env.instance import FIELDS, Problem

SEEDS = [range(start, start + 10) for start in range(0, 80, 10)]


@pytest.mark.parametrize("seeds", [SEEDS[0], *(pytest.param(s, marks=pytest.mark.slow) for s in SEEDS[1:])], ids=str)
@pytest.mark.parametrize("face", FACES)
def test_every_decision_is_algorithm_1s(face: str, seeds: range) -> None:
    for seed in seeds:  # 4 games each
        check_face(face, *play_random(seed))


@st.composite
def odd_games(draw: st.DrawFn) -> Game:
    """Small games on few coordinates: ties, coincident nodes, legs of whole ticks, below a tick, and almost 0 long."""
    axis = st.sampled_from([0.0, 0.1, 0.2, 0.25, 0.3, 0.3 + 1e-12, 0.5, 0.6, 0.7, 0.8, 1.0])
    n, m = draw(st.integers(2, 7)), draw(st.integers(1, 5))
    nodes = draw(st.lists(st.tuples(axis, axis), min_size=n, max_size=n))
    game_rules = rules.make_rules(
        n,
        m,
        speed=draw(st.sampled_from([0.1, 0.01, 0.05, 0.3, 1.0, 7.0])),
        depot=draw(st.sampled_from(rules.DEPOTS)),
        reward=draw(st.sampled_from(rules.REWARDS)),
        max_decisions=draw(st.none() | st.integers(1, n + m)),
    )
    return Game(
        {"nodes": np.array([nodes])}, m, game_rules, (draw(st.sampled_from(PLAYERS)),), draw(st.integers(0, 2**16))
    )


@settings(max_examples=250, deadline=None, derandomize=True, database=None)
@given(odd_games())
@pytest.mark.slow
def test_odd_games_are_algorithm_1s(game: Game) -> None:
    traces = play(game)
    for face in FACES:
        check_face(face, game, traces)


# What must hold of every game


def walk(seed: int, array: Callable = np.array) -> tuple[Game, list[rules.State]]:
    """Random games and all their states under the oracle's actions, from the start to two steps beyond the last end."""
    game, traces = play_random(seed)
    state = rules.start(Problem(game.n_agents, {"nodes": array(game.nodes)}), game.rules)
    states, actions = [state], [trace.actions for trace in traces]
    for k in range(max(map(len, actions)) + 2):
        state = rules.depart(state, game.rules, array([row[k] if k < len(row) else 0 for row in actions]))
        states.append(state)
    return game, states


def test_square_by_hand() -> None:
    """Unit square, two agents, half a side per tick: agent 0 takes nodes 1 and 2, agent 1 takes 3."""
    square = [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]
    oracle = Oracle(square, n_agents=2, speed=0.5)
    assert (oracle.agent, oracle.tick, oracle.legal_actions()) == (0, 0, [False, True, True, True])
    oracle.step(1)
    assert (oracle.agent, oracle.tick, oracle.legal_actions()) == (1, 0, [True, False, True, True])
    assert oracle.observe().agents == [(1.0, 0.0, 0.5), (0.0, 0.0, 0.0)]  # agent 0's g is lowered already: 1 - 0.5
    oracle.step(3)
    assert (oracle.agent, oracle.tick, oracle.reward) == (0, 2, 0.0)
    assert oracle.observe().agents == [(0.0, 0.0, 0.0), (-1.0, 1.0, 0.0)]
    oracle.step(2)
    assert oracle.done and oracle.tours == [[0, 1, 2, 0], [0, 3, 0]]
    assert oracle.reward == pytest.approx(-(2 + 2**0.5))
    with pytest.raises(ValueError, match="may not go"):
        oracle.step(0)


@pytest.mark.parametrize("seed", range(80))
def test_rewards_are_the_judges_makespan(seed: int) -> None:
    """Every city is visited exactly once, and the rewards sum to minus the makespan that ``tours.py`` finds."""
    game, traces = play_random(seed)
    for row, trace in enumerate(traces):
        if not trace.end.truncated:
            instance = Instance(game.nodes[row], game.n_agents)
            check_tours(instance, trace.end.tours)
            assert sum(trace.rewards) == pytest.approx(-makespan(instance, trace.end.tours), abs=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_shaped_rewards_sum_to_the_sparse_one(seed: int) -> None:
    game, states = walk(seed)
    total = {}
    for kind in rules.REWARDS:
        game_rules = rules.Rules(game.rules.speed, game.rules.depot, kind, game.rules.max_decisions)
        over = np.array(
            [rules.terminated(state) | rules.truncated(state, game_rules) for state in states]
        )  # (decisions + 1, B)
        paid = np.array([rules.reward(*pair, game_rules) for pair in pairwise(states)])  # (decisions, B)
        assert kind == "shaped" or not paid[~over[1:]].any()  # sparse: nothing before the end
        total[kind] = np.where(over[:-1], 0.0, paid).sum(axis=0)
    np.testing.assert_allclose(total["shaped"], total["sparse"], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("array", [np.array, torch.tensor], ids=["numpy", "torch"])
@pytest.mark.parametrize("seed", range(12))
def test_states_keep_their_shape_and_masks_are_never_empty(seed: int, array: Callable) -> None:
    game, states = walk(seed, array)
    for state in states:
        described = {"nodes": FIELDS["nodes"], **rules.state_fields(())}
        assert state.arrays().keys() == described.keys()
        for name, x in state.arrays().items():
            sizes = described[name].sizes(game.nodes.shape[1], game.n_agents)
            assert (tuple(x.shape), _kind(x)) == ((len(game.nodes), *sizes), described[name].dtype), name
        for agent in range(game.n_agents):
            seen = rules.observe(state, game.rules, array([agent] * len(game.nodes)))
            assert seen.action_mask.any(1).all()
            assert not (seen.action_mask[:, 1:] & seen.visited[:, 1:]).any()
            assert not seen.visited[:, 0].any()
            assert not seen.agents[:, agent, :2].any()  # it sees the world from its destination
            assert [_kind(x) for x in seen.arrays().values()] == ["float32", "float32", "bool", "bool", "int64"]


def _kind(array: rules.Array) -> str:
    """The name of its dtype, the same for NumPy and torch."""
    return str(array.dtype).removeprefix("torch.")


@pytest.mark.parametrize("seed", range(20))
def test_finished_games_stand_still(seed: int) -> None:
    """A batch steps its finished rows along with the others: to the depot, which changes neither cost nor tours."""
    game, states = walk(seed)
    game_rules = game.rules
    for before, after in pairwise(states):
        over = rules.terminated(before)
        assert (rules.terminated(after) | ~over).all()
        assert rules.makespan(after)[over] == pytest.approx(rules.makespan(before)[over], abs=1e-12)
        assert (
            rules.legal_actions(before, game_rules, rules.agent_to_decide(before))[over].sum() == over.sum()
        )  # the depot alone
        for row in np.flatnonzero(over):
            assert rules.tours(after.visits[row], after.destination[row]) == rules.tours(
                before.visits[row], before.destination[row]
            )


def test_depart_changes_nothing_in_place() -> None:
    game_rules = rules.make_rules(6, 3, 0.1, "open", "sparse", None)
    state = rules.start(Problem(3, {"nodes": np.random.default_rng(0).random((2, 6, 2))}), game_rules)
    copies = {name: array.copy() for name, array in state.arrays().items()}
    rules.depart(state, game_rules, np.array([2, 3]))
    assert all(np.array_equal(array, copies[name]) for name, array in state.arrays().items())


@pytest.mark.slow
@pytest.mark.parametrize("size", [(2, 1), (2, 5), (9, 3), (30, 1), (25, 12)], ids=str)
@pytest.mark.parametrize("depot", rules.DEPOTS)
def test_every_policy_ends(depot: str, size: tuple[int, int]) -> None:
    """Also the policy that stays at the depot if it may; "final" within n - 1 + m decisions, all cities visited."""
    policies = [*PLAYERS, lambda oracle, rng: int(np.argmax(oracle.legal_actions()))]
    game_rules = rules.make_rules(*size, 0.01, depot, "sparse", None)
    game = Game(
        {"nodes": np.random.default_rng(1).random((4, size[0], 2))}, size[1], game_rules, tuple(policies), seed=2
    )
    traces = play(game)
    check_face("numpy", game, traces)
    for trace in traces:
        assert len(trace.actions) <= (game_rules.max_decisions if depot != "final" else sum(size) - 1)
        assert depot != "final" or not trace.end.truncated
    assert not traces[0].end.truncated and not traces[2].end.truncated


@pytest.mark.parametrize("reward", rules.REWARDS)
@pytest.mark.parametrize("depot", rules.DEPOTS)
def test_stalling_never_pays(depot: str, reward: str) -> None:
    """A game that is cut off costs at least what any way to complete it from there costs."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        n, m = int(rng.integers(3, 12)), int(rng.integers(1, 5))
        nodes, cap = rng.random((n, 2)), int(rng.integers(1, n - 1))
        start = [pick_any if rng.random() < 0.5 else pick_home for _ in range(cap)]
        for completion in range(5):
            cut, free = (Oracle(nodes, m, 0.1, depot, reward, limit) for limit in (cap, None))
            opening, paid = np.random.default_rng([n, m]), 0.0
            for player in start:
                action = player(cut, opening)
                cut.step(action)
                free.step(action)
                paid += cut.reward
            assert cut.truncated and paid == pytest.approx(-cut.cost)
            while not free.done:
                free.step(PLAYERS[completion % 3](free, rng))
            assert free.cost <= cut.cost + 1e-9


@pytest.mark.parametrize(
    ("depot", "actions", "depot_is_legal", "ticks", "lengths"),
    [
        # All are at home, so one must leave; then agent 1 may wait, one tick at a time and for no distance.
        ("open", [1, 0, 0], [False, True, True], [0, 0, 1], [0.1, 0.0]),
        # Nobody goes home before its first city; agent 0 goes home for good; agent 1, the last one out, may not.
        ("final", [1, 2, 0, 3], [False, False, True, False], [0, 0, 10, 10], [0.2, 0.1 + 0.02**0.5]),
    ],
)
def test_the_depot_rules_by_hand(
    depot: str, actions: list[int], depot_is_legal: list[bool], ticks: list[int], lengths: list[float]
) -> None:
    """Two agents, four cities at ten ticks from the depot."""
    nodes = np.array([[0.5, 0.5], [0.5, 0.6], [0.5, 0.4], [0.6, 0.5], [0.4, 0.5]])
    game_rules = rules.make_rules(5, 2, 0.01, depot, "sparse", None)
    oracle, state = Oracle(nodes, 2, 0.01, depot), rules.start(Problem(2, {"nodes": nodes[None]}), game_rules)
    for action, legal, tick in zip(actions, depot_is_legal, ticks, strict=True):
        assert (
            rules.legal_actions(state, game_rules, rules.agent_to_decide(state))[0, 0]
            == oracle.legal_actions()[0]
            == legal
        )
        assert state.ready.min() == oracle.tick == tick
        oracle.step(action)
        state = rules.depart(state, game_rules, np.array([action]))
    assert state.own_time[0].tolist() == pytest.approx(lengths)


@pytest.mark.parametrize("speed", [0.1, 0.01])
@pytest.mark.parametrize("array", [np.array, torch.tensor], ids=["numpy", "torch"])
def test_whole_numbers_of_ticks(array: Callable, speed: float) -> None:
    whole = np.arange(1, 142)
    for shift, ticks in ((0.0, whole), (1e-13, whole), (-1e-13, whole), (1e-6, whole + 1), (speed - 1e-6, whole + 1)):
        assert np.array_equal(rules.travel_ticks(array(whole * speed + shift), speed), ticks)
    assert rules.travel_ticks(array([0.0, 1e-13, speed / 2]), speed).tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_nodes": 1}, "n_nodes must be a whole number of at least 2, got 1"),
        ({"n_agents": 0}, "n_agents must be a whole number of at least 1, got 0"),
        ({"n_agents": 2.0}, "n_agents must be a whole number"),
        ({"speed": 0.0}, "speed must be .* at least 1e-9, got 0.0"),
        ({"speed": float("nan")}, "speed must be"),
        ({"speed": float("inf")}, "speed must be"),
        ({"depot": "closed"}, r"unknown depot rule 'closed'; choose from \['open', 'wait', 'final'\]"),
        ({"reward": "dense"}, r"unknown reward 'dense'; choose from \['sparse', 'shaped'\]"),
        ({"max_decisions": 0}, "max_decisions must be a whole number of at least 1, got 0"),
        ({"view": 0}, "view must be a whole number of at least 1, got 0"),
        ({"hearing": -0.1}, "hearing must be a finite distance of at least 0, or None, got -0.1"),
        ({"hearing": float("nan")}, "hearing must be a finite distance of at least 0, or None, got nan"),
    ],
    ids=lambda x: "=".join(map(str, *x.items())) if isinstance(x, dict) else "",
)
def test_bad_rules(change: dict, message: str) -> None:
    good = {"n_nodes": 5, "n_agents": 2, "speed": 0.1, "depot": "open", "reward": "sparse", "max_decisions": None}
    assert rules.make_rules(**good).max_decisions == 20 * (5 + 2)
    with pytest.raises(ValueError, match=message):
        rules.make_rules(**(good | change))
