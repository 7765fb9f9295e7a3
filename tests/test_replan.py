"""A team that is under way is replanned from its current state, as if the plan had never been interrupted."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from benchmarks.policies.nearest import nearest
from dan_policy import solve
from dan_policy.games import begin
from dan_policy.planning import SPEED
from mtsp_env import Instance, check_tours, rules, uniform
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Tours


def moments(instance: Instance, seed: int, depot: str = "final") -> list[tuple[rules.State, Tours]]:
    """Every state of a random game but the last, and the tours so far."""
    env = BatchedMTSP(instance.n_nodes, instance.n_agents, [1], SPEED, depot=depot)
    torch.manual_seed(seed)
    nodes = torch.tensor(instance.nodes)[None]
    td = env.reset(TensorDict({"game": TensorDict({"nodes": nodes}, [1])}, [1]), set_state=True)
    moments = []
    while not td["done"].item():
        arrays = {name: tensor.numpy() for name, tensor in td["game"].items()}
        tours = rules.tours(arrays["visits"][0], arrays["destination"][0], close=False)
        moments.append((rules.state_from_arrays(arrays, instance.n_agents), tours))
        td = env.step(env.rand_action(td))["next"]
    return moments


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(2, 12), st.integers(1, 5))
@settings(max_examples=60, deadline=None)
def test_prefixes_lead_to_the_moment_at_which_they_were_taken(seed: int, n_nodes: int, n_agents: int) -> None:
    instance = uniform(np.random.default_rng(seed), n_nodes, n_agents)
    game = rules.make_rules(n_nodes, n_agents, SPEED, "final", "sparse", None)
    for state, prefixes in moments(instance, seed):
        again = begin(instance, game, prefixes).arrays()
        for name, array in state.arrays().items():
            np.testing.assert_allclose(again[name], array, rtol=0, atol=1e-12, err_msg=name)


def test_games_side_by_side_begin_at_the_same_moment() -> None:
    """Also in the symmetries of the square, which preserve every length."""
    instance = uniform(np.random.default_rng(1), 9, 3)
    game = rules.make_rules(9, 3, SPEED, "final", "sparse", None)
    prefixes = [[0, 4, 2], [0], [0, 1]]
    alone = begin(instance, game, prefixes).arrays()
    for augment in (False, True):
        many = begin(instance, game, prefixes, 11, augment).arrays()
        for name in ("visits", "destination", "ready", "departed", "leg", "own_time"):
            np.testing.assert_allclose(many[name], np.repeat(alone[name], 11, axis=0), rtol=0, atol=1e-12)
        distinct = {nodes.round(6).tobytes() for nodes in many["nodes"]}
        assert len(distinct) == (8 if augment else 1)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["default", nearest], ids=["DAN", "nearest"])
def test_replanning_continues_the_same_plan(policy) -> None:
    """Greedy decisions depend on the current state alone, so replanning from any moment gives the same plan."""
    instance = uniform(np.random.default_rng(5), 20, 3)
    plan = solve(instance, policy)
    played = np.concatenate([np.array(tour[1:-1]) for tour in plan.tours])
    assert sorted(played) == list(range(1, 20))
    state = begin(instance, rules.make_rules(20, 3, SPEED, "final", "sparse", None), [t[:-1] for t in plan.tours])
    order = np.argsort(state.visits[0, 1:]) + 1  # the cities in the order of decisions
    for done in range(20):
        visited = set(order[:done].tolist())
        prefixes = [[0, *(city for city in tour[1:-1] if city in visited)] for tour in plan.tours]
        assert solve(instance, policy, prefixes=prefixes).tours == plan.tours


@pytest.mark.parametrize("options", [{"augment": True}, {"decode": "sample", "samples": 5}, {"improve": 0.02}])
def test_all_kinds_of_plans_keep_the_prefixes(options: dict) -> None:
    if "improve" in options:
        pytest.importorskip("numba", reason="needs the extra reference")
    instance = uniform(np.random.default_rng(6), 30, 4)
    prefixes = [[0, 7, 3], [0], [0, 9, 0], [0, 1]]
    solution = solve(instance, prefixes=prefixes, **options)
    check_tours(instance, solution.tours)
    assert all(tour[: len(prefix)] == prefix for tour, prefix in zip(solution.tours, prefixes, strict=True))
    assert solution.tours[2] == [0, 9, 0]


def test_nothing_left_to_plan() -> None:
    instance = uniform(np.random.default_rng(7), 5, 2)
    assert solve(instance, prefixes=[[0, 1, 2], [0, 3, 4, 0]]).tours == [[0, 1, 2, 0], [0, 3, 4, 0]]
    with pytest.raises(ValueError, match="expected 2 prefixes, one per agent, got 1"):
        solve(instance, prefixes=[[0]])
