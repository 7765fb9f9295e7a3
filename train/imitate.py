"""Imitation of the reference solver: a warm start for REINFORCE."""

from __future__ import annotations

import math
import time
from typing import Annotated, Any, NamedTuple

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor, nn

from dan_policy.actor import make_actor, network_keys
from dan_policy.joint import DenseLogits
from dan_policy.registry import find
from train.buffer import Buffer
from train.collect import autocast
from train.config import ImitateConfig
from train.learner import Learner
from train.loop import run, run_folder
from train.loss import log_probs
from train.network import observation_keys
from train.plans import plan_losses


class ImitationLearner(Learner):
    """What changes during a run of imitation, and one step of it."""

    config: ImitateConfig

    def __init__(self, config: ImitateConfig):
        super().__init__(config)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimiser, lambda step: rate(config, step, self.seconds))
        plans = learns_plans(self.network, config)
        self.buffer = Buffer(config, observation_keys(self.network), self.rng, plans)

    def train_step(self) -> dict[str, float]:
        """Take one optimiser step on decisions of some sets of the buffer. Returns the numbers to log."""
        config, start = self.config, time.perf_counter()
        batches = self.buffer.draw(config.sets_per_step)
        waited = time.perf_counter() - start
        self.optimiser.zero_grad()
        loss = next_loss = assignment_loss = agreed = torch.zeros((), device=config.device)  # no wait for a GPU
        for decisions in batches:  # all weigh the same: a set of 16 games at n = 200 as much as one of 256 at n = 20
            with autocast(config):
                part = imitation_losses(self.network, decisions)
            total = part.loss + config.next_weight * part.next + config.assignment_weight * part.assignment
            (total / len(batches)).backward()
            loss = loss + part.loss.detach() / len(batches)
            next_loss = next_loss + part.next.detach() / len(batches)
            assignment_loss = assignment_loss + part.assignment.detach() / len(batches)
            agreed = agreed + part.agreed
        norm = self.update()

        self.step += 1
        self.instances = self.buffer.instances
        count = sum(map(len, batches))
        return {
            "loss": float(loss),
            "next_loss": float(next_loss),
            "assignment_loss": float(assignment_loss),
            "agreement": float(agreed) / count,
            "grad_norm": norm,
            "learning_rate": float(self.schedule.get_last_lr()[0]),
            "decisions_per_second": count / (time.perf_counter() - start),
            "seconds_waited": waited,
        }

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, schedule and buffer."""
        parts = ("optimiser", "schedule", "buffer")
        return {part: getattr(self, part).state_dict() for part in parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for part in ("optimiser", "schedule", "buffer"):
            getattr(self, part).load_state_dict(state[part])

    def close(self) -> None:
        """End the worker processes."""
        self.buffer.close()


class ImitationLosses(NamedTuple):
    """The losses of a batch of N decisions, and how often the network agrees with the teacher."""

    loss: Tensor  # () mean cross-entropy with the teacher's actions, with gradients
    next: Tensor  # () mean cross-entropy with the other agents' next nodes; 0 without plans
    assignment: Tensor  # () mean cross-entropy with the cities' visitors; 0 without plans
    agreed: Tensor  # () number of decisions whose teacher's action has a probability above 1/2


def imitation_losses(network: nn.Module, decisions: TensorDictBase) -> ImitationLosses:
    """Cross-entropies with the teacher's ``action`` and, if the decisions have one, its ``plan``.

    Args:
        network: a network, with ``forward_dense`` if there are plans.
        decisions: TensorDict [N] of one set.
    """
    if "plan" in decisions.keys():  # noqa: SIM118 (a TensorDict is no mapping)
        forward_dense: Any = network.forward_dense
        logits: DenseLogits = forward_dense(*(decisions[key] for key in network_keys(network)))
        log_prob = logits.policy.masked_fill(~decisions["action_mask"], -torch.inf).log_softmax(1)
        log_prob = log_prob.gather(1, decisions["action"][:, None])[:, 0]
        next_loss, assignment_loss = plan_losses(logits, decisions)
    else:
        log_prob = log_probs(make_actor(network), decisions)
        next_loss = assignment_loss = log_prob.new_zeros(())
    agreed = (log_prob.detach() > math.log(0.5)).sum()
    return ImitationLosses(-log_prob.mean(), next_loss, assignment_loss, agreed)


def learns_plans(network: nn.Module, config: ImitateConfig) -> bool:
    """Whether the teacher's whole plans are labels: the network has the outputs, and a weight is above 0."""
    return hasattr(network, "forward_dense") and max(config.next_weight, config.assignment_weight) > 0


def rate(config: ImitateConfig, step: int, seconds: float = 0.0) -> float:
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


def imitate(config: Annotated[ImitateConfig, tyro.conf.arg(name="")]) -> ImitationLearner:
    """Train a network to choose as the reference solver does: a warm start for `reinforce`.

    A run ends after `steps`, after `seconds`, or on Ctrl-C, and saves in any case.

    Args:
        config: the options.

    Raises:
        FileExistsError: ``config.out`` holds another run and ``resume`` is not set.
        ModuleNotFoundError: Numba, which the teacher needs, is not installed.
        ValueError: the run to resume had another configuration, a value does not fit, or another process trains in
            ``config.out``.
        OSError: there is no run to resume, or no such weights.
    """
    import mtsp_env.reference  # noqa: F401 (fail now if Numba is missing, not in a worker)

    if config.roll_in is not None:
        find(config.roll_in)  # fail now if there are no such weights
    with run_folder(config):
        learner = ImitationLearner(config)
        run(learner)
    return learner
