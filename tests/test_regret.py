"""The regret in the last infos: measured against the reference solver, only if asked for, once per instance."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from helpers.games import over, play, random_action

import mtsp_env
from mtsp_env import Instance, lower_bound, mtsp_v0, uniform


@pytest.fixture
def searches(monkeypatch: pytest.MonkeyPatch) -> list[Instance]:
    """The instances that the reference solver has been called with."""
    reference, solved = pytest.importorskip("mtsp_env.reference", reason="needs the extra reference"), []
    improve = reference.improve
    monkeypatch.setattr(reference, "improve", lambda instance: solved.append(instance) or improve(instance))
    mtsp_v0._reference_makespan.cache_clear()
    return solved


@pytest.mark.parametrize("depot", ["open", "final"])
@pytest.mark.parametrize("max_decisions", [None, 4])
def test_regret_compares_the_return_with_the_reference(searches: list, depot: str, max_decisions: int | None) -> None:
    env = mtsp_v0.env(n_nodes=8, n_agents=2, depot=depot, max_decisions=max_decisions, reference=True)
    for seed in range(3):
        env.reset(seed=seed)
        rewards = play(env)[-1][3]
        instance = env.unwrapped.instance
        for agent in env.agents:
            info = env.infos[agent]
            assert lower_bound(instance) <= info["reference_makespan"] <= info["makespan"] + 1e-9
            assert info["regret"] == pytest.approx(-rewards[agent] / info["reference_makespan"] - 1.0)
            assert info["regret"] >= -1e-9


@pytest.mark.parametrize("depot", ["open", "final"])
def test_following_the_reference_gives_no_regret(searches: list, depot: str) -> None:
    from mtsp_env.reference import improve

    instance = uniform(np.random.default_rng(1), 12, 3)
    plans = {f"agent_{i}": iter(tour[1:]) for i, tour in enumerate(improve(instance))}
    env = mtsp_v0.env(n_nodes=12, n_agents=3, depot=depot, reference=True)
    env.reset(options={"instance": instance})
    while not over(env):
        env.step(next(plans[env.agent_selection], 0))
    assert [info["regret"] for info in env.infos.values()] == pytest.approx([0.0] * 3)


def test_the_reference_is_solved_at_the_end_once_for_each_instance(searches: list) -> None:
    env, instance = mtsp_v0.env(n_nodes=6, n_agents=2, reference=True), uniform(np.random.default_rng(2), 6, 2)
    env.reset(seed=0)
    env.step(random_action(env, np.random.default_rng(0)))
    env.reset(options={"instance": instance})
    assert searches == [] and env.infos == {"agent_0": {}, "agent_1": {}}
    play(env)
    makespans = [info["reference_makespan"] for info in env.infos.values()]
    other = mtsp_v0.env(n_nodes=6, n_agents=2, reference=True)
    other.reset(options={"instance": instance})
    play(other, seed=1)
    assert searches == [instance]
    assert [info["reference_makespan"] for info in other.infos.values()] == makespans
    env.reset(seed=0)
    play(env)
    assert len(searches) == 2


def test_by_default_no_regret_is_measured(searches: list) -> None:
    env = mtsp_v0.env(n_nodes=6, n_agents=2)
    env.reset(seed=0)
    play(env)
    assert searches == []
    assert [set(info) for info in env.infos.values()] == [{"makespan"}] * 2


def test_tours_of_length_zero_have_no_regret(searches: list) -> None:
    env = mtsp_v0.env(n_nodes=4, n_agents=2, reference=True)
    env.reset(options={"instance": Instance([[0.5, 0.5]] * 4, 2)})
    play(env)
    assert [(info["reference_makespan"], info["regret"]) for info in env.infos.values()] == [(0.0, 0.0)] * 2


def test_without_numba_creation_fails_and_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(mtsp_env, "reference", raising=False)
    monkeypatch.delitem(sys.modules, "mtsp_env.reference", raising=False)
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'mtsp-env\[reference\]'"):
        mtsp_v0.env(reference=True)


@pytest.mark.parametrize("scenario", ["team", "service"])
def test_regret_in_worlds_that_do_not_change(searches: list, scenario: str) -> None:
    env = mtsp_v0.env(n_nodes=7, n_agents=2, scenario=scenario, reference=True)
    for seed in range(3):
        env.reset(seed=seed)
        play(env)
        info, instance = env.infos["agent_0"], env.unwrapped.instance
        assert instance.world and searches[-1] == instance
        assert lower_bound(instance) <= info["reference_makespan"] <= info["makespan"] + 1e-9
        assert info["regret"] == pytest.approx(info["makespan"] / info["reference_makespan"] - 1.0)
