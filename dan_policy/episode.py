"""Whole episodes of a policy in a batched environment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from mtsp_env.checks import check_count

Decode = Literal["greedy", "sample"]
EXPLORATION = {"greedy": ExplorationType.DETERMINISTIC, "sample": ExplorationType.RANDOM}


@dataclass(frozen=True)
class Episode:
    """One whole episode per row of a batch, and nothing after its end.

    Attributes:
        decisions: TensorDict of shape [T, B]: the observation that each decision was made on, and ``action``; None
            where they were not asked for. T is the longest episode's length.
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
    actor: nn.Module,
    env: EnvBase,
    decode: Decode = "sample",
    nodes: Tensor | TensorDictBase | None = None,
    keep: tuple[str, ...] = (),
    most: int | None = None,
) -> Episode:
    """Play every row of ``env`` from a reset to its end, or for ``most`` decisions.

    ``env.rollout(break_when_all_done=True)`` would do the same with more overhead a step and rows that repeat
    themselves after their end.

    Args:
        actor: reads the observation and writes ``action``, as ``make_actor`` builds it.
        env: a TorchRL environment of batch size [B] whose episodes end by themselves.
        decode: "greedy" takes the likeliest action, "sample" draws one (from torch's global generator).
        nodes: (B, n, 2), instances to replay, or a TensorDict of whole states to go on from; None draws fresh ones.
        keep: keys of the observation to keep in ``decisions`` beside ``action``; none: ``decisions`` is None.
        most: decisions of each row, at least 1; None: until its end.

    Raises:
        ValueError: an unknown ``decode``, or ``most`` below 1.
    """
    if most is not None:
        check_count("most", most, minimum=1)
    if decode not in EXPLORATION:
        raise ValueError(f"unknown decode {decode!r}; choose from {sorted(EXPLORATION)}")
    if isinstance(nodes, Tensor):
        nodes = TensorDict({"game": {"nodes": nodes}}, batch_size=env.batch_size, device=env.device)
    td = env.reset() if nodes is None else env.reset(nodes, set_state=True)
    kept, valid = [], []
    reward = torch.zeros(env.batch_size, device=env.device)
    over = td["done"][..., 0].clone()
    with set_exploration_type(EXPLORATION[decode]):
        while len(valid) != most and not over.all():  # the one wait for the device per decision
            td = actor(td)
            if keep:
                kept.append(td.select(*keep, "action"))
            valid.append(~over)
            td = step_mdp(env.step(td), exclude_reward=False)
            reward += torch.where(over, 0.0, td["reward"][..., 0])
            over = over | td["done"][..., 0]
    return Episode(torch.stack(kept) if kept else None, torch.stack(valid), reward, td)


def find_device(device: torch.device | str | None = None) -> torch.device:
    """The device of that name; None takes a GPU where there is one.

    Raises:
        ValueError: no such device, or none here.
    """
    try:
        found = torch.device(device or ("cuda" if torch.cuda.is_available() else "cpu"))
        torch.empty(0, device=found)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f"no device {str(device)!r} here; choose for example 'cpu' or 'cuda' ({reason})") from error
    return found
