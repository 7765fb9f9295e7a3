"""Re-construction: tours stay valid, begin as driven and never get worse; what its parts do, each by itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.policies.nearest import nearest
from dan_policy import JointConfig, JointDAN, heuristics, planning, solve
from dan_policy.games import begin
from dan_policy.reconstruct import GAMES, _draw_team, _equivalent, _follow, _part, reconstruct
from mtsp_env import Instance, check_tours, makespan, rules, tour_lengths, uniform
from mtsp_env.tours import tour_times

SPEED = 0.01


def instance_of(rng, n_nodes, n_agents, world=False):
    instance = uniform(rng, n_nodes, n_agents)
    if not world:
        return instance
    service = np.append(0.0, rng.random(n_nodes - 1) / 10)
    return replace(instance, speeds=rng.uniform(0.5, 2.0, n_agents), service=service)


def poor_tours(rng, n_nodes, n_agents):
    """Random tours in which every agent visits a city."""
    cities = rng.permutation(np.arange(1, n_nodes))
    cuts = np.sort(rng.choice(np.arange(1, n_nodes - 1), n_agents - 1, replace=False))
    return [[0, *part.tolist(), 0] for part in np.split(cities, cuts)]


@settings(max_examples=40, deadline=None)
@given(st.integers(4, 12), st.integers(1, 4), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_tours_stay_valid_begin_as_driven_and_never_get_worse(n_nodes, n_agents, world, under_way, seed):
    rng = np.random.default_rng(seed)
    n_agents = min(n_agents, n_nodes - 2)
    instance, tours = instance_of(rng, n_nodes, n_agents, world), poor_tours(rng, n_nodes, n_agents)
    prefixes = [tour[: rng.integers(1, len(tour) + 1)] if under_way else [0] for tour in tours]
    better = reconstruct(instance, tours, nearest, SPEED, 6, rng, prefixes)
    check_tours(instance, better)
    assert makespan(instance, better) <= makespan(instance, tours)
    assert [tour[: len(prefix)] for tour, prefix in zip(better, prefixes, strict=True)] == prefixes


def test_poor_tours_get_much_better_and_nothing_else_changes():
    """Random tours become shorter than those of the policy alone; the argument stays as it was."""
    instance = uniform(np.random.default_rng(1), 20, 3)
    tours = poor_tours(np.random.default_rng(2), 20, 3)
    kept, before = [list(tour) for tour in tours], torch.get_rng_state()
    better = reconstruct(instance, tours, nearest, SPEED, 60, np.random.default_rng(3))
    assert makespan(instance, better) < 0.95 * solve(instance, nearest).makespan < 0.95 * makespan(instance, tours)
    assert tours == kept and torch.equal(torch.get_rng_state(), before)


def test_nothing_is_planned_if_the_last_agent_only_has_to_go_home():
    """The policy is never asked: neither for an agent on its way home, nor for one that is there."""
    instance = Instance(np.array([[0.0, 0.0], [1.0, 1.0], [0.2, 0.0], [0.3, 0.0]]), 2)
    tours = [[0, 1, 0], [0, 2, 3, 0]]
    for prefix in ([0, 1], [0, 1, 0]):
        assert reconstruct(instance, tours, _never, SPEED, 5, np.random.default_rng(0), [prefix, [0, 2]]) == tours
    with pytest.raises(AssertionError, match="asked"):
        reconstruct(instance, tours, _never, SPEED, 5, np.random.default_rng(0), [[0], [0, 2]])


def test_an_agent_that_stays_at_home_is_left_there():
    """By the rule "final" it would have to leave in the games, which its tour does not say."""
    instance, tours = uniform(np.random.default_rng(8), 9, 3), [[0, 1, 2, 3, 4, 0], [0, 5, 6, 7, 8, 0], [0, 0]]
    for seed in range(5):
        better = reconstruct(instance, tours, nearest, SPEED, 20, np.random.default_rng(seed))
        check_tours(instance, better)
        assert better[2] == [0, 0] and makespan(instance, better) < makespan(instance, tours)


def _never(cities, agents, visited):
    raise AssertionError("asked")


@settings(max_examples=40, deadline=None)
@given(st.integers(5, 12), st.integers(1, 4), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_equivalent_tours_have_the_same_makespan(n_nodes, n_agents, world, under_way, seed):
    rng = np.random.default_rng(seed)
    instance, tours = instance_of(rng, n_nodes, n_agents, world), poor_tours(rng, n_nodes, n_agents)
    prefixes = [tour[: rng.integers(1, len(tour))] if under_way else [0] for tour in tours]
    changed = _equivalent(tours, prefixes, not world, rng)
    check_tours(instance, changed)
    assert makespan(instance, changed) == pytest.approx(makespan(instance, tours), rel=1e-12)
    begun = [agent for agent, prefix in enumerate(prefixes) if len(prefix) > 1]
    assert [changed[agent] for agent in begun] == [tours[agent] for agent in begun]


def test_equivalent_tours_differ_in_direction_and_agents():
    tours = [[0, 1, 2, 0], [0, 3, 4, 0], [0, 5, 6, 0]]
    drawn = {str(_equivalent(tours, [[0]] * 3, True, np.random.default_rng(seed))) for seed in range(500)}
    assert len(drawn) == 6 * 8
    drawn = {str(_equivalent(tours, [[0]] * 3, False, np.random.default_rng(seed))) for seed in range(100)}
    assert len(drawn) == 8


@settings(max_examples=30, deadline=None)
@given(st.integers(5, 12), st.integers(1, 4), st.booleans(), st.booleans(), st.integers(0, 2**31))
def test_games_that_follow_tours_to_the_end_have_their_makespan(n_nodes, n_agents, world, on_tensors, seed):
    rng = np.random.default_rng(seed)
    instance = instance_of(rng, n_nodes, n_agents, world)
    rows = [poor_tours(rng, n_nodes, n_agents) for _ in range(3)]
    game = rules.make_rules(n_nodes, n_agents, SPEED, "final", "sparse", None)
    state = begin(instance, game, rows=3)
    if on_tensors:
        tensors = {name: torch.as_tensor(array) for name, array in state.arrays().items()}
        state = rules.state_from_arrays(tensors, n_agents)
    after = _follow(state, game, rows, n_nodes - 1 + n_agents)
    assert rules.terminated(after).all()
    assert np.asarray(rules.makespan(after)) == pytest.approx([makespan(instance, tours) for tours in rows], rel=1e-9)
    begun = _follow(state, game, rows, 1)
    first = [tours[0][1] for tours in rows]
    assert np.asarray(begun.visited).sum(1).tolist() == [1, 1, 1]
    assert np.asarray(begun.visited)[np.arange(3), first].all()


def test_a_part_has_the_same_times():
    rng = np.random.default_rng(4)
    instance = instance_of(rng, 9, 3, world=True)
    tours = [[0, 1, 2, 3, 0], [0, 4, 0], [0, 5, 6, 7, 8, 0]]
    part = _part(instance, [0, 5, 6, 7, 8, 1, 2, 3], [2, 0])
    assert (part.n_nodes, part.n_agents) == (8, 2)
    expected = tour_times(instance, tours)[[2, 0]]
    assert tour_times(part, [[0, 1, 2, 3, 4, 0], [0, 5, 6, 7, 0]]) == pytest.approx(expected, rel=1e-12)


def test_teams_are_of_agents_that_can_still_visit_cities_the_nearest_the_likeliest():
    nodes = np.array([[0.5, 0.5], [0.9, 0.9], [0.9, 0.8], [0.85, 0.85], [0.1, 0.1], [0.5, 0.1], [0.1, 0.5]])
    instance = Instance(nodes, 6)
    tours = [[0, 1, 0], [0, 2, 0], [0, 3, 0], [0, 4, 0], [0, 5, 0], [0, 6, 0]]
    begun = [[0], [0], [0], [0], [0, 5], [0, 6, 0]]
    teams = [_draw_team(instance, tours, begun, 0, np.random.default_rng(seed)) for seed in range(400)]
    assert all(team[0] == 0 and 5 not in team and len(set(team)) == len(team) for team in teams)
    assert {len(team) for team in teams} == {2, 3, 5}
    count = [sum(agent in team for team in teams if len(team) < 5) for agent in range(5)]
    assert min(count[1], count[2]) > 3 * max(count[3], count[4])


@pytest.mark.parametrize("world", [False, True])
def test_solve_reconstructs_from_its_best_game(world):
    """Never worse than without, the same again with the same seed, and named in the method."""
    torch.manual_seed(1)
    network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1)).eval()
    instance = instance_of(np.random.default_rng(5), 16, 3, world)
    plain = solve(instance, network, augment=True, device="cpu")
    better = solve(instance, network, augment=True, reconstruct=12, seed=3, device="cpu")
    assert better.makespan < plain.makespan
    assert (
        better.makespan == makespan(instance, better.tours) == pytest.approx(tour_times(instance, better.tours).max())
    )
    assert better.tours == solve(instance, network, augment=True, reconstruct=12, seed=3, device="cpu").tours
    assert better.method.endswith("(g.x8)+reconstruct(12)")
    prefixes = [tour[:3] for tour in plain.tours]
    under_way = solve(instance, network, prefixes=prefixes, reconstruct=4, device="cpu")
    assert [tour[:3] for tour in under_way.tours] == prefixes


def test_more_agents_than_cities_and_one_agent():
    network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1)).eval()
    for n_nodes, n_agents in ((4, 6), (2, 1), (9, 1)):
        instance = uniform(np.random.default_rng(6), n_nodes, n_agents)
        solution = solve(instance, network, reconstruct=3, device="cpu")
        check_tours(instance, solution.tours)
        assert solution.makespan <= solve(instance, network, device="cpu").makespan
    assert tour_lengths(instance, solution.tours).max() == solution.makespan


def test_rounds_have_the_precision_and_the_memory_of_their_games(monkeypatch):
    """One greedy game is too small for bfloat16 to pay, and sixteen are not."""
    monkeypatch.setattr(heuristics, "multiplies_bfloat16", lambda device: True)
    counted, seen = [], set()
    check = planning.check_memory
    monkeypatch.setattr(planning, "check_memory", lambda *given: counted.append(given[:2]) or check(*given))

    def network(cities, agents, visited):
        seen.add((len(visited), torch.is_autocast_enabled("cpu")))
        return nearest(cities, agents, visited)

    network.supports_bfloat16 = True
    instance = uniform(np.random.default_rng(9), 60, 2)
    solve(instance, network, device="cpu")
    assert seen == {(1, False)} and counted[-1] == ("samples", 1)
    solve(instance, network, reconstruct=2, device="cpu")
    assert seen == {(1, False), (GAMES, True)} and counted[-1] == ("samples", GAMES)
    solve(instance, network, decode="sample", samples=20, reconstruct=1, device="cpu")
    assert counted[-1] == ("samples", 20)


def test_bad_rounds_are_named():
    instance = uniform(np.random.default_rng(7), 5, 2)
    with pytest.raises(ValueError, match="reconstruct must be a whole number of at least 0, got -1"):
        solve(instance, nearest, reconstruct=-1)
    assert GAMES % 8 == 0, "all symmetries take part"
