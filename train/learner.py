"""What every kind of training shares: the network, its validation, and checkpoints that continue bit for bit."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dan_policy.episode import find_device
from train import checkpoint
from train.collect import costs, draw_set
from train.config import RunConfig
from train.distributed import rank, world_size
from train.network import make_network, save_weights

VALIDATION_SEED = 987_654_321  # the same held-out instances in every run; training never uses it


class Learner(ABC):
    """A network, the progress of its training, and one step of it (``train_step``).

    Attributes:
        network: the network that is trained.
        average: the running average of its weights.
        rng: draws the instances. Actions and initial weights come from torch's generator, which is seeded here.
        step: number of optimiser steps so far.
        instances: number of instances so far, over all processes.
        seconds: time spent in training and validation so far.
        best: lowest validation cost so far.
    """

    def __init__(self, config: RunConfig):
        self.config = config
        if config.threads:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        self.network = make_network(config).to(find_device(config.device)).train()
        if world_size() > 1:  # all processes start with the same network, then draw instances and actions of their own
            torch.manual_seed(config.seed + rank())
            self.rng = np.random.default_rng([config.seed, rank()])
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.average))
        self.validation_set = draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances)
        self.step, self.instances, self.seconds, self.best = 0, 0, 0.0, math.inf

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one optimiser step and count it in ``step`` and ``instances``. Returns the numbers to log."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """What a continuation needs besides the networks, the random generators and the progress."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""

    def close(self) -> None:  # noqa: B027 (most learners have nothing to do)
        """End other processes."""

    @property
    def averaged_network(self) -> nn.Module:
        """The network that is validated and saved: it has the running average of the weights."""
        return self.average.module

    def validate(self) -> float:
        """Mean greedy cost on the held-out instances; saves the network to ``best.safetensors`` if it is the lowest."""
        cost = float(costs(self.averaged_network, self.validation_set, self.config).mean())
        if cost < self.best:
            self.best = cost
            self.save_weights("best.safetensors")
        return cost

    def save_weights(self, name: str) -> None:
        """Write the averaged network to a file in the run's folder, ready for ``dan_policy.solve``."""
        history = {"step": self.step, "instances": self.instances, "config": self.config.to_dict()}
        save_weights(self.config.out / name, self.averaged_network, self.config, history)

    def save(self) -> None:
        """Write a checkpoint, and the current weights to ``last.safetensors``."""
        progress = {"step": self.step, "instances": self.instances, "seconds": self.seconds, "best": self.best}
        state = {
            "config": self.config.to_dict(),
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "random": checkpoint.random_state(self.rng),
            "progress": progress,
        }
        checkpoint.write(checkpoint_path(self.config), state | self.state_dict())
        if rank() == 0:
            self.save_weights("last.safetensors")

    def restore(self) -> None:
        """Continue from the checkpoint in ``config.out``.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, or of a run with another configuration.
        """
        state = checkpoint.read(checkpoint_path(self.config))
        checkpoint.check_same_run(state["config"], self.config)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.load_state_dict(state)
        for name, value in state["progress"].items():
            setattr(self, name, value)
        checkpoint.set_random_state(self.rng, state["random"])


def checkpoint_path(config: RunConfig) -> Path:
    """This process's checkpoint: every process has its own, because each draws from its own generators."""
    return config.out / (f"checkpoint-{rank()}.pt" if rank() else "checkpoint.pt")
