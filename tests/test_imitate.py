"""Demonstrations are the teacher's tours in one canonical form; learning from them lowers costs and resumes bit for
bit."""

from dataclasses import replace

import numpy as np
import pytest
import tiny
import torch
from helpers.states import same
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny import TINY_PLANS, interrupt_after

from dan_policy import DAN, DANConfig, load, save
from dan_policy.episode import rollout
from dan_policy.games import as_links
from mtsp_env import check_tours, makespan
from mtsp_env.instance import Instance, Problem
from train import checkpoint
from train.__main__ import main
from train.baseline import better
from train.buffer import Buffer
from train.collect import costs, environment, play
from train.demonstrations import Demonstrations, as_decisions, canonical, demonstrate, follow
from train.imitate import ImitationLearner, imitate
from train.supervised import rate
from train.supervised_config import ImitateConfig

pytest.importorskip("numba", reason="the teacher is compiled with Numba")

KEYS = ("cities", "agents", "visited", "action_mask")
TINY = replace(TINY_PLANS, policy="dan", joint=ImitateConfig().joint, network=tiny.TINY.network, steps=24)


@st.composite
def solved(draw):
    """An instance and random tours that solve it, including idle agents and clockwise tours."""
    n_nodes, seed = draw(st.integers(2, 14)), draw(st.integers(0, 2**32 - 1))
    n_agents = draw(st.integers(1, n_nodes - 1))
    rng = np.random.default_rng(seed)
    tours = [[0] for _ in range(n_agents)]
    for city in rng.permutation(n_nodes - 1) + 1:
        tours[rng.integers(n_agents)].append(int(city))
    return Instance(rng.random((n_nodes, 2)), n_agents), [[*tour, 0] for tour in tours]


@pytest.mark.slow
@given(solved())
@settings(max_examples=200, deadline=None)
def test_canonical_tours_solve_the_same_instance_no_worse_and_in_one_order(case):
    instance, tours = case
    ordered = canonical(instance.nodes, tours)
    check_tours(instance, ordered)
    assert makespan(instance, ordered) <= makespan(instance, tours) + 1e-12
    assert all(len(tour) > 2 for tour in ordered)  # nobody stays at home
    turned = [tour[::-1] for tour in tours[::-1]]
    if all(len(tour) > 2 for tour in tours):
        assert sorted(map(sorted, ordered)) == sorted(map(sorted, tours))  # the same division of the cities
        assert [t for t in canonical(instance.nodes, turned) if len(t) > 3] == [t for t in ordered if len(t) > 3]


@pytest.mark.slow
@given(solved(), st.data())
@settings(max_examples=200, deadline=None)
def test_canonical_tours_keep_their_prefixes(case, data):
    """Prefixes stay as they are; no agent stays at the depot while another one has two cities left."""
    instance, tours = case
    prefixes = [tour[: data.draw(st.integers(1, len(tour) - 1))] for tour in tours]
    closed = [len(prefix) > 1 and data.draw(st.booleans()) for prefix in prefixes]
    prefixes = [tour if home and tour == [*prefix, 0] else prefix
                for tour, prefix, home in zip(tours, prefixes, closed, strict=True)]  # fmt: skip
    ordered = canonical(instance.nodes, tours, prefixes)
    check_tours(instance, ordered)
    assert makespan(instance, ordered) <= makespan(instance, tours) + 1e-12
    assert all(tour[: len(prefix)] == prefix for tour, prefix in zip(ordered, prefixes, strict=True))
    waiting = [tour for tour, prefix in zip(ordered, prefixes, strict=True) if prefix == [0]]
    if [0, 0] in waiting:
        assert all(len(tour) <= 3 for tour in waiting)
        under_way = [pair for pair in zip(ordered, prefixes, strict=True) if len(pair[1]) > 1]
        assert all(len(tour) <= len(prefix) + 1 for tour, prefix in under_way)  # no city is left to take over
        assert waiting.index([0, 0]) == sum(tour != [0, 0] for tour in waiting)  # the idle ones come last


def test_tours_run_counter_clockwise_and_agents_are_sorted_by_angle():
    """The depot in the middle of eight cities; angles begin and end in the west."""
    nodes = np.array([[0.5, 0.5], [1, 0.6], [0.6, 1], [0.4, 1], [0, 0.6], [0, 0.4], [0.4, 0], [0.6, 0], [1, 0.4]])
    tours = [[0, 2, 1, 0], [0, 4, 3, 0], [0, 8, 7, 0], [0, 6, 5, 0]]  # clockwise
    south_west, south_east, north_east, north_west = [0, 5, 6, 0], [0, 7, 8, 0], [0, 1, 2, 0], [0, 3, 4, 0]
    assert canonical(nodes, tours) == [south_west, south_east, north_east, north_west]


@pytest.mark.slow
@given(solved())
@settings(max_examples=50, deadline=None)
def test_the_teachers_policy_plays_its_tours(case):
    instance, tours = case
    tours = canonical(instance.nodes, tours)
    demonstrations = Demonstrations(instance.nodes[None], *as_links([tours], instance.n_nodes))
    problem = as_problem(demonstrations)
    env = environment(problem, TINY)
    episode = rollout(follow(demonstrations), env, "greedy", problem)
    assert env.tours() == [tours]
    assert -float(episode.reward) == pytest.approx(makespan(instance, tours))


def test_a_replayed_set_holds_every_decision_of_the_teachers_tours():
    demonstrations = demonstrate(TINY, 3)
    decisions, valid = as_decisions(demonstrations, KEYS, TINY)
    batch, n_nodes = demonstrations.nodes.shape[:2]
    assert decisions.shape == valid.shape and valid.shape[1] == batch
    for b in range(batch):
        chosen = decisions["action"][:, b][valid[:, b]]
        assert sorted(chosen[chosen != 0].tolist()) == list(range(1, n_nodes))
    assert decisions["action_mask"].gather(2, decisions["action"][..., None])[..., 0][valid].all()


@pytest.mark.slow
def test_sets_depend_on_their_index_alone_and_the_teacher_is_near_optimal():
    one, again, other = demonstrate(TINY, 5), demonstrate(TINY, 5), demonstrate(TINY, 6)
    assert all(np.array_equal(a, b) for a, b in zip(one, again, strict=True))
    assert one.nodes.shape != other.nodes.shape or not np.array_equal(one.nodes, other.nodes)
    config = replace(TINY, n_nodes=(9, 9), n_agents=(2, 2), teacher_iterations=200)
    demonstrations = demonstrate(config, 0)
    teacher_makespans = [float(part) for part in teacher_costs(demonstrations, config)]
    from mtsp_env.reference import improve

    best = [
        makespan(one, improve(one, iterations=5000)) for one in (Instance(nodes, 2) for nodes in demonstrations.nodes)
    ]
    assert np.mean(teacher_makespans) <= 1.002 * np.mean(best)  # tidy tours may give away a little of the makespan


def as_problem(demonstrations):
    return Problem(demonstrations.first.shape[1], {"nodes": torch.tensor(demonstrations.nodes)})


def teacher_costs(demonstrations, config):
    problem = as_problem(demonstrations)
    return -rollout(follow(demonstrations), environment(problem, config), "greedy", problem).reward


@pytest.fixture
def student(tmp_path):
    """The options of a run in which an untrained network plays the beginning of each game."""
    torch.manual_seed(3)
    save(tmp_path / "student.safetensors", DAN(TINY.network))
    return replace(TINY, roll_in=str(tmp_path / "student.safetensors"))


@pytest.mark.slow
def test_the_student_plays_the_beginning_and_the_teacher_continues(student):
    begins = set()
    for index in range(12):
        demonstrations = demonstrate(student, index)
        decisions, valid = as_decisions(demonstrations, KEYS, student)
        assert 0 <= demonstrations.begin < demonstrations.nodes.shape[1] - 1 and valid[: demonstrations.begin].all()
        logits = load(student.roll_in)(decisions["cities"], decisions["agents"], decisions["visited"])
        likeliest = logits.masked_fill(~decisions["action_mask"], -torch.inf).argmax(-1)
        same_choice = (likeliest == decisions["action"]) | ~valid
        assert same_choice[: demonstrations.begin].all()
        assert not same_choice[demonstrations.begin :].all()
        begins.add(demonstrations.begin)
        played = -play(load(student.roll_in), as_problem(demonstrations), student, "greedy").reward
        assert (
            teacher_costs(demonstrations, student) <= 1.01 * played
        ).all()  # the teacher continues near-optimally; tidy tours may give away a little
    assert len(begins) > 3


@pytest.mark.slow
def test_decisions_after_the_students_part_are_learnt_from(student):
    for passes in (1.0, 0.25):
        buffer = Buffer(replace(student, passes=passes, sets_per_step=1, buffer=1), KEYS, np.random.default_rng(0))
        for index in range(6):
            begin = demonstrate(student, index).begin
            buffer.add(index)
            (steps, (_, valid)) = buffer.left.pop(), buffer.sets.pop()
            count = max(1, round(passes * len(valid)))
            assert sorted(steps) == list(range(begin, min(len(valid), begin + count)))


@pytest.mark.slow
def test_workers_make_the_same_sets(student):
    """Set i is the same whether a worker or this process makes it."""
    cities = []
    for workers in (0, 1):
        buffer = Buffer(replace(student, workers=workers), KEYS, np.random.default_rng(0))
        cities.append(torch.cat([part["cities"].flatten() for _ in range(3) for part in buffer.draw(2)]))
        buffer.close()
    assert torch.equal(*cities)


@pytest.mark.slow
def test_every_decision_of_a_set_is_drawn_once():
    buffer = Buffer(replace(TINY, sets_per_step=1, buffer=1), KEYS, np.random.default_rng(0))
    decisions, valid = as_decisions(demonstrate(TINY, 0), KEYS, TINY)
    drawn = torch.cat([buffer.draw(1)[0]["action"] for _ in range(len(valid))])
    assert buffer.sets == []  # used up: the next draw takes a fresh set
    assert sorted(drawn.tolist()) == sorted(decisions["action"][valid].tolist())
    buffer.draw(1)
    assert buffer.indices in ([1], [])
    half = Buffer(replace(TINY, passes=0.5), KEYS, np.random.default_rng(0))
    half.draw(2)
    assert sum(map(len, half.left)) + 2 == sum(round(0.5 * len(valid)) for _, valid in half.sets)


def test_the_learning_rate_warms_up_and_falls_to_its_end():
    config = replace(TINY, steps=100, warmup=10, final_rate=0.1)
    rates = [rate(config, step) for step in range(101)]
    assert rates[0] == 0.1 and rates[10] == 1.0 and rates[100] == pytest.approx(0.1)
    assert rates[:10] == sorted(rates[:10]) and rates[10:] == sorted(rates[10:], reverse=True)


@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, monkeypatch, student):
    imitate(replace(student, out=tmp_path / "whole"))

    interrupt_after(7, ImitationLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        imitate(replace(student, out=tmp_path / "parts"))
    assert checkpoint.read(tmp_path / "parts" / "checkpoint.pt")["progress"]["step"] == 7
    torch.manual_seed(123)  # something else happened in between
    assert imitate(replace(student, out=tmp_path / "parts", resume=True)).step == 24
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "buffer"):
        assert same(whole[key], parts[key]), key
    assert whole["random"]["numpy"] == parts["random"]["numpy"]
    assert whole["progress"]["best"] == parts["progress"]["best"]


@pytest.mark.slow
def test_a_run_cannot_be_resumed_with_another_student(tmp_path, student):
    run = replace(student, out=tmp_path / "run", steps=2)
    imitate(run)
    torch.manual_seed(4)
    save(tmp_path / "student.safetensors", DAN(TINY.network))
    with pytest.raises(ValueError, match=r"roll_in='.*student.safetensors' holds other weights than when the run beg"):
        imitate(replace(run, steps=3, resume=True))
    assert checkpoint.read(tmp_path / "run" / "checkpoint.pt")["progress"]["step"] == 2


@pytest.mark.slow
def test_imitation_learns_what_the_teacher_does(tmp_path):
    """80 steps at n = 10, m = 2 lower the greedy cost on held-out instances."""
    config = replace(
        TINY, out=tmp_path, n_nodes=(10, 10), n_agents=(2, 2), set_tokens=2000, sets_per_step=3, steps=80, average=0.9,
        learning_rate=3e-3, warmup=10, validate_every=1000, checkpoint_every=1000,
        network=DANConfig(embed_dim=32, feedforward_dim=64, n_heads=4, city_layers=1, prune_visited=True),
    )  # fmt: skip
    nodes = torch.rand(256, 10, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    held_out = [Problem(2, {"nodes": nodes})]
    before = costs(ImitationLearner(config).averaged_network, held_out, config)
    learner = imitate(config)
    after = costs(learner.averaged_network, held_out, config)
    assert better(after, before, 1e-6)
    assert after.mean() < 0.85 * before.mean()  # 0.79
    reward = play(learner.averaged_network, held_out[0], config, "greedy").reward
    assert torch.equal(-reward, after)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"depot": "open"}, "depot must be 'final'"),
        ({"n_nodes": (3, 9), "n_agents": (3, 3), "nodes_per_agent": 1}, r"n_nodes\[0\] must be above"),
        ({"nodes_per_agent": 11}, r"nodes_per_agent must be at most n_nodes\[0\] // n_agents\[0\] = 10, got 11"),
        ({"sets_per_step": 17}, "sets_per_step must be at most buffer=16, got 17"),
        ({"passes": 0.0}, "passes must be above 0 and at most 1"),
        ({"learning_rate": np.inf}, "learning_rate must be above 0 and at most 1, got inf"),
        ({"weight_decay": np.nan}, "weight_decay must be finite and at least 0, got nan"),
        ({"average": 1.0}, "average must be at least 0 and below 1"),
    ],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ImitateConfig(**kwargs)


@pytest.mark.parametrize("option", ["workers", "buffer"])
def test_what_does_not_fit_into_the_memory_is_refused(option):
    with pytest.raises(ValueError, match=f"{option} 1000000000 needs about .* GiB of memory, .* fits"):
        ImitationLearner(replace(TINY_PLANS, **{option: 10**9}))


@pytest.mark.slow
def test_the_command_line_imitates(tmp_path, capsys):
    small = ["--n-nodes", "6", "7", "--n-agents", "1", "2", "--nodes-per-agent", "2", "--set-tokens", "100",
             "--buffer", "4", "--network.embed-dim", "16", "--validation-instances", "4", "--out", str(tmp_path),
             "--no-tensorboard", "--teacher-iterations", "5", "--workers", "0"]  # fmt: skip
    assert main(["imitate", "--steps", "2", *small]) == 0
    assert main(["imitate", "--steps", "2", *small]) == 2
    assert "add --resume" in capsys.readouterr().err
    assert main(["imitate", "--steps", "3", "--resume", *small]) == 0
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == 3


def test_a_student_without_weights_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(FileNotFoundError, match="no weights at"):
        imitate(replace(TINY, out=tmp_path / "run", roll_in=str(tmp_path / "nobody.safetensors")))
    assert not (tmp_path / "run").exists()
