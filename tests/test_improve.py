"""Self-improvement learns from the best of the policy's own games, lowers costs and resumes bit for bit."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest
import torch
from helpers.states import same
from tiny import TINY_PLANS, interrupt_after

from dan_policy.episode import rollout
from dan_policy.games import play
from dan_policy.joint import JointConfig, JointDAN
from dan_policy.symmetry import views
from mtsp_env import check_tours, makespan, rules
from mtsp_env.distributions import sample
from mtsp_env.instance import Instance, Problem
from train import checkpoint
from train.__main__ import main
from train.baseline import better
from train.collect import costs, draw, draw_set, environment, repeat, rotated
from train.demonstrations import demonstrate, follow
from train.improve import ImproveLearner, best_games, improve
from train.supervised_config import ImproveConfig

TINY = ImproveConfig(
    policy="joint",
    joint=TINY_PLANS.joint,
    n_nodes=(6, 9),
    n_agents=(1, 3),
    nodes_per_agent=2,
    batch_size=4,
    samples=5,
    chunk=16,
    warmup=2,
    steps=6,
    validate_every=2,
    validation_instances=8,
    checkpoint_every=2,
    tensorboard=False,
)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return JointDAN(TINY.joint)


def test_games_that_do_not_fit_into_the_memory_are_refused():
    problem = sample("uniform", np.random.default_rng(0), 2, 20, 2)
    with pytest.raises(ValueError, match=r"samples 1000000000 needs about .* GiB of memory, .* fits"):
        repeat(problem, 10**9)


def test_the_best_games_are_those_that_the_judge_finds_best(network):
    problem = draw(np.random.default_rng(1), TINY, 6, size=(8, 3))
    best, makespans = best_games(network, problem, TINY, seed=5)
    repeated = repeat(problem, TINY.samples)  # the same games again
    nodes, game = repeated.nodes.numpy(), environment(repeated, TINY).rules
    end = play(network, rules.start(Problem(3, {"nodes": nodes}), game), game, torch.Generator().manual_seed(5))
    games = list(map(rules.tours, end.visits, end.destination))

    replayed = environment(problem, TINY)
    rollout(follow(best), replayed, "greedy", torch.as_tensor(best.nodes))
    for b, tours in enumerate(replayed.tours()):
        instance = Instance(problem.nodes[b].numpy(), 3)
        candidates = games[b * TINY.samples : (b + 1) * TINY.samples]
        judged = [makespan(instance, one) for one in candidates]
        check_tours(instance, tours)
        assert makespan(instance, tours) == min(judged)
        assert tours == candidates[int(np.argmin(judged))]
        assert makespans[b] == pytest.approx(judged, abs=1e-6)
        shown = views(problem.nodes[b], TINY.samples)[int(np.argmin(judged))]
        assert np.array_equal(best.nodes[b], shown.numpy())


def test_games_to_learn_from_are_played_on_foreseen_decisions():
    """The lower the confidence, the more agents act without a forward pass of their own."""
    problem, looks = draw(np.random.default_rng(1), TINY, 6, size=(20, 3)), {}
    for confidence in (1.0, 0.3):
        torch.manual_seed(0)
        network = JointDAN(JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1, confidence=confidence))
        with patch.object(network, "forward_next", wraps=network.forward_next) as look:
            best_games(network, problem, TINY, seed=5)
        looks[confidence] = sum(len(call.args[0]) for call in look.call_args_list)
    assert looks[0.3] < looks[1.0]


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_games_to_learn_from_have_the_precision_of_the_run(network, precision):
    precisions, problem = set(), draw(np.random.default_rng(1), TINY, 2, size=(8, 3))
    network.register_forward_pre_hook(lambda *_: precisions.add(torch.is_autocast_enabled("cpu")))
    best_games(network, problem, replace(TINY, precision=precision), seed=5)
    assert precisions == {precision == "bfloat16"}


def test_every_step_draws_other_actions():
    learner = ImproveLearner(TINY)
    with patch("train.improve.best_games", wraps=best_games) as played:
        for _ in range(3):
            learner.train_step()
    assert len({call.args[3] for call in played.call_args_list}) == 3


def test_one_step_raises_the_likelihood_of_the_best_games(network):
    config = replace(TINY, learning_rate=1e-2, warmup=1, average=0.0)
    learner = ImproveLearner(config)
    first = learner.train_step()
    assert first["best_cost"] <= first["cost"] and first["loss"] > 0 and first["next_loss"] > 0
    assert learner.instances == 4 and learner.step == 1


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["joint", "dan"])
def test_both_networks_improve_without_a_teacher(policy):
    learner = ImproveLearner(replace(TINY, policy=policy, rotate=True))
    logs = [learner.train_step() for _ in range(2)]
    assert all(np.isfinite(log["loss"]) for log in logs)


@pytest.mark.slow
def test_resume_is_bit_identical(tmp_path, monkeypatch):
    improve(replace(TINY, out=tmp_path / "whole"))

    interrupt_after(3, ImproveLearner, monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        improve(replace(TINY, out=tmp_path / "parts"))
    assert checkpoint.read(tmp_path / "parts" / "checkpoint.pt")["progress"]["step"] == 3
    torch.manual_seed(123)  # something else happened in between
    monkeypatch.undo()
    assert improve(replace(TINY, out=tmp_path / "parts", resume=True)).step == 6
    whole, parts = (checkpoint.read(tmp_path / name / "checkpoint.pt") for name in ("whole", "parts"))
    for key in ("network", "average", "optimiser", "schedule", "random"):
        assert same(whole[key], parts[key]), key
    assert whole["progress"]["best"] == parts["progress"]["best"]


@pytest.mark.slow
def test_self_improvement_lowers_the_cost(tmp_path):
    """80 steps from random weights at n = 10, m = 2."""
    config = replace(
        TINY, out=tmp_path, n_nodes=(10, 10), n_agents=(2, 2), batch_size=32, samples=8, steps=80, chunk=512,
        learning_rate=2e-3, warmup=5, validate_every=1000, checkpoint_every=1000,
        joint=JointConfig(embed_dim=32, feedforward_dim=64, n_heads=2, n_layers=2),
    )  # fmt: skip
    held_out = draw_set(np.random.default_rng(1), config, 256)
    before = costs(ImproveLearner(config).averaged_network, held_out, config)
    after = costs(improve(config).averaged_network, held_out, config)
    assert better(after, before, 1e-6)
    assert after.mean() < 0.85 * before.mean()


def test_rotations_keep_shapes_and_stay_in_the_square():
    problem = draw(np.random.default_rng(0), TINY, 50, size=(8, 2))
    turned = rotated(np.random.default_rng(1), problem)
    before, after = (torch.cdist(one.nodes, one.nodes) for one in (problem, turned))
    scale = after.sum((1, 2)) / before.sum((1, 2))
    assert torch.allclose(before * scale[:, None, None], after)
    assert (scale <= 1 + 1e-9).all() and (scale >= 0.5**0.5 - 1e-9).all() and (scale > 1 - 1e-9).any()
    assert (turned.nodes >= 0).all() and (turned.nodes <= 1).all()
    a, b = problem.nodes - 0.5, turned.nodes - 0.5
    cos = (a * b).sum(2) / (a.norm(dim=2) * b.norm(dim=2))
    sin = (a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / (a.norm(dim=2) * b.norm(dim=2))
    angle = torch.atan2(sin, cos)  # (B, n): all nodes of an instance turn by the same angle
    turns = torch.stack([angle.sin(), angle.cos()])
    assert torch.allclose(turns, turns[:, :, :1].expand_as(turns), atol=1e-6)
    assert angle[:, 0].min() < -2 and angle[:, 0].max() > 2


def test_rotated_demonstrations_are_the_teachers_for_the_rotated_instances():
    pytest.importorskip("numba", reason="the teacher is compiled with Numba")
    plain, turned = (demonstrate(replace(TINY_PLANS, rotate=rotate), 0) for rotate in (False, True))
    lengths = [np.linalg.norm(one.nodes[:, 1:] - one.nodes[:, :1], axis=2) for one in (plain, turned)]
    scale = lengths[1].sum(1) / lengths[0].sum(1)
    assert np.allclose(lengths[0] * scale[:, None], lengths[1]) and not np.allclose(plain.nodes, turned.nodes)
    ranked = [angles(one) for one in (plain, turned)]
    assert all((np.diff(one, axis=1) >= 0).all() for one in ranked)  # canonical order in the rotated plane


def angles(demonstrations):
    """(B, m) The angle at which the centroid of each tour's cities is seen from the depot."""
    seen = np.empty(demonstrations.first.shape)
    for b, starts in enumerate(demonstrations.first):
        for agent, city in enumerate(starts):
            tour = [city]
            while (city := demonstrations.following[b, city]) != 0:
                tour.append(city)
            east, north = demonstrations.nodes[b, tour].mean(0) - demonstrations.nodes[b, 0]
            seen[b, agent] = np.arctan2(north, east)
    return seen


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"samples": 1}, "samples must be a whole number of at least 2, got 1"),
        ({"chunk": 0}, "chunk must be a whole number of at least 1, got 0"),
        ({"batch_tokens": 0}, "batch_tokens must be a whole number of at least 1, got 0"),
        ({"depot": "open"}, "depot must be 'final'"),
    ],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ImproveConfig(**kwargs)


@pytest.mark.slow
def test_the_command_line_improves(tmp_path, capsys):
    small = ["--n-nodes", "6", "7", "--n-agents", "1", "2", "--nodes-per-agent", "2", "--batch-size", "2",
             "--samples", "2", "--network.embed-dim", "16", "--validation-instances", "4", "--out", str(tmp_path),
             "--no-tensorboard"]  # fmt: skip
    assert main(["improve", "--steps", "2", *small]) == 0
    assert main(["improve", "--steps", "2", *small]) == 2
    assert "add --resume" in capsys.readouterr().err
    assert main(["improve", "--steps", "3", "--resume", *small]) == 0
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == 3
