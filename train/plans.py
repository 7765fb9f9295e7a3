"""Dense supervision: the teacher's plan says every agent's next node, and which agent visits each city.

A decision on its own labels the next node of one agent. The rest of the plan is what that agent should expect of the
others, which the paper says that DAN learns implicitly ("whether city i will be selected by agent j"). A network with
``forward_dense`` learns it from these labels.
"""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from dan_policy.actor import Key
from dan_policy.joint import DenseLogits
from train.demonstrations import Demonstrations

PLAN_KEYS: tuple[Key, ...] = ("visited", "agent", ("game", "destination"))
"""What ``add_plans`` and ``plan_losses`` read from a decision."""


def add_plans(decisions: TensorDictBase, demonstrations: Demonstrations) -> TensorDictBase:
    """Label decisions with the teacher's plan for all agents.

    Args:
        decisions: TensorDict [T, B] with ``PLAN_KEYS``.
        demonstrations: the set that they come from.

    Returns:
        ``decisions`` with a TensorDict ``plan``:

        - ``next`` (T, B, m) int64, the node that follows the one at which an agent stands or to which it is heading;
        - ``closed`` (T, B, m) bool, True for an agent that is home or heading home for good, and has no next node;
        - ``visitor`` (T, B, n) int64, the agent that visits a city; 0 at the depot.
    """
    first, following, visitor = (
        torch.as_tensor(part, device=decisions.device).expand(len(decisions), -1, -1)
        for part in (demonstrations.first, demonstrations.following, visitors(demonstrations))
    )
    destination = decisions["game", "destination"]  # (T, B, m)
    at_depot = destination == 0
    has_left = ~at_depot | decisions["visited"].gather(2, first)
    plan = {
        "next": torch.where(has_left, following.gather(2, destination), first),
        "closed": has_left & at_depot,
        "visitor": visitor,
    }
    return decisions.set("plan", TensorDict(plan, decisions.batch_size, device=decisions.device))


def visitors(demonstrations: Demonstrations) -> np.ndarray:
    """(B, n) int64: the agent that visits each city; 0 at the depot."""
    visitor = np.zeros_like(demonstrations.following)
    agents = np.broadcast_to(np.arange(demonstrations.first.shape[1]), demonstrations.first.shape)
    node = demonstrations.first  # (B, m)
    while node.any():
        np.put_along_axis(visitor, node, agents, axis=1)
        node = np.take_along_axis(demonstrations.following, node, axis=1)
    visitor[:, 0] = 0
    return visitor


def plan_losses(logits: DenseLogits, decisions: TensorDictBase) -> tuple[Tensor, Tensor]:
    """Cross-entropies of dense outputs with the teacher's plans.

    Agents that have closed their tours count in neither. Agents that have not left the depot look alike to the network,
    which learns that each of them may take any of their tours.

    Args:
        logits: the network's outputs for N decisions.
        decisions: TensorDict [N] with ``PLAN_KEYS`` and ``plan``.

    Returns:
        The mean over the next nodes of all agents except the deciding ones, and the mean over the visitors of all
        unvisited cities; () each, 0 if there are none or if the network has no such output.
    """
    plan, visited = decisions["plan"], decisions["visited"]
    next_loss = assignment_loss = logits.policy.new_zeros(())
    if logits.next is not None:
        deciding = torch.arange(logits.next.shape[1], device=visited.device) == decisions["agent"][:, None]  # (N, m)
        log_prob = logits.next.masked_fill(visited[:, None], -torch.inf).log_softmax(2)  # (N, m, n)
        log_prob = log_prob.gather(2, plan["next"][:, :, None])[:, :, 0][~deciding & ~plan["closed"]]
        next_loss = -log_prob.sum() / max(1, len(log_prob))
    if logits.assignment is not None:
        log_prob = logits.assignment.masked_fill(plan["closed"][:, :, None], -torch.inf).log_softmax(1)  # (N, m, n)
        is_city = ~visited
        is_city[:, 0] = False
        log_prob = log_prob.gather(1, plan["visitor"][:, None])[:, 0][is_city]
        assignment_loss = -log_prob.sum() / max(1, len(log_prob))
    return next_loss, assignment_loss
