"""Whole episodes of a policy in a batched environment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from dan_policy.actor import as_actor
from dan_policy.network import Decode, Key, Network
from mtsp_env.checks import check_count
from mtsp_env.instance import Problem

EXPLORATION = {"greedy": ExplorationType.DETERMINISTIC, "sample": ExplorationType.RANDOM}


@dataclass(frozen=True)
class Episode:
    """One whole episode per row of a batch, and nothing after its end.

    Attributes:
        decisions: TensorDict of shape [T, B]: the kept keys of the observation that each decision was based on, and
            ``action``; None if no keys were to be kept. T is the length of the longest episode.
        valid: (T, B) bool, False once a row's episode is over.
        reward: (B,) float32, each episode's undiscounted sum of rewards.
        last: TensorDict of shape [B], the last state of every row.
    """

    decisions: TensorDictBase | None
    valid: Tensor
    reward: Tensor
    last: TensorDictBase


@torch.no_grad()
def rollout(
    policy: Network | TensorDictModuleBase,
    env: EnvBase,
    decode: Decode = "sample",
    instances: Tensor | Problem | TensorDictBase | None = None,
    keep: Sequence[Key] = (),
    max_decisions: int | None = None,
) -> Episode:
    """Play every row of ``env`` from a reset to its end, or for ``max_decisions`` decisions.

    ``env.rollout(break_when_all_done=True)`` would do the same with more overhead per step, and its rows would go on
    after their end. TorchRL's exploration type, which is shared by all threads of a process, is set during the call.

    Args:
        policy: a network as ``make_actor`` takes it, or an actor that reads the observation and writes ``action``.
        env: a TorchRL environment of batch size [B] whose episodes end by themselves, such as ``BatchedMTSP``.
        decode: "greedy" takes the likeliest action, "sample" draws one from torch's global generator.
        instances: the instances to play: nodes (B, n, 2), a ``Problem`` of B instances, or a TensorDict of batch size
            [B] with the key "game", which may hold a whole state to go on from. None draws fresh ones.
        keep: keys of the observation to keep in ``decisions`` beside ``action``; nested keys are tuples.
        max_decisions: decisions of each row, at least 1; None plays to the end.

    Raises:
        ValueError: an unknown ``decode``, ``max_decisions`` below 1, or instances that do not fit ``env``.
    """
    if max_decisions is not None:
        check_count("max_decisions", max_decisions, minimum=1)
    if decode not in EXPLORATION:
        raise ValueError(f"unknown decode {decode!r}; choose from {sorted(EXPLORATION)}")
    actor = as_actor(policy)
    td = env.reset() if instances is None else env.reset(_as_tensordict(instances, env), set_state=True)
    decisions: list[TensorDictBase] = []
    valid: list[Tensor] = []
    reward = torch.zeros(env.batch_size, device=env.device)
    over = td["done"][..., 0].clone()
    with set_exploration_type(EXPLORATION[decode]):
        while len(valid) != max_decisions and not over.all():  # the one wait for the device per decision
            td = actor(td)
            if keep:
                decisions.append(td.select(*keep, "action"))
            valid.append(~over)
            td = env.step(td)["next"]
            reward += torch.where(over, 0.0, td["reward"][..., 0])
            over = over | td["done"][..., 0]
    return Episode(torch.stack(decisions) if decisions else None, torch.stack(valid), reward, td)


def _as_tensordict(instances: Tensor | Problem | TensorDictBase, env: EnvBase) -> TensorDictBase:
    if isinstance(instances, TensorDictBase):
        return instances
    arrays = instances.arrays if isinstance(instances, Problem) else {"nodes": instances}
    tensors = {name: torch.as_tensor(array, device=env.device) for name, array in arrays.items()}
    size = {"batch_size": tensors["nodes"].shape[:1], "device": env.device}
    return TensorDict({"game": TensorDict(tensors, **size)}, **size)
