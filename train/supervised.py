"""What imitation and self-improvement share: optimiser steps on decisions that are labelled with their tours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from dan_policy.layers import DenseLogits
from dan_policy.network import network_keys
from train.collect import autocast
from train.learner import Learner
from train.optimisers import make_optimiser
from train.plans import learnable_nodes, match_plans, plan_losses, policy_log_probs
from train.supervised_config import SupervisedConfig


class SupervisedLearner(Learner):
    """A learner whose steps lower the cross-entropy with given tours.

    Attributes:
        learns_plans: whether decisions are labelled with the plan for all agents (``train.plans``).
    """

    config: SupervisedConfig

    def __init__(self, config: SupervisedConfig):
        super().__init__(config)
        self.optimiser = make_optimiser(config.optimiser, self.network, config.learning_rate, config.weight_decay)
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimiser, lambda step: rate(config, step, self.seconds))
        self.learns_plans = learns_plans(self.network, config)

    def descend(self, batches: Sequence[TensorDictBase], shares: Sequence[float]) -> dict[str, float]:
        """Take one optimiser step. Returns the numbers to log.

        Args:
            batches: TensorDicts [N] of decisions, each from games of one size.
            shares: each batch's weight in the loss.
        """
        config = self.config
        self.optimiser.zero_grad()
        logged = torch.zeros(4, device=config.device)  # no wait for a GPU before all batches are under way
        for decisions, share in zip(batches, shares, strict=True):
            with autocast(config):
                losses = imitation_losses(self.network, decisions, config)
            (share * losses.total).backward()
            logged += torch.stack(losses[1:]).detach() * torch.tensor([share, share, share, 1.0], device=config.device)
        norm = self.update()
        loss, next_loss, assignment_loss, agreed = logged.tolist()
        return {
            "loss": loss,
            "next_loss": next_loss,
            "assignment_loss": assignment_loss,
            "agreement": agreed / sum(map(len, batches)),
            "grad_norm": norm,
            "learning_rate": float(self.schedule.get_last_lr()[0]),
        }

    def state_dict(self) -> dict[str, Any]:
        """Optimiser and schedule."""
        return {"optimiser": self.optimiser.state_dict(), "schedule": self.schedule.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])


class ImitationLosses(NamedTuple):
    """The losses of a batch of N decisions, and how often the network agrees with their labels."""

    total: Tensor  # () the weighted sum of the following three, with gradients
    loss: Tensor  # () mean cross-entropy with the actions, or mean divergence from the targets
    next: Tensor  # () mean cross-entropy with the other agents' next nodes; 0 without plans
    assignment: Tensor  # () mean cross-entropy with the cities' visitors; 0 without plans
    agreed: Tensor  # () number of decisions whose action, or whose target's likeliest one, has a probability above 1/2


def imitation_losses(network: nn.Module, decisions: TensorDictBase, config: SupervisedConfig) -> ImitationLosses:
    """Cross-entropies with the ``action`` of each decision and, if the decisions have one, its ``plan``.

    Decisions with a ``target`` are learnt from that alone: see ``train.regrets``.

    Args:
        network: a network, with ``forward_dense`` if there are plans.
        decisions: TensorDict [N] of games of one size.
        config: the weights of the losses, and how plans are matched.
    """
    if "target" in decisions.keys():  # noqa: SIM118 (a TensorDict is no mapping)
        return _target_losses(network, decisions)
    inputs = [decisions.get(key, None) for key in network_keys(network)]
    if "plan" in decisions.keys():  # noqa: SIM118 (a TensorDict is no mapping)
        forward_dense: Any = network.forward_dense
        logits: DenseLogits = forward_dense(*inputs)
        if config.plan_matching == "invariant":
            decisions = match_plans(logits, decisions, config.next_weight, config.assignment_weight)
        policy = logits.policy
        next_loss, assignment_loss = plan_losses(logits, decisions)
    else:
        policy = network(*inputs)
        next_loss = assignment_loss = policy.new_zeros(())
    log_prob = policy_log_probs(policy, decisions).gather(1, decisions["action"][:, None])[:, 0]
    loss = -log_prob.mean()
    total = loss + config.next_weight * next_loss + config.assignment_weight * assignment_loss
    agreed = (log_prob.detach() > math.log(0.5)).sum()
    return ImitationLosses(total, loss, next_loss, assignment_loss, agreed)


def _target_losses(network: nn.Module, decisions: TensorDictBase) -> ImitationLosses:
    """The mean divergence of the policy from ``target`` [N, n] of each decision: 0 if it has learnt them."""
    logits: Tensor = network(*(decisions.get(key, None) for key in network_keys(network)))
    target = decisions["target"]
    log_prob = policy_log_probs(logits, decisions).masked_fill(~learnable_nodes(decisions), 0.0)  # 0 times -inf is NaN
    divergence = (torch.special.xlogy(target, target) - target * log_prob).sum(1)  # (N,)
    weight = decisions.get("weight", torch.ones_like(divergence))
    loss = (weight * divergence).sum() / weight.sum()
    likeliest = log_prob.detach().gather(1, target.argmax(1, keepdim=True))
    nothing = loss.new_zeros(())
    return ImitationLosses(loss, loss, nothing, nothing, (likeliest > math.log(0.5)).sum())


def learns_plans(network: nn.Module, config: SupervisedConfig) -> bool:
    """Whether plans are labels: the network has an output for them whose weight is above 0, or plans are matched.

    Raises:
        ValueError: ``plan_matching="invariant"`` for a network without such outputs.
    """
    outputs = getattr(network, "dense_outputs", ())
    if config.plan_matching == "invariant":
        if not outputs:
            name = type(network).__name__
            raise ValueError(f"plan_matching must be 'canonical' for networks without dense outputs such as {name}")
        return True
    weights = {"next": config.next_weight, "assignment": config.assignment_weight}
    return any(weights[output] > 0 for output in outputs)


def rate(config: SupervisedConfig, step: int, seconds: float = 0.0) -> float:
    """Factor on the learning rate: a linear warm-up, then half a cosine down to ``final_rate``.

    Args:
        config: the run's options.
        step: number of optimiser steps so far.
        seconds: time spent in training so far; it counts if ``anneal_seconds`` is set.
    """
    if step < config.warmup:
        return (step + 1) / config.warmup
    elapsed = (step - config.warmup) / max(1, config.steps - config.warmup)
    if config.anneal_seconds is not None:
        elapsed = max(elapsed, seconds / config.anneal_seconds)
    return config.final_rate + (1 - config.final_rate) * (1 + math.cos(math.pi * min(1.0, elapsed))) / 2
