"""The teacher in worlds: its labels in cases solved by hand, in canonical form, from any state of a student."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.states import same
from tensordict import TensorDict
from tiny import TINY_PLANS, interrupt_after

from dan_policy import make_actor, save
from dan_policy.joint import READABLE, JointDAN
from mtsp_env import SCENARIOS, rules
from mtsp_env.instance import Problem
from train import checkpoint
from train.buffer import Buffer
from train.collect import draw, environment
from train.demonstrations import demonstrate
from train.imitate import ImitationLearner, imitate
from train.lessons import Lessons, canonical_routes, roll_in, teach
from train.network import observation_keys
from train.supervised import imitation_losses
from train.supervised_config import ImitateConfig, ImproveConfig

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

KEYS = ("cities", "agents", "visited", "agent", "action_mask")
WORLDS = tuple(name for name in SCENARIOS if name != "plain")
TINY = replace(
    TINY_PLANS,
    joint=replace(TINY_PLANS.joint, reads=tuple(READABLE)),
    scenario=tuple(SCENARIOS),
    validation_instances=14,
    n_agents=(2, 3),
    steps=10,
)


@pytest.fixture
def student(tmp_path):
    """The options of a run in which an untrained network plays the beginning of each game."""
    torch.manual_seed(3)
    save(tmp_path / "student.safetensors", JointDAN(TINY.joint))
    return replace(TINY, roll_in=str(tmp_path / "student.safetensors"))


def problem_of(nodes, **fields):
    """One instance."""
    n_agents = max(len(fields[name]) for name in ("speeds", "breaks") if name in fields)
    arrays = {"nodes": nodes, **fields}
    return Problem(n_agents, {name: np.asarray(array, np.float64)[None] for name, array in arrays.items()})


def test_labels_of_a_game_solved_by_hand():
    """Agent 0, three times as fast, takes both far cities in the east, agent 1 the near one in the west."""
    nodes = [[0.5, 0.5], [0.9, 0.4], [0.9, 0.6], [0.4, 0.5]]
    config = replace(TINY, teacher_iterations=200, roll_in=None)
    lessons = teach(config, np.random.default_rng(0), problem_of(nodes, speeds=[1.5, 0.5]))
    decisions, valid = lessons.decisions("cpu")
    assert decisions.shape == (4, 1) and valid.all()
    game, plan = decisions[:, 0], decisions["plan"][:, 0]
    # Agent 1 arrives after 0.2 units of time, agent 0 after 0.27. The tour in the east runs counter-clockwise: 1 lies
    # south of 2
    assert game["agent"].tolist() == [0, 1, 1, 0]
    assert game["action"].tolist() == [1, 3, 0, 2]
    assert plan["next"].tolist() == [[1, 3], [2, 3], [2, 0], [2, 0]]
    assert not plan["closed"].any()
    assert plan["visitor"][:, 2].tolist() == [0, 0, 0, 0] and plan["visitor"][:2, 3].tolist() == [1, 1]


def test_those_who_go_on_waiting_are_not_learnt_from():
    """Agent 1 is far too slow to help: it stays at the depot whenever it is asked."""
    nodes = [[0.5, 0.5], [0.9, 0.4], [0.9, 0.6], [0.4, 0.5]]
    config = replace(TINY, teacher_iterations=200, roll_in=None)
    lessons = teach(config, np.random.default_rng(0), problem_of(nodes, speeds=[1.5, 0.01]))
    assert lessons.valid.all() and lessons.arrays["agent"].tolist() == [[0]] * 3
    assert sorted(lessons.arrays["action"][:, 0]) == [1, 2, 3]
    buffer = Buffer(replace(TINY, workers=0), KEYS, np.random.default_rng(0))
    empty = Lessons({key: array[:0] for key, array in lessons.arrays.items()}, lessons.valid[:0])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.buffer.demonstrate", lambda config, index: empty)
        buffer.add(0)
    assert buffer.sets == [] and buffer.next == 1  # nothing to draw from it


def test_others_visit_what_a_broken_agent_leaves():
    """Agent 1 breaks down on its way to the west; from then on it is closed, and agent 0 visits its city."""
    nodes = [[0.5, 0.5], [0.9, 0.5], [0.1, 0.5]]
    config = replace(TINY, teacher_iterations=200, roll_in=None)
    lessons = teach(config, np.random.default_rng(0), problem_of(nodes, breaks=[np.inf, 0.2]))
    decisions, valid = lessons.decisions("cpu")
    game, plan = decisions[:, 0][valid[:, 0]], decisions["plan"][:, 0][valid[:, 0]]
    first, last = game["action"][0], game["action"][1]
    assert {int(first), int(last)} == {1, 2}
    broken = ~game["agent_alive"][:, 1]
    assert broken.any() and torch.equal(plan["closed"][:, 1], broken) and not plan["closed"][:, 0].any()
    (again,) = (game["action"] == last).nonzero()[1:].unbind()  # the orphaned city is visited after all
    assert game["agent"][again] == 0 and broken[again]
    assert (plan["visitor"][again, int(last)] == 0).all()


def test_routes_from_the_depot_are_canonical_and_only_agents_that_are_alike_are_exchanged():
    nodes = np.array([[0.5, 0.5], [0.9, 0.6], [0.6, 0.9], [0.1, 0.4], [0.4, 0.1]])
    clockwise = [[2, 1], [4, 3]]  # the north-east, then the south-west
    for fields, expected in (
        ({"breaks": [np.inf, np.inf]}, [[3, 4], [1, 2]]),  # in the order of angles: the south-west first
        ({"speeds": [1.0, 0.9]}, [[1, 2], [3, 4]]),
    ):
        problem = problem_of(nodes, **fields)
        game = rules.start(problem, rules.make_rules(5, 2, 0.01, "wait", "sparse", None))
        assert canonical_routes(game, clockwise) == expected
        away = rules.depart(game, rules.make_rules(5, 2, 0.01, "wait", "sparse", None), np.array([2]))
        assert canonical_routes(away, [[1], [4, 3]]) == [[1], [3, 4]]  # agent 0 has left


@pytest.mark.slow
@pytest.mark.parametrize("scenario", WORLDS)
def test_every_label_fits_its_decision(scenario, student):
    for config in (replace(TINY, scenario=(scenario,)), replace(student, scenario=(scenario,))):
        lessons = demonstrate(config, 1)
        decisions, valid = lessons.decisions("cpu")
        one = decisions[valid]
        plan = one["plan"]
        own = plan["next"].gather(1, one["agent"][:, None])[:, 0]
        assert torch.equal(own, one["action"])
        assert one["action_mask"].gather(1, one["action"][:, None]).all()
        assert not one["visited"].gather(1, plan["next"])[~plan["closed"]].any()
        for row in range(len(one)):
            cities = [city for city in plan["next"][row].tolist() if city]
            assert len(set(cities)) == len(cities)  # nobody heads for another one's city
            for agent, city in enumerate(plan["next"][row].tolist()):
                assert city == 0 or plan["visitor"][row, city] == agent
        if "agent_alive" in one:
            assert torch.equal(plan["closed"], ~one["agent_alive"])


@pytest.mark.slow
def test_teachers_games_solve_every_instance():
    """Without a student, the teacher plays each game to its end."""
    for scenario in WORLDS:
        config = replace(TINY, scenario=(scenario,))
        lessons = demonstrate(config, 2)
        for b in range(lessons.valid.shape[1]):
            chosen = lessons.arrays["action"][lessons.valid[:, b], b]
            assert set(range(1, lessons.arrays["visited"].shape[2])) <= set(chosen.tolist())


@pytest.mark.slow
def test_the_student_plays_until_few_cities_are_left():
    config = replace(TINY, roll_in="default", scenario=("arrivals",))
    problem = draw(np.random.default_rng(8), config, 4, size=(9, 3))
    env, lengths = environment(problem, config), set()
    for left in (8, 5, 2):
        start = env.reset(TensorDict({"game": TensorDict(dict(problem.arrays), [4])}, [4]), set_state=True)
        state = roll_in(config, env, start, left)
        decisions = state["game", "decisions"]
        assert ((state["game", "cities_left"] == left) | (decisions == 2 * 9)).all() and not state["done"].any()
        assert (state["game", "cities_left"] == left).any()
        assert (decisions >= 8 - left).all() and (decisions <= 2 * 9).all()
        lengths |= set(decisions.tolist())
    assert len(lengths) > 3  # those that had come so far waited for the others


def test_the_student_cannot_wait_forever():
    class Stays(torch.nn.Module):
        def forward(self, cities, agents, visited):
            return -torch.arange(visited.shape[-1], dtype=torch.float32).expand(visited.shape)

    problem = draw(np.random.default_rng(8), TINY, 4, size=(9, 3), scenario="arrivals")
    env = environment(problem, TINY)
    start = env.reset(TensorDict({"game": TensorDict(dict(problem.arrays), [4])}, [4]), set_state=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("train.lessons.student", lambda config: make_actor(Stays()))
        state = roll_in(TINY, env, start, 1)
    assert (state["game", "decisions"] == 2 * 9).all()


@pytest.mark.slow
def test_sets_take_all_scenarios_and_depend_on_their_index_alone(student):
    kinds = set()
    for index in range(24):
        one, again = demonstrate(student, index), demonstrate(student, index)
        assert type(one) is type(again)
        if isinstance(one, Lessons):
            assert all(np.array_equal(one.arrays[key], again.arrays[key]) for key in one.arrays)
            kinds.add(tuple(sorted(set(one.arrays) & set(READABLE))))
    assert kinds == {
        (), ("city_known",), ("agent_alive",), ("agent_speeds",), ("service",),
        ("agent_alive", "agent_speeds", "city_known", "service"),
    }  # fmt: skip


def test_plain_sets_are_those_of_before(student):
    """A run that names no scenario makes the sets that it made before there were worlds: no number is drawn for it."""
    one = demonstrate(replace(student, scenario=("plain",)), 3)
    rng = np.random.default_rng([student.seed, 3])
    n_nodes = int(rng.integers(*student.n_nodes, endpoint=True))
    n_agents = int(rng.integers(2, max(2, min(3, n_nodes // 2)), endpoint=True))
    assert one.first.shape[1] == n_agents
    assert np.array_equal(one.nodes, rng.random((len(one.nodes), n_nodes, 2)))


@pytest.mark.slow
def test_losses_in_worlds_have_gradients_for_everything_that_is_read(student):
    torch.manual_seed(0)
    network = JointDAN(TINY.joint)
    config = replace(student, scenario=("everything",))
    buffer = Buffer(config, observation_keys(network), np.random.default_rng(0), plans=True)
    flags = ("agent_alive", "city_known")
    while not any(all(key in one and not one[key].all() for key in flags) for one, _ in buffer.sets):
        buffer.add(buffer.next)  # until there is a set of everything in which somebody has broken down
    for decisions, valid in buffer.sets:
        imitation_losses(network, decisions[valid], student).total.backward()
    for key, vector in network.effect.items():
        assert (vector.grad is None) == (key == "agent_known")
        assert vector.grad is None or vector.grad.abs().max() > 0


@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, monkeypatch, student):
    imitate(replace(student, out=tmp_path / "whole"))

    interrupt_after(5, ImitationLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        imitate(replace(student, out=tmp_path / "parts"))
    torch.manual_seed(123)  # something else happened in between
    assert imitate(replace(student, out=tmp_path / "parts", resume=True)).step == 10
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "buffer"):
        assert same(whole[key], parts[key]), key
    assert whole["progress"]["best"] == parts["progress"]["best"]


@pytest.mark.parametrize(
    ("kind", "kwargs", "message"),
    [
        (ImitateConfig, {"scenario": ()}, "scenario must name at least 1 world"),
        (ImitateConfig, {"scenario": ("rain",)}, "unknown scenario 'rain'"),
        (ImitateConfig, {"scenario": ("nowhere:rain",)}, "scenario='nowhere:rain' cannot be imported"),
        (ImitateConfig, {"scenario": ("team",), "plan_matching": "invariant"}, "plan_matching must be 'canonical' in"),
        (ImproveConfig, {"scenario": ("team",)}, r"scenario must be 'plain'.*, got \('team',\)"),
        (ImitateConfig, {"reads": ("service",)}, "reads must be None unless a registered policy starts from init"),
    ],
)
def test_bad_configurations_are_named(kind, kwargs, message):
    with pytest.raises(ValueError, match=message):
        kind(**kwargs)
