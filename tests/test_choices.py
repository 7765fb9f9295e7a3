"""The reference solver on single decisions: the best tours for each node to which an agent could go next."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.completions import choices_of, decided, least_makespan, teams_under_way
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import Instance, check_tours, lower_bound, makespan
from mtsp_env.instance import Tours
from mtsp_env.tours import is_closed

pytest.importorskip("numba", reason="needs the extra reference")
from mtsp_env.reference import improve, tours_after


@st.composite
def decisions(draw: st.DrawFn, max_nodes: int = 12) -> tuple[Instance, Tours, Tours, int]:
    """An instance, prefixes, tours that begin with them, and an agent that is not home for good."""
    instance, prefixes, tours = draw(teams_under_way(max_nodes))
    out = [agent for agent, prefix in enumerate(prefixes) if not is_closed(prefix)]
    if not out:
        prefixes, out = [[0] for _ in prefixes], list(range(len(prefixes)))
    return instance, prefixes, tours, draw(st.sampled_from(out))


@pytest.mark.slow
@given(decisions(), st.none() | st.integers(0, 100))
@settings(max_examples=200, deadline=None)
def test_tours_begin_with_the_decision_and_solve_the_instance(case: tuple, iterations: int | None) -> None:
    instance, prefixes, tours, agent = case
    nodes = choices_of(instance, prefixes, agent)
    before = [list(tour) for tour in tours]
    after = tours_after(instance, prefixes, agent, nodes, tours, iterations)
    for node, solution in zip(nodes, after, strict=True):
        check_tours(instance, solution)
        for tour, prefix in zip(solution, decided(prefixes, agent, node), strict=True):
            assert tour[: len(prefix)] == prefix
            assert not is_closed(prefix) or tour == prefix
    planned = tours[agent][len(prefixes[agent])]
    if planned in nodes:
        assert after[nodes.index(planned)] == tours
    assert tours == before


@pytest.mark.slow
@given(decisions(max_nodes=6))
@settings(max_examples=60, deadline=None)
def test_the_costs_of_small_decisions_are_exact(case: tuple) -> None:
    instance, prefixes, _, agent = case
    nodes = choices_of(instance, prefixes, agent)
    tours = improve(instance, iterations=2000, prefixes=prefixes)
    for node, after in zip(nodes, tours_after(instance, prefixes, agent, nodes, tours, 2000), strict=True):
        best = least_makespan(instance, decided(prefixes, agent, node))
        if tours[agent][: len(prefixes[agent]) + 1] == [*prefixes[agent], node]:
            best = makespan(instance, tours)  # the given tours, as good as they are
        assert makespan(instance, after) == pytest.approx(best, abs=1e-9)


def test_visits_to_the_depot_in_the_middle_are_left_out() -> None:
    """To go home is for good, so tours that pass the depot do not lead to it."""
    instance = Instance([(0, 0), (1, 0), (0, 1), (1, 1)], 2)
    city, home = tours_after(instance, [[0, 1], [0]], 0, [3, 0], [[0, 1, 0, 3, 0], [0, 2, 0]])
    assert city == [[0, 1, 3, 0], [0, 2, 0]]
    assert home[0] == [0, 1, 0] and set(home[1]) == {0, 2, 3}


def test_at_the_depot_directions_and_agents_are_alike() -> None:
    """A tour can begin at its other end, and two agents that have not left can exchange theirs, at no cost."""
    rng = np.random.default_rng(0)
    for seed in range(5):
        instance = Instance(rng.random((30, 2)), 3)
        tours = improve(instance, seed=seed)
        ends = [node for tour in tours for node in (tour[1], tour[-2])]
        for after in tours_after(instance, [[0]] * 3, 0, ends, tours, iterations=0):
            assert makespan(instance, after) <= makespan(instance, tours) + 1e-12


def test_a_search_ends_once_the_decision_costs_nothing() -> None:
    """The search for the tour that begins at its other end could go on for hours."""
    instance = Instance(np.random.default_rng(0).random((30, 2)), 3)
    tours = improve(instance)
    assert makespan(instance, tours) > 1.01 * lower_bound(instance)  # where every search would end
    (after,) = tours_after(instance, [[0]] * 3, 0, [tours[0][-2]], tours, iterations=10**10)
    assert makespan(instance, after) == pytest.approx(makespan(instance, tours))


def test_repaired_tours_are_nearly_as_good_as_those_of_a_long_search() -> None:
    rng = np.random.default_rng(1)
    excess = []
    for _ in range(4):
        instance = Instance(rng.random((50, 2)), 5)
        tours = improve(instance)
        prefixes = [tour[:4] for tour in tours]
        distance = np.linalg.norm(instance.nodes - instance.nodes[prefixes[0][-1]], axis=1)
        nodes = sorted(choices_of(instance, prefixes, 0)[:-1], key=lambda node: distance[node])[:4]
        for node, after in zip(nodes, tours_after(instance, prefixes, 0, nodes, tours), strict=True):
            long = improve(instance, iterations=20_000, prefixes=decided(prefixes, 0, node))
            excess.append(makespan(instance, after) / makespan(instance, long) - 1.0)
    assert np.mean(excess) <= 0.005


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"agent": 2}, "agent must be one of 0..1 that is not home for good, got 2"),
        ({"agent": -1}, "agent must be .* got -1"),
        ({"agent": 1, "prefixes": [[0, 1], [0, 2, 0]], "tours": [[0, 1, 3, 0], [0, 2, 0]]}, "not home for good, got 1"),
        ({"nodes": [1]}, "agent 0 must go to an unvisited city, or home if others are out, got 1"),
        ({"nodes": [4]}, "got 4"),
        (
            {"nodes": [0], "prefixes": [[0, 1], [0, 2, 0]], "tours": [[0, 1, 3, 0], [0, 2, 0]]},
            "or home if others are out",
        ),
        ({"tours": [[0, 3, 1, 0], [0, 2, 0]]}, r"tour 0 must begin with its prefix \[0, 1\]"),
        ({"tours": [[0, 1, 0], [0, 2, 0]]}, "city 3"),
        ({"iterations": -1}, "iterations must be .* got -1"),
        ({"seed": -1}, "seed must be .* got -1"),
        (
            {"instance": Instance([(0, 0), (1, 0), (0, 1), (1, 1)], 2, service=[0, 1, 1, 1])},
            r"plain problems only.*service",
        ),
    ],
)
def test_bad_input_is_refused(change: dict, message: str) -> None:
    instance = Instance([(0, 0), (1, 0), (0, 1), (1, 1)], 2)
    given_ = {
        "instance": instance,
        "prefixes": [[0, 1], [0]],
        "agent": 0,
        "nodes": [3],
        "tours": [[0, 1, 3, 0], [0, 2, 0]],
    }
    with pytest.raises(ValueError, match=message):
        tours_after(**(given_ | change))
