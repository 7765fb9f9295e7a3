"""The reference solver with agents under way: it finds the best completions and keeps the given beginnings."""

import numpy as np
import pytest
import torch
from helpers.completions import least_makespan, teams_under_way
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, makespan, rules
from mtsp_env.batched import BatchedMTSP
from mtsp_env.tours import path_lengths

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import improve, improve_batch


@pytest.mark.slow
@given(teams_under_way(), st.integers(0, 400), st.booleans())
@settings(max_examples=200, deadline=None)
def test_tours_begin_with_the_prefixes_and_are_never_made_worse(case: tuple, iterations: int, start: bool) -> None:
    instance, prefixes, tours = case
    improved = improve(instance, tours if start else None, iterations=iterations, prefixes=prefixes)
    check_tours(instance, improved)
    for prefix, tour in zip(prefixes, improved, strict=True):
        assert tour[: len(prefix)] == prefix
        assert tour == prefix or len(prefix) == 1 or prefix[-1] != 0  # closed tours stay as they are
    if start:
        assert makespan(instance, improved) <= makespan(instance, tours)


@given(teams_under_way(max_nodes=7))
@settings(max_examples=60, deadline=None)
@pytest.mark.slow
def test_small_instances_are_completed_optimally(case: tuple) -> None:
    instance, prefixes, _ = case
    tours = improve(instance, iterations=2000, prefixes=prefixes)
    assert makespan(instance, tours) == pytest.approx(least_makespan(instance, prefixes), abs=1e-9)


@pytest.mark.parametrize("tidy", [False, True])
def test_prefixes_of_agents_at_the_depot_change_nothing(tidy: bool) -> None:
    nodes = np.random.default_rng(0).random((3, 30, 2))
    without = improve_batch(nodes, 4, 500, tidy=tidy)
    assert improve_batch(nodes, 4, 500, tidy=tidy, prefixes=[[[0]] * 4] * 3) == without


@pytest.mark.slow
def test_a_plan_with_a_fixed_beginning_is_completed_near_optimally() -> None:
    """n = 60, m = 4: with the first third of near-optimal tours as prefixes, the makespan is within 1 % of theirs."""
    instance = Instance(np.random.default_rng(1).random((60, 2)), 4)
    plan = improve(instance, iterations=30_000)
    prefixes = [tour[: len(tour) // 3] for tour in plan]
    again = improve(instance, iterations=10_000, prefixes=prefixes)
    assert makespan(instance, again) <= 1.01 * makespan(instance, plan)
    with pytest.raises(ValueError, match="tour 0 must begin with its prefix"):
        improve(instance, plan, prefixes=[list(reversed(plan[0]))[:3], *prefixes[1:]])


@pytest.mark.slow
def test_games_can_be_completed_from_any_decision() -> None:
    """The open tours of a game, ``rules.tours(..., close=False)``, are valid prefixes."""
    env = BatchedMTSP(12, 3, [16], 0.1, depot="final", seed=0)
    torch.manual_seed(0)
    td = env.reset()
    nodes = td["game", "nodes"].numpy()
    for _ in range(14):
        states = zip(td["game", "visits"].numpy(), td["game", "destination"].numpy(), strict=True)
        prefixes = [rules.tours(*state, close=False) for state in states]
        completed = improve_batch(nodes, 3, 100, prefixes=prefixes)
        for row, tours, open_tours in zip(nodes, completed, prefixes, strict=True):
            check_tours(Instance(row, 3), tours)
            assert all(tour[: len(prefix)] == prefix for tour, prefix in zip(tours, open_tours, strict=True))
        td = env.step(env.rand_action(td))["next"]
    driven = path_lengths(nodes[0], prefixes[0])
    assert (driven > 0).all()


@pytest.mark.parametrize(
    ("prefixes", "message"),
    [
        ([[0]], "expected 2 prefixes, one per agent, got 1"),
        ([[0], []], r"prefix 1 must begin at the depot 0, got \[\]"),
        ([[0], [3]], r"prefix 1 must begin at the depot 0, got \[3\]"),
        ([[0], [0, 7]], r"prefix 1 visits node 7, outside 0\.\.6"),
        ([[0, 2], [0, 2]], "city 2 is in the prefixes more than once"),
        ([[0, 2, 0, 3], [0]], r"prefix 0 must not pass the depot in the middle, got \[0, 2, 0, 3\]"),
        ([[0, 2, 0], [0, 3, 0]], "all agents are home for good, and 4 cities are left"),
    ],
)
def test_invalid_prefixes_are_refused(square: Instance, prefixes: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        improve(square, prefixes=prefixes)
    with pytest.raises(ValueError, match=message):
        improve_batch(square.nodes[None], 2, prefixes=[prefixes])
    with pytest.raises(ValueError, match="expected prefixes for 1 instances, got 2"):
        improve_batch(square.nodes[None], 2, prefixes=[[[0], [0]]] * 2)
