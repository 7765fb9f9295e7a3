"""The compiled loops: the same arrays as ``rules.py``, bit for bit, and errors instead of reads past an array's end."""

import numpy as np
import pytest
import torch
from helpers.faces import play_random
from tensordict import TensorDict

from mtsp_env import kernels, rules
from mtsp_env.batched import BatchedMTSP
from mtsp_env.instance import Problem

SEEDS = [seed for seed in range(90) if play_random(seed)[0].rules.depot != "wait"]


def check_same(quick: dict[str, np.ndarray], plain: dict[str, np.ndarray]) -> None:
    assert quick.keys() == plain.keys()
    for name, array in plain.items():
        assert (quick[name].dtype, quick[name].shape) == (array.dtype, array.shape), name
        assert quick[name].tobytes() == array.tobytes(), name


@pytest.mark.parametrize("seed", SEEDS)
def test_same_arrays_as_the_rules(seed: int) -> None:
    """At every decision of random games, and in rows that are over while others go on."""
    game, traces = play_random(seed)
    state = rules.start(Problem(game.n_agents, {"nodes": game.nodes}), game.rules)
    for k in range(max(len(trace.actions) for trace in traces) + 2):
        check_same(kernels.observe(state, game.rules).arrays(), rules.observe(state, game.rules).arrays())
        action = np.array([trace.actions[k] if k < len(trace.actions) else 0 for trace in traces])
        before = {name: array.copy() for name, array in state.arrays().items()}
        after = rules.depart(state, game.rules, action)
        check_same(kernels.depart(state, game.rules, action).arrays(), after.arrays())
        check_same(state.arrays(), before)  # nothing changes in place
        state = after


def test_which_games_they_know() -> None:
    plain = rules.make_rules(9, 3, 0.1, "final", "shaped", None)
    assert kernels.can_play((), plain)
    assert not kernels.can_play(("service",), plain)
    for depot, view, hearing in (("wait", None, None), ("open", 3, None), ("open", None, 0.5)):
        assert not kernels.can_play((), rules.make_rules(9, 3, 0.1, depot, "sparse", None, view, hearing))


def games(**settings: object) -> list[TensorDict]:
    """A whole game of random decisions, the same whatever the settings."""
    torch.manual_seed(0)
    env = BatchedMTSP(9, 3, 5, seed=1, speed=0.1, **settings)
    steps = [env.reset()]
    while not steps[-1]["done"].all():
        steps.append(env.step(env.rand_action(steps[-1]))["next"])
    return steps


@pytest.mark.parametrize("error", [ImportError("no Numba"), RuntimeError("no folder for the cache")], ids=str)
def test_without_the_kernels_the_environment_plays_the_same(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> None:
        raise error

    quick = games()
    monkeypatch.setattr("mtsp_env.batched.import_module", fail)
    assert BatchedMTSP(9, 3, 5)._numpy_rules is rules
    plain = games()
    assert len(plain) == len(quick)
    for one, other in zip(quick, plain, strict=True):
        assert all(torch.equal(one[key], other[key]) for key in one.keys(True, True) if key != "action")


def test_an_environment_uses_them_if_it_can() -> None:
    assert BatchedMTSP(9, 3, 5)._numpy_rules is kernels
    assert BatchedMTSP(9, 3, 5, scenario="service")._numpy_rules is rules
    assert BatchedMTSP(9, 3, 5, depot="wait")._numpy_rules is rules


@pytest.mark.parametrize("node", [-1, 9, 2**40])
def test_what_is_no_node_is_an_error(node: int) -> None:
    """Also in an environment that does not check actions."""
    env = BatchedMTSP(9, 3, 5, check_actions=False)
    td = env.reset()
    wrong = td["action_mask"].to(torch.int64).argmax(1)
    wrong[3] = node
    with pytest.raises(IndexError, match="no node"):
        env.step(td.clone().set("action", wrong))
    td = env.reset()
    td["game", "destination"][2, 0] = node
    with pytest.raises(IndexError, match="no node"):
        env.step(td.clone().set("action", td["action_mask"].to(torch.int64).argmax(1)))
    with pytest.raises(IndexError, match="no node"):
        env.reset(td, set_state=True)


def test_tensors_of_any_layout() -> None:
    """States cut from a stack of steps are not contiguous; stepping from them gives what stepping from copies gives."""
    steps = games()
    td = torch.stack([step.exclude("reward", "next", "action") for step in steps[:-1]], dim=1)[:, 2]
    env = BatchedMTSP(9, 3, 5, speed=0.1)
    action = td["action_mask"].to(torch.int64).argmax(1)
    assert not td["cities"].is_contiguous()
    cut, copy = (env.step(start.set("action", action))["next"] for start in (td.clone(False), td.contiguous()))
    assert all(torch.equal(cut[key], copy[key]) for key in cut.keys(True, True))


def test_they_are_compiled_once() -> None:
    """All batches, sizes and settings share one version of each kernel: another one would take seconds."""
    for batch, n_nodes, n_agents in ((1, 2, 1), (3, 9, 2), (64, 30, 31)):
        for depot in ("open", "final"):
            env = BatchedMTSP(n_nodes, n_agents, batch, depot=depot)
            td = env.step(env.rand_action(env.reset()))["next"]
            env.step(env.rand_action(td.clone()))
    assert len(kernels._depart.signatures) == len(kernels._observe.signatures) == 1
