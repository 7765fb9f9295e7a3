"""The TorchRL face: specs, resets, replay, seeds, and the same games whatever the batch."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs, step_mdp

from mtsp_env import Instance, check_tours, lower_bound, makespan, rules
from mtsp_env.batched import BatchedMTSP, masked_random_policy, random_legal_action

GAME = [("game", key) for key in ("nodes", *rules.state_fields(()))]
DEVICES = [
    "cpu",
    pytest.param(
        "cuda", marks=[pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")]
    ),
]


def make(batch=6, n_nodes=9, n_agents=3, **kwargs):
    return BatchedMTSP(n_nodes, n_agents, [batch], **{"seed": 0, "speed": 0.1, **kwargs})


def given(nodes):
    return TensorDict({"game": {"nodes": torch.as_tensor(nodes)}}, batch_size=[len(nodes)])


def play(env, td):
    """Random legal play to the end; returns every root TensorDict on the way and the last one."""
    steps = []
    while not td["done"].all():
        td = env.rand_action(td)
        steps.append(td.clone())
        td = step_mdp(env.step(td), exclude_reward=False)
    return steps, td


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("depot", ["open", "final"])
@pytest.mark.parametrize("reward", ["sparse", "shaped"])
def test_specs_hold_in_both_break_modes(depot, reward, device):
    check_env_specs(make(depot=depot, reward=reward, device=device), break_when_any_done="both")


def test_root_keys_are_the_documented_ones():
    env = make()
    td = env.step(env.rand_action(env.reset()))
    observed = {"cities", "agents", "visited", "action_mask", "agent"}
    ends = {"done", "terminated", "truncated"}
    assert set(td.keys()) == observed | ends | {"game", "action", "next"}
    assert set(td["next"].keys()) == observed | ends | {"game", "reward"}
    assert set(td["game"].keys()) == {"nodes", *rules.state_fields(())}
    assert td["next", "reward"].shape == (6, 1) and td["cities"].dtype == torch.float32


@pytest.mark.parametrize("depot", ["open", "final"])
def test_finished_games_are_valid_and_the_reward_is_the_judged_makespan(depot):
    env = make(batch=32, depot=depot)
    td = env.reset()
    total, first_done = torch.zeros(32), torch.zeros(32, dtype=torch.bool)
    while not td["done"].all():
        td = step_mdp(env.step(env.rand_action(td)), exclude_reward=False)
        total += torch.where(first_done, 0.0, td["reward"][:, 0])
        first_done |= td["done"][:, 0]
    cost = env.makespan(td)
    for row, tours in enumerate(env.tours(td)):
        instance = Instance(td["game", "nodes"][row].numpy(), 3)
        check_tours(instance, tours)
        judged = makespan(instance, tours)
        assert cost[row] == pytest.approx(judged, abs=1e-9)
        assert -total[row] == pytest.approx(judged, rel=1e-6)
        assert judged >= lower_bound(instance) - 1e-9


def test_seeds_repeat_and_differ():
    first, again, other = (make(seed=seed).reset()["game", "nodes"] for seed in (1, 1, 2))
    assert torch.equal(first, again) and not torch.equal(first, other)
    env = make(seed=5)
    env.set_seed(1)
    assert torch.equal(env.reset()["game", "nodes"], first)
    assert not torch.equal(env.reset()["game", "nodes"], first)


def test_given_instances_are_replayed_exactly():
    env = make()
    nodes = np.random.default_rng(3).random((6, 9, 2))
    td = env.reset(given(nodes), set_state=True)
    assert np.array_equal(td["game", "nodes"].numpy(), nodes)
    steps, _ = play(env, td)
    replay = env.reset(given(nodes), set_state=True)
    for step in steps:
        for key in ("cities", "agents", "visited", "action_mask", "agent"):
            assert torch.equal(replay[key], step[key]), key
        replay = step_mdp(env.step(replay.set("action", step["action"])))


def test_a_game_continues_from_any_saved_state():
    env = make()
    td = env.reset()
    for _ in range(4):
        td = step_mdp(env.step(env.rand_action(td)))
    resumed = make(seed=99).reset(td.select("game"), set_state=True)
    for key in ("cities", "agents", "visited", "action_mask", "agent", "done"):
        assert torch.equal(resumed[key], td[key]), key


def test_partial_resets_leave_other_rows_bit_identical():
    env = make()
    td = env.reset()
    for _ in range(3):
        td = step_mdp(env.step(env.rand_action(td)))
    before = td.clone()
    reset = torch.tensor([True, False, False, True, False, False])
    after = env.reset(td.set("_reset", reset[:, None]), set_state=False)
    for key in (*GAME, "cities", "agents", "visited", "action_mask"):
        assert torch.equal(after[key][~reset], before[key][~reset]), key
    assert (after["game", "decisions"][reset] == 0).all()
    assert not torch.equal(after["game", "nodes"][reset], before["game", "nodes"][reset])
    fresh = after["game", "nodes"][reset]  # (2, n, 2), instances of their own
    assert not torch.equal(fresh[0], fresh[1]) and (fresh.std(1) > 0.05).all()


@pytest.mark.parametrize("depot", ["open", "final"])
def test_a_row_of_many_equals_a_batch_of_one(depot):
    env = make(batch=64, depot=depot)
    td = env.reset()
    nodes = td["game", "nodes"].clone()
    steps, _ = play(env, td)
    for row in (0, 17, 63):
        alone = make(batch=1, depot=depot)
        one = alone.reset(given(nodes[row : row + 1]), set_state=True)
        for step in steps:
            for key in ("cities", "agents", "visited", "action_mask", "agent", *GAME):
                assert torch.equal(one[key][0], step[key][row]), key
            if one["done"].all():
                break
            one = step_mdp(alone.step(one.set("action", step["action"][row : row + 1])))


@pytest.mark.slow
def test_auto_reset_never_offers_or_takes_an_illegal_action():
    env = make(batch=500, n_nodes=8, n_agents=3, depot="open")
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
    assert resets > 1000


def test_torchrl_rollout_agrees_with_stepping():
    env = make(seed=4)
    torch.manual_seed(0)
    data = env.rollout(1000, break_when_any_done=False, break_when_all_done=True)
    assert data["next", "done"].any(1).all()


def test_distributions_fill_the_batch():
    nodes = make(distribution="clustered").reset()["game", "nodes"]
    assert nodes.shape == (6, 9, 2) and nodes.min() >= 0 and nodes.max() <= 1


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_nodes": 1}, "n_nodes must be a whole number of at least 2, got 1"),
        ({"n_agents": 0}, "n_agents must be a whole number of at least 1, got 0"),
        ({"batch": 0}, "batch_size must be a whole number of at least 1, got 0"),
        ({"speed": 0.0}, "speed must be a finite distance"),
        ({"depot": "closed"}, "unknown depot rule 'closed'"),
        ({"reward": "dense"}, "unknown reward 'dense'"),
        ({"max_decisions": 0}, "max_decisions must be a whole number of at least 1, got 0"),
        ({"distribution": "normal"}, "unknown distribution 'normal'"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


@pytest.mark.parametrize("action", [0, 3, 9, -1])
def test_an_illegal_action_names_row_agent_and_choices(action):
    env = make()
    td = env.reset()  # nobody may wait while everybody is at the depot
    td = step_mdp(env.step(td.set("action", torch.full((6,), 3))))
    actions = torch.full((6,), 4)
    actions[2] = action
    if action == 0:
        td = env.reset()
    with pytest.raises(ValueError, match=rf"of row 2 may not go to node {action}; legal are \["):
        env.step(td.set("action", actions))


def test_bad_replays_are_refused():
    env = make()
    with pytest.raises(ValueError, match="nodes must have shape"):
        env.reset(given(np.zeros((6, 8, 2))), set_state=True)
    with pytest.raises(ValueError, match=r"nodes must be in \[0, 1\]"):
        env.reset(given(np.full((6, 9, 2), 2.0)), set_state=True)
    with pytest.raises(ValueError, match="call reset"):
        make().tours()


def test_truncation_adds_a_round_trip_to_every_unvisited_city():
    env = make(batch=4, max_decisions=2)
    _, td = play(env, env.reset())
    assert td["truncated"].all() and not td["terminated"].any()
    nodes = td["game", "nodes"]
    trips = 2 * (nodes - nodes[:, :1]).norm(dim=2) * ~td["visited"]
    so_far = torch.tensor([makespan(Instance(x.numpy(), 3), t) for x, t in zip(nodes, env.tours(td), strict=True)])
    assert torch.allclose(-td["reward"][:, 0].double(), so_far + trips.sum(1), rtol=1e-6)


# What TorchRL's own tools need


def test_a_batch_size_may_be_a_number():
    assert BatchedMTSP(9, 3, 4).batch_size == torch.Size([4])
    with pytest.raises(ValueError, match=r"batch_size must be B or \[B\], got \[2, 3\]"):
        BatchedMTSP(9, 3, [2, 3])


def test_actions_of_any_whole_number_type_and_layout_are_accepted():
    env = make()
    td = env.reset()
    action = random_legal_action(td["action_mask"])
    expected = env.step(td.clone().set("action", action))["next"]
    for same in (action.to(torch.int32), action.to(torch.uint8), torch.stack([action, action], 1)[:, 0]):
        after = env.step(td.clone().set("action", same))["next"]
        assert all(torch.equal(after[key], expected[key]) for key in [*GAME, "cities", "agents", "action_mask"])
    for wrong in (action.float(), action > 0, action[:, None], action[:3]):
        with pytest.raises(ValueError, match=r"action must be whole numbers of shape \(6,\), got"):
            env._step(TensorDict({"action": wrong, "game": td["game"]}))


def test_a_reset_continues_from_a_given_state_only_with_set_state():
    env, other = make(seed=3), make(seed=3)
    state = env.reset()
    other.reset()
    assert torch.equal(env.reset(state, set_state=False)["game", "nodes"], other.reset()["game", "nodes"])
    assert torch.equal(env.reset(state, set_state=True)["game", "nodes"], state["game", "nodes"])
    with pytest.warns(FutureWarning, match="set_state"):  # TorchRL's own default changes
        env.reset(state)


def test_a_step_changes_nothing_that_came_before():
    env = make(depot="final")
    td = env.rand_action(env.reset())
    before = td.clone()
    env.step(td)
    assert all(torch.equal(td[key], before[key]) for key in before.keys(True, True))


@pytest.mark.parametrize("kind", [SerialEnv, ParallelEnv])
@pytest.mark.slow
def test_the_masked_random_policy_plays_in_environments_of_workers(kind):
    """Each worker's games, and their seeds, are its own; nobody takes an illegal action."""
    env = kind(2, partial(BatchedMTSP, 7, 2, 3, depot="final"))
    try:
        env.set_seed(5)
        torch.manual_seed(0)
        data = env.rollout(20, masked_random_policy(), break_when_any_done=False, auto_reset=True)
        taken = data["action_mask"].gather(-1, data["action"][..., None])
        assert taken.all() and data["next", "done"].any()
        nodes = data["game", "nodes"][:, :, 0]  # (2, 3, n, 2)
        assert not torch.equal(nodes[0], nodes[1])
        env.set_seed(5)
        assert torch.equal(env.reset()["game", "nodes"], nodes)
    finally:
        env.close()


def test_the_masked_random_policy_feeds_a_collector():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        collector = Collector(make(depot="final"), masked_random_policy(), frames_per_batch=60, total_frames=120)
    for batch in collector:
        assert batch["action_mask"].gather(-1, batch["action"][..., None]).all()
    collector.shutdown()


def test_random_legal_actions_are_uniform():
    mask = torch.tensor([True, False, True, True, False]).expand(30_000, -1)
    counts = torch.bincount(random_legal_action(mask, torch.Generator().manual_seed(0)), minlength=5)
    assert counts[[1, 4]].sum() == 0
    assert (counts[[0, 2, 3]] - 10_000).abs().max() < 5 * (30_000 * 2 / 9) ** 0.5  # five standard deviations


# Compilation, and distributions given as functions


@pytest.mark.slow
@pytest.mark.parametrize("depot", ["open", "final"])
def test_compiled_rules_play_the_same_games(depot):
    compiled, eager = make(depot=depot, compile=True), make(depot=depot)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "torch.compile failed")
        steps, last = play(eager, eager.reset())
        td = compiled.reset()
        for step in steps:
            for key in [*GAME, "cities", "agents", "visited", "action_mask", "agent", "done"]:
                torch.testing.assert_close(td[key], step[key], rtol=0, atol=1e-12 if key in GAME else 1e-6)
            td = compiled.step(td.set("action", step["action"]))["next"]
    torch.testing.assert_close(td["reward"], last["reward"])


def test_rules_that_cannot_be_compiled_run_uncompiled(monkeypatch):
    def broken(function, **options):
        def fails(*args):
            raise RuntimeError("no compiler\nin sight")

        return fails

    monkeypatch.setattr(torch, "compile", broken)
    env, plain = make(compile=True), make()
    td, expected = env.reset(), plain.reset()
    action = random_legal_action(td["action_mask"])
    with pytest.warns(UserWarning, match="torch.compile failed, the rules run without it: RuntimeError: no compiler"):
        td = env.step(td.set("action", action))["next"]
    assert torch.equal(td["cities"], plain.step(expected.set("action", action))["next", "cities"])


def test_a_distribution_may_be_a_function():
    def on_a_line(rng, batch, n_nodes, n_agents):
        return {"nodes": np.stack([rng.random((batch, n_nodes)), np.full((batch, n_nodes), 1 / n_agents)], axis=2)}

    nodes = make(distribution=on_a_line).reset()["game", "nodes"]
    assert (nodes[..., 1] == 1 / 3).all() and nodes[..., 0].unique().numel() == 6 * 9
    with pytest.raises(ValueError, match="a distribution must return a dict of arrays"):
        make(distribution=lambda *_: np.zeros((6, 9, 2))).reset()
    with pytest.raises(ValueError, match=r"nodes must have shape \(6, 9, 2\), got \(6, 8, 2\)"):
        make(distribution=lambda *_: {"nodes": np.zeros((6, 8, 2))}).reset()
    with pytest.raises(ValueError, match="unknown field 'city'"):
        make(distribution=lambda *_: {"nodes": np.zeros((6, 9, 2)), "city": np.zeros((6, 9))}).reset()
    with pytest.raises(ValueError, match=r"\['speeds'\] must come from the scenario"):
        make(distribution=lambda *_: {"nodes": np.zeros((6, 9, 2)), "speeds": np.ones((6, 3))}).reset()
