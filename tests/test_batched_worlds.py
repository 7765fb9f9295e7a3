"""The TorchRL environment in every scenario: TorchRL's own checks, auto-resets, replays, networks, compilation."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs, step_mdp

from dan_policy import load, rollout, solve
from mtsp_env import SCENARIOS, Instance, lower_bound, rules
from mtsp_env.batched import BatchedMTSP, random_legal_action
from mtsp_env.distributions import sample, service, team
from mtsp_env.instance import FIELDS, WORLD_FIELDS, Problem

OPTIONS = [{}, {"view": 3, "hearing": 0.4}]
in_every_scenario = pytest.mark.parametrize("scenario", SCENARIOS)


def make(scenario: str, batch: int = 6, n_nodes: int = 9, n_agents: int = 3, **kwargs: object) -> BatchedMTSP:
    return BatchedMTSP(n_nodes, n_agents, [batch], scenario=scenario, **{"seed": 0, "speed": 0.1, **kwargs})


def same(one: TensorDict, other: TensorDict) -> bool:
    return all(torch.equal(one[key], other[key]) for key in one.keys(True, True) if key in other.keys(True, True))


@in_every_scenario
@pytest.mark.parametrize("options", OPTIONS, ids=["all", "limited"])
def test_specs_hold(scenario: str, options: dict) -> None:
    for depot in ("open", "wait"):
        check_env_specs(make(scenario, depot=depot, **options), break_when_any_done="both")


@in_every_scenario
@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "wait"])
def test_auto_reset_never_offers_or_takes_an_illegal_action(scenario: str, depot: str) -> None:
    env = make(scenario, batch=500, n_nodes=8, depot=depot, view=3 if depot == "wait" else None)
    td, decisions, resets = env.reset(), 0, 0
    while decisions < 100_000:
        assert td["action_mask"].any(1).all()
        assert not (td["action_mask"] & td["visited"]).any()
        td = env.rand_action(td)
        assert td["action_mask"].gather(1, td["action"][:, None]).all()
        td, next_td = env.step_and_maybe_reset(td)
        resets += int(td["next", "done"].sum())
        td = next_td
        decisions += 500
    assert resets > 500


@in_every_scenario
def test_partial_resets_leave_other_rows_bit_identical(scenario: str) -> None:
    env = make(scenario)
    td = env.reset()
    for _ in range(5):
        td = step_mdp(env.step(env.rand_action(td)))
    before, reset = td.clone(), torch.tensor([True, False, False, True, False, False])
    after = env.reset(td.set("_reset", reset[:, None]), set_state=False)
    assert same(after[~reset], before[~reset].exclude("_reset"))
    assert (after["game", "decisions"][reset] == 0).all()
    assert not torch.equal(after["game", "nodes"][reset], before["game", "nodes"][reset])


@pytest.mark.parametrize("name", WORLD_FIELDS)
def test_agents_move_as_in_a_plain_game_if_a_field_has_its_usual_value(name: str) -> None:
    """They go home only if no city is left: in some worlds, waiting at the depot takes time that counts."""

    def usual(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
        sizes = [2 if size is None else size for size in FIELDS[name].sizes(n_nodes, n_agents)]
        return {name: np.full((batch, *sizes), FIELDS[name].usual)}

    plain, world = (make(scenario, depot="wait") for scenario in ("plain", usual))
    td, other = plain.reset(), world.reset()
    while not td["done"].all():
        assert torch.equal(td["action_mask"], other["action_mask"])
        mask = td["action_mask"].clone()
        mask[:, 0] &= ~mask[:, 1:].any(1)
        action = random_legal_action(mask)
        td, other = (env.step(at.set("action", action))["next"] for env, at in ((plain, td), (world, other)))
    assert torch.equal(td["game", "visits"], other["game", "visits"])
    assert torch.allclose(plain.makespan(), world.makespan(), rtol=1e-12)


@in_every_scenario
def test_games_go_on_from_any_saved_state(scenario: str) -> None:
    env = make(scenario, depot="wait")
    td = env.reset()
    for _ in range(6):
        td = step_mdp(env.step(env.rand_action(td)))
    resumed = make(scenario, seed=99, depot="wait").reset(td.select("game"), set_state=True)
    assert same(resumed, td.exclude("action"))


@pytest.mark.slow
@in_every_scenario
@pytest.mark.parametrize("name", ["default", "dan"])
def test_networks_that_know_no_worlds_play_in_each(scenario: str, name: str) -> None:
    """Their games end, and a batch's cost is that of its rows."""
    env = make(scenario, batch=4, n_nodes=12, depot="wait")
    episode = rollout(load(name), env, "greedy")
    assert episode.last["terminated"].all()
    assert torch.allclose(-episode.reward, env.makespan(episode.last).float())


@pytest.mark.parametrize("field", ["appears", "breaks", "traffic"])
def test_policies_plan_no_worlds_that_change(field: str) -> None:
    value = {"appears": [0.0, 0.5, 0.0], "breaks": [np.inf, 1.0], "traffic": [[1.0], [2.0]]}[field]
    world = Instance([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], 2, **{field: value})
    with pytest.raises(ValueError, match=rf"cannot be planned in advance in a world with \['{field}'\]"):
        solve(world)


@pytest.mark.slow
def test_policies_plan_for_teams_that_differ_and_visits_that_take_time() -> None:
    """The makespan is that of the same greedy game in the batched environment; improving never makes it worse."""
    env = BatchedMTSP(12, 3, [4], scenario=team_and_service, depot="final", seed=1)
    start = env.reset()
    game = {name: start["game", name].clone() for name in ("nodes", "speeds", "service")}
    episode = rollout(load("default"), env, "greedy", Problem(3, game))
    for row, makespan in enumerate(env.makespan(episode.last).tolist()):
        instance = Instance(n_agents=3, **{name: array[row].numpy() for name, array in game.items()})
        solution = solve(instance, "default", device="cpu")
        assert solution.makespan == pytest.approx(makespan, abs=1e-9)
        assert lower_bound(instance) <= solve(instance, "default", device="cpu", improve=0.01).makespan <= makespan


def test_more_agents_than_cities_differ_in_speed() -> None:
    instance = Instance([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], 4, speeds=[1.0, 2.0, 0.5, 3.0])
    tours = solve(instance, device="cpu").tours
    assert len(tours) == 4 and sorted(city for tour in tours for city in tour if city) == [1, 2]


def team_and_service(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    return team(rng, batch, n_nodes, n_agents) | service(rng, batch, n_nodes, n_agents)


@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "wait"])
def test_compiled_rules_play_the_same_games_in_a_world(depot: str) -> None:
    compiled, eager = make("everything", depot=depot, compile=True, view=4), make("everything", depot=depot, view=4)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "torch.compile failed")
        one, other = compiled.reset(), eager.reset()
        for _ in range(30):
            action = eager.rand_action(other)["action"]
            one, other = (
                compiled.step(one.set("action", action))["next"],
                eager.step(other.set("action", action))["next"],
            )
            for key in other.keys(True, True):
                torch.testing.assert_close(one[key], other[key], rtol=0, atol=1e-6)


def test_a_given_world_must_be_the_environments_own() -> None:
    env = make("everything")
    drawn = sample("uniform", np.random.default_rng(1), 6, 9, 3, "everything")
    arrays = {name: torch.tensor(array) for name, array in drawn.arrays.items()}
    td = env.reset(TensorDict({"game": arrays}, batch_size=[6]), set_state=True)
    assert all(torch.equal(td["game", name], array) for name, array in arrays.items())
    with pytest.raises(ValueError, match="plays instances with the world fields"):
        env.reset(TensorDict({"game": {"nodes": arrays["nodes"]}}, batch_size=[6]), set_state=True)
    with pytest.raises(ValueError, match="speeds must be above 0"):
        env.reset(TensorDict({"game": arrays | {"speeds": torch.zeros(6, 3)}}, batch_size=[6]), set_state=True)
    with pytest.raises(ValueError, match="cannot be played in a world with"):
        make("breakdowns", depot="final")


def test_the_keys_of_a_world_are_the_documented_ones() -> None:
    env = make("everything", view=2, hearing=0.5)
    td = env.reset()
    assert set(rules.OBSERVED) < set(td.keys())
    for name, field in rules.OBSERVED.items():
        assert td[name].shape == (6, *field.sizes(9, 3)) and td[name].dtype == getattr(torch, field.dtype)
