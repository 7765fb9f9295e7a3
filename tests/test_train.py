"""REINFORCE with a rollout baseline: the gradient is that of the formula, chunks add up, training lowers costs."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.states import same
from tensordict.nn import TensorDictModule
from tiny import TINY
from torch import nn
from torchrl.objectives import ReinforceLoss

from dan_policy import DANConfig, make_actor
from mtsp_env.instance import Problem
from train import checkpoint
from train.__main__ import main
from train.baseline import RolloutBaseline, SharedBaseline, better
from train.collect import costs, draw, draw_set, play, repeat
from train.loss import EpisodicReinforceLoss, backward, decisions_with_advantage, log_probs, subsample
from train.presets import PAPER
from train.reinforce import ReinforceLearner, reinforce
from train.reinforce_config import ReinforceConfig


class Preferences(nn.Module):
    """One logit per node, whatever the observation: small enough to differentiate by hand."""

    def __init__(self, logits):
        super().__init__()
        self.logits = nn.Parameter(torch.tensor(logits))

    def forward(self, cities, agents, visited):
        return self.logits.expand(cities.shape[:-1])


def gradients(network, decisions, n_episodes, chunk):
    network.zero_grad()
    loss = backward(EpisodicReinforceLoss(make_actor(network), n_episodes), decisions, chunk)
    return loss, [p.grad.clone() for p in network.parameters()]


def test_the_gradient_is_reinforce_by_hand():
    """Three cities, one agent: three decisions, the last one forced. p1 = p2 = p3 = 1/3, then 1/2 each."""
    network = Preferences([0.0, 0.0, 0.0, 0.0])
    nodes = torch.tensor([[0.5, 0.5], [0.1, 0.2], [0.9, 0.3], [0.4, 0.8]], dtype=torch.float64).expand(2, 4, 2)
    config = replace(TINY, n_nodes=(4, 4))
    episode = play(network, Problem(1, {"nodes": nodes}), config, "sample", keep=True)
    episode.decisions["action"].copy_(torch.tensor([[1, 3], [2, 1], [3, 2]]))
    masks = torch.tensor(
        [[[0, 1, 1, 1], [0, 0, 1, 1], [0, 0, 0, 1]], [[0, 1, 1, 1], [0, 1, 1, 0], [0, 0, 1, 0]]]
    ).bool()
    episode.decisions["action_mask"].copy_(masks.transpose(0, 1))

    advantage = torch.tensor([2.0, -1.0])
    loss, (gradient,) = gradients(network, decisions_with_advantage(episode, advantage), 2, chunk=100)
    # episode 1 visits 1, 2, 3: d log p = (1 - 1/3, 0 - 1/3 + 1 - 1/2, 0 - 1/3 - 1/2) for cities 1, 2, 3
    first = torch.tensor([0.0, 2 / 3, 1 / 6, -5 / 6])
    # episode 2 visits 3, 1, 2
    second = torch.tensor([0.0, 1 / 6, -5 / 6, 2 / 3])
    assert torch.allclose(gradient, -(2.0 * first - 1.0 * second) / 2, atol=1e-6)
    assert loss == pytest.approx(-(2.0 - 1.0) * np.log(1 / 6) / 2, rel=1e-6)


def test_padding_after_an_episodes_end_contributes_nothing():
    torch.manual_seed(0)
    config = replace(TINY, depot="final", n_nodes=(6, 6), n_agents=(4, 4), batch_size=32)
    network = Preferences([0.5, 0.0, 0.1, 0.2, 0.3, 0.4])
    episode = play(network, draw(np.random.default_rng(0), config, 32), config, "sample", keep=True)
    assert not episode.valid.all(), "this case should have episodes of several lengths"
    advantage = torch.randn(32)
    _, whole = gradients(network, decisions_with_advantage(episode, advantage), 32, 1000)
    scrambled = replace(episode, decisions=episode.decisions.clone())
    scrambled.decisions["action"][~episode.valid] = 1
    scrambled.decisions["action_mask"][~episode.valid] = True
    _, unchanged = gradients(network, decisions_with_advantage(scrambled, advantage), 32, 1000)
    alone = []
    for row in range(32):
        length = int(episode.valid[:, row].sum())
        part = episode.decisions[:length, row].set("advantage", advantage[row].expand(length))
        alone.append(gradients(network, part, 32, 1000)[1][0])
    assert torch.equal(whole[0], unchanged[0])
    assert torch.allclose(whole[0], sum(alone), atol=1e-6)


@pytest.fixture(scope="module")
def learner():
    return ReinforceLearner(replace(TINY, batch_size=16))


@pytest.fixture
def decisions(learner):
    torch.manual_seed(0)
    problem = draw(np.random.default_rng(0), learner.config, 16)
    episode = play(learner.network, problem, learner.config, "sample", keep=True)
    return decisions_with_advantage(episode, torch.randn(16))


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1, 7, 50])
def test_chunks_add_up_to_the_whole(learner, decisions, chunk):
    loss, whole = gradients(learner.network, decisions, 16, len(decisions))
    chunked_loss, chunked = gradients(learner.network, decisions, 16, chunk)
    assert chunked_loss == pytest.approx(loss, abs=1e-5)
    for a, b in zip(whole, chunked, strict=True):
        assert torch.allclose(a, b, atol=1e-5)


def test_a_share_of_the_decisions_estimates_the_gradient_of_all(learner, decisions, monkeypatch):
    """Unbiased: averaged over all equally likely ways to leave one of N out, the estimate is the whole gradient."""
    assert subsample(decisions, 1.0) is decisions
    few = decisions[:12]
    _, whole = gradients(learner.network, few, 16, 12)
    without = []
    for left_out in range(12):
        order = torch.arange(12).roll(11 - left_out)  # the one that is left out comes last
        with monkeypatch.context() as patch:
            patch.setattr(torch, "randperm", lambda n, device, order=order: order)
            part = subsample(few, 11 / 12)
        assert len(part) == 11
        without.append(gradients(learner.network, part, 16, 12)[1])
    for each, exact in zip(zip(*without, strict=True), whole, strict=True):
        assert torch.allclose(sum(each) / 12, exact, atol=1e-5)

    torch.manual_seed(3)
    numbered = decisions.clone().set("number", torch.arange(len(decisions)))
    drawn = [subsample(numbered, 0.25) for _ in range(400)]
    count = round(0.25 * len(decisions))
    assert all(len(part) == count and (part["number"].diff() > 0).all() for part in drawn)
    for part in drawn[:5]:
        assert torch.allclose(part["advantage"], decisions["advantage"][part["number"]] * len(decisions) / count)
    often = torch.bincount(torch.cat([part["number"] for part in drawn]), minlength=len(decisions)) / 400
    assert (often - count / len(decisions)).abs().max() < 0.1  # 4.6 standard deviations
    assert len(subsample(decisions, 1e-9)) == 1


def test_the_loss_is_torchrls_reinforce_loss_with_another_average(learner, decisions):
    class NoCritic(nn.Module):
        def forward(self, cities):
            return cities.sum((-2, -1))[..., None] * 0

    critic = TensorDictModule(NoCritic(), ["cities"], ["state_value"])
    theirs = ReinforceLoss(make_actor(learner.network), critic, reduction="sum", functional=False)
    batch = decisions.clone().set("value_target", torch.zeros(len(decisions), 1))
    batch["advantage"] = batch["advantage"][:, None]
    ours = EpisodicReinforceLoss(make_actor(learner.network), 16)(decisions)["loss_actor"]
    assert torch.allclose(ours, theirs(batch)["loss_actor"] / 16, rtol=1e-5)
    assert EpisodicReinforceLoss(make_actor(learner.network), 16).in_keys == [
        "cities", "agents", "visited", "action_mask", "action", "advantage",
    ]  # fmt: skip


def test_recomputed_log_probabilities_are_those_that_were_sampled_from(learner, decisions):
    probability = make_actor(learner.network).get_dist(decisions).probs.gather(1, decisions["action"][:, None])[:, 0]
    assert torch.allclose(log_probs(make_actor(learner.network), decisions), probability.log(), atol=1e-5)
    assert (log_probs(make_actor(learner.network), decisions) <= 0).all()


def test_challenge_is_a_one_sided_paired_t_test():
    rng = np.random.default_rng(0)
    base = torch.as_tensor(rng.random(200))
    noise = torch.as_tensor(rng.normal(0, 0.1, 200))
    assert better(base - 0.05 + noise, base, 0.05)
    assert not better(base + 0.05 + noise, base, 0.05)
    assert not better(base - 0.001 + noise - noise.mean(), base, 0.05)
    assert not better(base, base, 0.05)
    assert better(base - 1.0, base, 0.05)


@pytest.mark.slow
def test_the_baseline_changes_only_when_beaten_and_then_draws_a_new_test_set(monkeypatch):
    rng = np.random.default_rng(0)
    good, bad = Preferences([-20.0] + [0.0] * 7), Preferences([20.0] + [0.0] * 7)  # the bad one goes home early
    config = replace(TINY, n_nodes=(8, 8), n_agents=(3, 3), challenge_instances=64)
    baseline = RolloutBaseline(bad, config, rng)
    problem = draw(rng, config, 10)
    zeros = torch.zeros(10)
    assert torch.equal(baseline.value(problem, zeros), play(bad, problem, config, "greedy").reward)
    first_set = baseline.test_set[0].nodes
    assert baseline.challenge(good) and not torch.equal(baseline.test_set[0].nodes, first_set)
    assert torch.equal(baseline.value(problem, zeros), play(good, problem, config, "greedy").reward)
    second_set = baseline.test_set[0].nodes
    assert not baseline.challenge(bad) and torch.equal(baseline.test_set[0].nodes, second_set)


def test_the_shared_baseline_leaves_each_episode_out():
    reward = torch.tensor([1.0, 2.0, 6.0, -1.0, -2.0, -3.0])
    value = SharedBaseline(3).value(None, reward)
    assert value.tolist() == [4.0, 3.5, 1.5, -2.5, -2.0, -1.5]


def test_the_shared_baseline_is_unbiased_but_would_not_be_if_it_included_the_sample_itself():
    """One decision between two actions, rewards 0 and 1, p = sigmoid(t): the exact gradient of E[R] is p (1 - p).
    The expectation runs over every outcome of three samples."""
    p = 0.3
    with_others = with_itself = 0.0
    for chosen in itertools.product((0, 1), repeat=3):
        probability = np.prod([p if c else 1 - p for c in chosen])
        reward = torch.tensor(chosen, dtype=torch.float64)
        score = reward - p  # d log p(choice) / dt
        advantage = reward - SharedBaseline(3).value(None, reward)
        with_others += probability * float((advantage * score).mean())
        with_itself += probability * float(((reward - reward.mean()) * score).mean())
    assert with_others == pytest.approx(p * (1 - p), abs=1e-12)
    assert with_itself == pytest.approx(2 / 3 * p * (1 - p), abs=1e-12)


def test_repeated_instances_are_symmetric_copies():
    nodes = torch.rand(2, 6, 2, dtype=torch.float64)
    repeated = repeat(Problem(2, {"nodes": nodes}), 9).nodes
    assert torch.equal(repeated[::9], nodes) and torch.equal(repeated[8::9], nodes)
    assert ((repeated >= 0) & (repeated <= 1)).all()
    lengths = torch.cdist(repeated, repeated)
    torch.testing.assert_close(lengths, torch.cdist(nodes, nodes).repeat_interleave(9, 0))
    assert len({tuple(row.flatten().tolist()) for row in repeated[:8]}) == 8


def test_shared_training_goes_through_the_same_step():
    config = replace(TINY, baseline="shared", samples=4, batch_size=5, normalise=True, batch_tokens=21)
    learner = ReinforceLearner(config)
    assert isinstance(learner.baseline, SharedBaseline)
    logs = learner.train_step()
    assert 21 // 8 <= learner.instances <= 21 // 5 and np.isfinite(logs["grad_norm"])


def test_a_curriculum_changes_the_ranges_at_its_steps():
    config = replace(TINY, curriculum=((2, 20, 30, 4, 5), (5, 40, 50, 6, 7)))
    assert config.at(1).n_nodes == (5, 8) and config.at(1).n_agents == (1, 3)
    assert config.at(2).n_nodes == (20, 30) and config.at(4).n_agents == (4, 5)
    assert config.at(5).n_nodes == (40, 50) and config.at(99).n_agents == (6, 7)


def test_drawn_sizes_cover_their_ranges():
    rng = np.random.default_rng(0)
    sizes = {(part.nodes.shape[1], part.n_agents) for part in (draw(rng, TINY, 2) for _ in range(200))}
    assert sizes == {(n, m) for n in range(5, 9) for m in range(1, 4)}
    assert sum(len(part.nodes) for part in draw_set(rng, TINY, 21)) == 21


@pytest.mark.slow
def test_the_policy_is_the_running_average_of_the_weights(tmp_path):
    plain, averaged = (
        ReinforceLearner(replace(TINY, out=tmp_path / str(decay), average=decay)) for decay in (0.0, 0.75)
    )
    expected: dict[str, torch.Tensor] = {}
    for _ in range(3):
        plain.train_step()
        averaged.train_step()
        for name, weight in averaged.network.state_dict().items():
            expected[name] = 0.75 * expected.get(name, weight) + 0.25 * weight
    assert same(dict(plain.averaged_network.state_dict()), dict(plain.network.state_dict()))
    averages = averaged.averaged_network.state_dict()
    assert max(float((averages[name] - weight).abs().max()) for name, weight in expected.items()) < 1e-6
    assert not same(dict(averages), dict(averaged.network.state_dict()))


@pytest.mark.slow
def test_training_lowers_the_greedy_cost_on_held_out_instances(tmp_path):
    """80 steps at n = 10, m = 2."""
    config = replace(
        TINY, out=tmp_path, n_nodes=(10, 10), n_agents=(2, 2), batch_size=64, steps=80, seed=1,
        learning_rate=2e-3, decay_every=1000,
        network=DANConfig(embed_dim=64, feedforward_dim=128, n_heads=4, city_layers=1, prune_visited=True),
        challenge_every=20, challenge_instances=128, validate_every=1000, checkpoint_every=1000,
    )  # fmt: skip
    held_out = draw_set(np.random.default_rng(77), config, 256)
    before = costs(ReinforceLearner(config).network, held_out, config)
    after = costs(reinforce(config).network, held_out, config)
    assert better(after, before, 1e-6)
    assert after.mean() < 0.65 * before.mean()  # 0.59; the nearest city: 0.60


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_nodes": (1, 5)}, r"n_nodes\[0\] must be a whole number of at least 2, got 1"),
        ({"n_agents": (3, 2)}, r"n_agents\[1\] must be a whole number of at least 3, got 2"),
        ({"batch_size": 0}, "batch_size must be a whole number of at least 1, got 0"),
        ({"learning_rate": 0.0}, "learning_rate must be above 0"),
        ({"learning_rate": 1e30}, r"learning_rate must be above 0 and at most 1, got 1e\+30"),
        ({"learning_rate": np.inf}, "learning_rate must be above 0 and at most 1, got inf"),
        ({"decay": 1.5}, "decay must be above 0 and at most 1, got 1.5"),
        ({"seconds": 0.0}, "seconds must be a finite number of seconds above 0, got 0.0"),
        ({"seconds": np.nan}, "seconds must be a finite number of seconds above 0, got nan"),
        ({"threads": -1}, "threads must be None or from 1 to 1024, got -1"),
        ({"threads": 10**6}, "threads must be None or from 1 to 1024, got 1000000"),
        ({"seed": -1}, r"seed must be at least 0 and below 2\^63, got -1"),
        ({"seed": 2**63}, "seed must be at least 0"),
        ({"normalise": True, "batch_size": 1}, "normalise needs at least 2 episodes per step: raise batch_size=1"),
        ({"normalise": True, "batch_tokens": 199}, "normalise needs at least 2 episodes per step: .*batch_tokens=199"),
        ({"decisions": 0.0}, "decisions must be above 0 and at most 1, got 0.0"),
        ({"challenge_p": 1.0}, "challenge_p must lie between 0 and 1"),
        ({"seconds": -1.0}, "seconds must be .*, got -1.0"),
        ({"policy": "nobody"}, r"policy must be package.module:factory or one of \['dan'.*\], got 'nobody'"),
        ({"policy_options": {"layers": 2}}, "policy_options must be empty for the policy 'dan'"),
        ({"distribution": "normal"}, "unknown distribution 'normal'"),
        ({"baseline": "shared"}, "samples must be a whole number of at least 2, got 1"),
        ({"curriculum": ((0, 9, 8, 1, 2),)}, r"n_nodes\[1\] must be a whole number of at least 9, got 8"),
        ({"nodes_per_agent": 5}, r"nodes_per_agent must be at most n_nodes\[0\] // n_agents\[0\] = 4, got 5"),
    ],
)
def test_bad_configurations_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ReinforceConfig(**kwargs)


@pytest.mark.slow
def test_a_gradient_that_is_not_finite_changes_nothing(tmp_path, capsys, monkeypatch):
    learner = ReinforceLearner(replace(TINY, out=tmp_path))
    before = {name: weight.clone() for name, weight in learner.network.state_dict().items()}
    value = learner.baseline.value
    monkeypatch.setattr(learner.baseline, "value", lambda *arguments: value(*arguments) * torch.inf)
    with pytest.raises(FloatingPointError, match=r"step 1: the norm of the gradient is (nan|inf)\. .*lower"):
        learner.train_step()
    assert learner.step == 0 and same(dict(learner.network.state_dict()), before)


def test_presets_follow_the_paper():
    assert (PAPER.n_nodes, PAPER.n_agents, PAPER.speed, PAPER.batch_size) == ((20, 100), (5, 10), 0.1, 8)
    late = PAPER.at(4 * PAPER.steps // 5)  # the last 24 of 120 hours
    assert PAPER.at(4 * PAPER.steps // 5 - 1) is PAPER and (late.n_nodes, late.n_agents) == ((20, 200), (5, 10))
    assert (PAPER.learning_rate, PAPER.decay, PAPER.decay_every, PAPER.depot) == (1e-5, 0.96, 1024, "open")


@pytest.mark.slow
def test_the_command_line_trains_and_reports_bad_input(tmp_path, capsys):
    small = ["--n-nodes", "5", "6", "--batch-size", "4", "--network.embed-dim", "16", "--challenge-instances", "4",
             "--validation-instances", "4", "--out", str(tmp_path), "--no-tensorboard"]  # fmt: skip
    assert main(["reinforce", "quick", "--steps", "2", *small]) == 0
    assert main(["reinforce", "quick", "--steps", "2", *small]) == 2
    assert "add --resume" in capsys.readouterr().err
    assert main(["reinforce", "quick", "--steps", "3", "--resume", *small]) == 0
    assert checkpoint.read(tmp_path / "checkpoint.pt")["progress"]["step"] == 3


@pytest.mark.slow
def test_precision_is_a_setting():
    config = replace(TINY, precision="bfloat16")
    learner = ReinforceLearner(config)
    logs = learner.train_step()
    assert np.isfinite(logs["grad_norm"]) and logs["grad_norm"] > 0
    problem = Problem(2, {"nodes": torch.rand(4, 6, 2, dtype=torch.float64)})
    wide = play(learner.network, problem, replace(config, precision="float32"), "greedy").reward
    assert wide.dtype == torch.float32
