"""The central planner: it follows the reference solver's plan, plans again at events, and does not see the future."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers.future import long_everything, long_traffic, other_future
from pettingzoo import AECEnv
from tensordict import TensorDict

from mtsp_env import SCENARIOS, Instance, check_log, makespan, mtsp_v0
from mtsp_env.batched import BatchedMTSP
from mtsp_env.distributions import Generator, breakdowns, service

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import improve, improve_batch
from mtsp_env.replan import Replanner

CHANGING = ["appears", "breaks"]
Decision = tuple[int, str, int]  # tick, agent, node


def play(env: AECEnv, policy, seed: int | None = None, instance: Instance | None = None) -> list[Decision]:
    """Play a game to its end, and check its log; an illegal action raises ValueError."""
    env.reset(seed=seed, options=None if instance is None else {"instance": instance})
    decisions = []
    while not any(env.terminations.values()):
        assert not any(env.truncations.values())
        tick, agent, node = env.unwrapped.now, env.agent_selection, policy(env)
        decisions.append((tick, agent, node))
        env.step(node)
    judged = check_log(env.unwrapped.instance, env.unwrapped.log, env.unwrapped.rules.speed)
    assert judged == pytest.approx(env.unwrapped.infos["agent_0"]["makespan"], abs=1e-6)
    return decisions


def nearest(env: AECEnv) -> int:
    """The nearest legal city, or the depot if there is none."""
    seen = env.observe(env.agent_selection)
    distance = np.hypot(*seen["observation"]["cities"].T)
    distance = np.where(seen["action_mask"], distance, np.inf)
    distance[0] = 1e9
    return int(np.argmin(distance))


def last_makespan(env: AECEnv) -> float:
    return env.unwrapped.infos["agent_0"]["makespan"]


# Plans


@pytest.mark.parametrize("depot", ["open", "wait", "final"])
@pytest.mark.slow
def test_in_a_plain_world_it_follows_the_reference_solver(depot: str) -> None:
    """With ample iterations, bit for bit; the plan is made once and within 1 % of the best makespan."""
    env = mtsp_v0.env(n_nodes=20, n_agents=3, depot=depot)
    for seed in range(5):
        replanner = Replanner(iterations=20_000)
        play(env, replanner, seed)
        instance = env.unwrapped.instance
        (planned,) = improve_batch(instance.nodes[None], 3, 20_000, tidy=True, prefixes=[[[0]] * 3])
        assert env.unwrapped.tours == planned
        assert replanner.plans == 1
        assert last_makespan(env) == pytest.approx(makespan(instance, planned), abs=1e-9)
        assert last_makespan(env) <= 1.01 * makespan(instance, improve(instance, iterations=20_000))


@pytest.mark.parametrize("scenario", ["team", "service"])
def test_where_nothing_happens_it_plans_once(scenario: str) -> None:
    env = mtsp_v0.env(n_nodes=20, n_agents=3, scenario=scenario)
    replanner = Replanner(iterations=20_000)
    play(env, replanner, seed=1)
    assert replanner.plans == 1
    best = makespan(env.unwrapped.instance, improve(env.unwrapped.instance, iterations=20_000))
    assert last_makespan(env) <= 1.01 * best


@pytest.mark.parametrize(("factor", "late"), [(0.9, False), (1.5, True)])
def test_it_plans_again_when_an_agent_is_late_but_not_when_it_is_early(factor: float, late: bool) -> None:
    env = mtsp_v0.env(
        n_nodes=15, n_agents=3, scenario=lambda rng, batch, n, m: {"traffic": np.full((batch, m, 1), factor)}
    )
    replanner = Replanner(iterations=200)
    decisions = play(env, replanner, seed=2)
    on_the_way = [tick for tick, _, _ in decisions if tick > 0]
    assert replanner.plans == (1 + len(on_the_way) if late else 1)


def test_it_plans_again_when_cities_appear() -> None:
    """By hand: two cities appear at once, later one more; each time it plans once."""
    nodes = [[0.0, 0.0], [0.5, 0.0], [1.0, 0.0], [0.9, 0.1], [0.6, 0.0]]
    env = mtsp_v0.env(n_nodes=5, n_agents=1, scenario="arrivals", depot="wait")
    replanner = Replanner(iterations=200)
    play(env, replanner, instance=Instance(nodes, 1, appears=[0.0, 0.0, 0.2, 0.2, 0.9]))
    assert env.unwrapped.tours in ([[0, 1, 3, 2, 4, 0]], [[0, 1, 2, 3, 4, 0]])
    assert replanner.plans == 3


def test_others_take_over_the_cities_of_a_broken_agent() -> None:
    """By hand: agent 0 breaks on its way to the first of two cities on its side; agent 1 visits all four."""
    nodes = [[0.5, 0.5], [0.7, 0.5], [0.9, 0.5], [0.3, 0.5], [0.1, 0.5]]
    for broken in range(2):
        breaks = [np.inf, np.inf]
        breaks[broken] = 0.15
        env = mtsp_v0.env(n_nodes=5, n_agents=2, scenario="breakdowns", depot="wait")
        replanner = Replanner(iterations=500)
        play(env, replanner, instance=Instance(nodes, 2, breaks=breaks))
        assert sorted(env.unwrapped.tours[1 - broken]) == [0, 0, 1, 2, 3, 4]
        assert env.unwrapped.tours[broken] == [0]
        assert replanner.plans == 2
        assert last_makespan(env) == pytest.approx(1.6)  # to the end of its own side, to the other end, home


def test_an_agent_that_breaks_down_at_a_city_has_visited_it() -> None:
    """By hand: it breaks during its first visit: no city is open again, but the rest of its tour needs a driver."""
    nodes = [[0.5, 0.5], [0.7, 0.5], [0.9, 0.5], [0.3, 0.5], [0.1, 0.5]]
    for broken in range(2):
        breaks, visits = [np.inf, np.inf], [0.0, 0.2, 0.2, 0.2, 0.2]
        breaks[broken] = 0.3
        env = mtsp_v0.env(n_nodes=5, n_agents=2, scenario=service_and_breakdowns, depot="wait")
        play(env, Replanner(iterations=500), instance=Instance(nodes, 2, breaks=breaks, service=visits))
        assert [len(tour) for tour in env.unwrapped.tours][broken] == 2
        assert len(env.unwrapped.tours[1 - broken]) == 5


def service_and_breakdowns(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    return service(rng, batch, n_nodes, n_agents) | breakdowns(rng, batch, n_nodes, n_agents)


# Games


@pytest.mark.parametrize("depot", ["open", "wait"])
@pytest.mark.parametrize("scenario", SCENARIOS)
@pytest.mark.slow
def test_it_beats_the_nearest_city_in_every_scenario(scenario: str, depot: str) -> None:
    """Mean makespan of 30 games, seeds 0 to 29, all of them played to the end."""
    env = mtsp_v0.env(n_nodes=20, n_agents=3, scenario=scenario, depot=depot)
    replanner, makespans = Replanner(iterations=500), {"replanner": [], "nearest": []}
    for name, policy in (("replanner", replanner), ("nearest", nearest)):
        for seed in range(30):
            play(env, policy, seed)
            makespans[name].append(last_makespan(env))
    assert np.mean(makespans["replanner"]) < 0.95 * np.mean(makespans["nearest"])


@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "wait", "final"])
@pytest.mark.parametrize(("n_nodes", "n_agents"), [(2, 1), (2, 4), (3, 6), (6, 2), (7, 7)])
def test_odd_sizes_are_played_to_the_end(n_nodes: int, n_agents: int, depot: str) -> None:
    for scenario, generate in SCENARIOS.items():
        if depot == "final" and not generate(np.random.default_rng(0), 1, n_nodes, n_agents).keys().isdisjoint(
            CHANGING
        ):
            continue
        env = mtsp_v0.env(n_nodes=n_nodes, n_agents=n_agents, scenario=scenario, depot=depot, speed=0.1)
        replanner = Replanner(iterations=20)
        for seed in range(4):
            play(env, replanner, seed)


@pytest.mark.slow
def test_it_takes_over_a_game_from_others() -> None:
    """It may come in at any moment, and others may decide in between."""
    env, rng = mtsp_v0.env(n_nodes=15, n_agents=3, scenario="everything", depot="wait"), np.random.default_rng(0)
    replanner = Replanner(iterations=50)
    for seed in range(10):
        play(env, lambda env: replanner(env) if rng.random() < 0.5 else nearest(env), seed)


def test_games_do_not_depend_on_those_before() -> None:
    env, used = mtsp_v0.env(n_nodes=15, n_agents=3, scenario="everything", depot="wait"), Replanner(iterations=100)
    play(env, used, seed=5)
    for seed in (6, 5):
        assert play(env, used, seed) == play(env, Replanner(iterations=100), seed)


def test_milliseconds_limit_the_search() -> None:
    env = mtsp_v0.env(n_nodes=20, n_agents=3, scenario="arrivals", depot="wait")
    replanner = Replanner(milliseconds=2)
    play(env, replanner, seed=0)
    assert replanner.plans > 1


# The future


@pytest.mark.parametrize("scenario", [long_everything, long_traffic])
@pytest.mark.slow
def test_decisions_do_not_depend_on_the_future(scenario: Generator) -> None:
    """Until the moment from which the future differs, the decisions are the same; then some of them differ."""
    differ = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        env = mtsp_v0.env(n_nodes=16, n_agents=3, scenario=scenario, depot="wait")
        decisions = play(env, Replanner(iterations=150), seed)
        instance, speed = env.unwrapped.instance, env.unwrapped.rules.speed
        change = int(rng.integers(1, decisions[-1][0])) * speed
        other = other_future(instance, env.unwrapped.log, change, rng)
        again = play(env, Replanner(iterations=150), instance=other)
        before = [decision for decision in decisions if decision[0] * speed <= change]
        assert [decision for decision in again if decision[0] * speed <= change] == before
        differ += again != decisions
    assert differ > 10


# The batched environment


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_batches_are_played_as_single_games(scenario: str) -> None:
    env = BatchedMTSP(12, 3, [4], scenario=scenario, depot="wait", seed=3)
    replanner = Replanner(iterations=100)
    policy = replanner.policy(env)
    start = td = env.reset()
    while not td["done"].all():
        td = env.step(policy(td))["next"]
    single = mtsp_v0.env(n_nodes=12, n_agents=3, scenario=scenario, depot="wait")
    for row, tours in enumerate(env.tours(td)):
        world = {name: start["game", name][row].numpy() for name in single.unwrapped.world}
        play(single, Replanner(iterations=100), instance=Instance(start["game", "nodes"][row].numpy(), 3, **world))
        assert single.unwrapped.tours == tours
        assert last_makespan(single) == pytest.approx(env.makespan(td)[row].item(), abs=1e-12)


@pytest.mark.slow
def test_it_is_a_policy_for_rollouts_that_reset_themselves() -> None:
    env = BatchedMTSP(8, 2, [3], scenario="everything", depot="wait", seed=0)
    steps = env.rollout(60, Replanner(iterations=20).policy(env), break_when_any_done=False)
    assert steps["next", "terminated"].sum() >= 3
    assert not steps["next", "truncated"].any()


def test_rows_go_on_from_any_state() -> None:
    env = BatchedMTSP(10, 2, [2], scenario="arrivals", depot="wait", seed=0)
    torch.manual_seed(0)
    td = env.reset()
    for _ in range(4):
        td = env.step(env.rand_action(td))["next"]
    given = TensorDict({"game": td["game"]}, [2])
    policy, td = Replanner(iterations=20).policy(env), env.reset(given, set_state=True)
    while not td["done"].all():
        td = env.step(policy(td))["next"]
    assert td["terminated"].all()


# Bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "a Replanner needs milliseconds or iterations"),
        ({"milliseconds": 0}, "milliseconds must be a finite number of milliseconds above 0, got 0"),
        ({"milliseconds": float("nan")}, "milliseconds must be a finite number of milliseconds above 0, got nan"),
        ({"iterations": -1}, "iterations must be a whole number of at least 0, got -1"),
        ({"iterations": 1, "seed": 0.5}, "seed must be a whole number of at least 0, got 0.5"),
    ],
)
def test_bad_arguments_are_named(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Replanner(**arguments)


@pytest.mark.parametrize("options", [{"view": 3}, {"hearing": 0.5}])
def test_it_refuses_to_play_what_it_cannot_know(options: dict) -> None:
    env = mtsp_v0.env(n_nodes=6, n_agents=2, **options)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="a central planner must know every city and agent"):
        Replanner(iterations=1)(env)
    with pytest.raises(ValueError, match="a central planner must know every city and agent"):
        Replanner(iterations=1).policy(BatchedMTSP(6, 2, [1], **options))
