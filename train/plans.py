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
from torch.nn import functional

from dan_policy.layers import DenseLogits
from dan_policy.network import Key
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
    plan = decisions["plan"]
    next_loss = assignment_loss = logits.policy.new_zeros(())
    if logits.next is not None:
        log_prob = _next_log_probs(logits.next, decisions).gather(2, plan["next"][:, :, None])[:, :, 0]
        log_prob = log_prob[~_deciding(decisions) & ~plan["closed"]]
        next_loss = -log_prob.sum() / max(1, len(log_prob))
    if logits.assignment is not None:
        log_prob = _visitor_log_probs(logits.assignment, decisions).gather(1, plan["visitor"][:, None])[:, 0]
        log_prob = log_prob[_open_cities(decisions)]
        assignment_loss = -log_prob.sum() / max(1, len(log_prob))
    return next_loss, assignment_loss


@torch.no_grad()
def match_plans(
    logits: DenseLogits, decisions: TensorDictBase, next_weight: float, assignment_weight: float
) -> TensorDictBase:
    """Exchange the tours of agents that have not left the depot so that the loss becomes as small as possible.

    Such agents are alike, so a plan in which they exchange their tours is as good. Of all these plans, this chooses the
    one that the network finds likeliest, as MACSIM's permutation-invariant loss does, by the Hungarian method. The
    minimum is exact for the mean cross-entropy with the actions plus the weighted losses of ``plan_losses``.

    Args:
        logits: the network's outputs for N decisions.
        decisions: TensorDict [N] with ``PLAN_KEYS``, ``action``, ``action_mask`` and ``plan``.
        next_weight: weight of the other agents' next nodes in the loss.
        assignment_weight: weight of the cities' visitors in the loss.

    Returns:
        Decisions with another ``action`` and ``plan`` if an exchange pays; ``decisions`` stays as it is.
    """
    plan, deciding = decisions["plan"], _deciding(decisions)
    starting = (decisions["game", "destination"] == 0) & ~plan["closed"]  # (N, m)
    rows = (starting.sum(1) > 1).nonzero()[:, 0]
    if len(rows) == 0:
        return decisions
    from scipy.optimize import linear_sum_assignment  # slow to import, and other labels do not need it

    cost = _costs_of_tours(logits, decisions, next_weight, assignment_weight)[rows].cpu().numpy()
    takes = np.tile(np.arange(deciding.shape[1]), (len(decisions), 1))  # (N, m): whose tour each agent takes
    for row, agents, matrix in zip(rows.tolist(), starting[rows].cpu().numpy(), cost, strict=True):
        alike = np.flatnonzero(agents)
        takes[row, alike] = alike[linear_sum_assignment(matrix[np.ix_(alike, alike)])[1]]

    taken = torch.as_tensor(takes, device=decisions.device)
    following = plan["next"].gather(1, taken)
    visitor = taken.argsort(1).gather(1, plan["visitor"])
    visitor[:, 0] = 0
    matched = decisions.copy()
    matched["action"] = following[deciding]
    return matched.set("plan", plan.copy().update({"next": following, "visitor": visitor}))


def _costs_of_tours(
    logits: DenseLogits, decisions: TensorDictBase, next_weight: float, assignment_weight: float
) -> Tensor:
    """(N, m, m) What is added to the loss if agent a takes the tour that the plan gives to agent b."""
    plan, deciding = decisions["plan"], _deciding(decisions)[:, :, None]  # (N, m, 1)
    n_agents = plan["next"].shape[1]
    policy = policy_log_probs(logits.policy, decisions)  # (N, n)
    cost = -policy.gather(1, plan["next"])[:, None] / len(decisions)  # (N, 1, m)
    if logits.next is None:
        cost = cost.where(deciding, 0.0)
    else:
        count = (~_deciding(decisions) & ~plan["closed"]).sum().clamp(min=1)
        labels = plan["next"][:, None].expand(-1, n_agents, -1)  # (N, m, m)
        log_prob = _next_log_probs(logits.next, decisions).gather(2, labels)
        cost = cost.where(deciding, -next_weight / count * log_prob)
    if logits.assignment is not None:
        cities = _open_cities(decisions)  # (N, n)
        log_prob = _visitor_log_probs(logits.assignment, decisions).masked_fill(~cities[:, None], 0.0)
        log_prob = log_prob.masked_fill(plan["closed"][:, :, None], 0.0)  # they take no part
        visits = functional.one_hot(plan["visitor"], n_agents).to(log_prob.dtype)  # (N, n, m)
        cost = cost - assignment_weight / cities.sum().clamp(min=1) * (log_prob @ visits)
    return cost


def learnable_nodes(decisions: TensorDictBase) -> Tensor:
    """(N, n) bool: the nodes among which the deciding agent's next one is learnt, the legal ones and the depot.

    A network that relied on the mask of "final", which keeps the last agent from going home while there are cities,
    would go home too early by another rule.
    """
    nodes = decisions["action_mask"].clone()
    nodes[:, 0] = True
    return nodes


def policy_log_probs(logits: Tensor, decisions: TensorDictBase) -> Tensor:
    """(N, n) Log-probabilities of the deciding agent's next node, -inf at what is not learnable."""
    return logits.float().masked_fill(~learnable_nodes(decisions), -torch.inf).log_softmax(1)


def _deciding(decisions: TensorDictBase) -> Tensor:
    """(N, m) bool: True at the deciding agent."""
    n_agents = decisions["game", "destination"].shape[1]
    return torch.arange(n_agents, device=decisions.device) == decisions["agent"][:, None]


def _open_cities(decisions: TensorDictBase) -> Tensor:
    """(N, n) bool: the unvisited cities, without the depot."""
    cities = ~decisions["visited"]
    cities[:, 0] = False
    return cities


def _next_log_probs(logits: Tensor, decisions: TensorDictBase) -> Tensor:
    """(N, m, n) Log-probabilities of every agent's next node."""
    return logits.masked_fill(decisions["visited"][:, None], -torch.inf).log_softmax(2)


def _visitor_log_probs(logits: Tensor, decisions: TensorDictBase) -> Tensor:
    """(N, m, n) Log-probabilities, for every node, of the agents that have not closed their tours."""
    return logits.masked_fill(decisions["plan", "closed"][:, :, None], -torch.inf).log_softmax(1)
