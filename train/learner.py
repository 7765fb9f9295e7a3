"""What every kind of training shares: the network, its validation, and checkpoints that continue bit for bit."""

from __future__ import annotations

import math
import sys
from abc import ABC, abstractmethod
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from dan_policy.network import find_device
from train import checkpoint
from train.collect import costs, draw_set
from train.config import RunConfig
from train.distributed import gather, rank, world_size
from train.network import compile_layers, make_network, save_weights

PROGRESS = ("step", "instances", "seconds", "best")  # what a checkpoint says about how far the run has come
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
        optimiser, schedule: set by each kind of training.
    """

    optimiser: torch.optim.Optimizer
    schedule: torch.optim.lr_scheduler.LRScheduler

    def __init__(self, config: RunConfig):
        self.config = config
        device = find_device(config.device)
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        self.network = make_network(config).to(device).train()
        if world_size() > 1:  # all processes start with the same network, then draw instances and actions of their own
            torch.manual_seed(config.seed + rank())
            self.rng = np.random.default_rng([config.seed, rank()])
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.average))
        if config.compile:  # after the average has been copied, which plays games of any shape
            compile_layers(self.network)
        self.validation_set = draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances)
        self.step, self.instances, self.seconds, self.best = 0, 0, 0.0, math.inf

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """Take one optimiser step and count it in ``step`` and ``instances``. Returns the numbers to log."""

    def update(self) -> float:
        """Let the optimiser take its step, then the schedule and the running average. Returns the gradient's norm.

        Raises:
            FloatingPointError: the gradient, and hence probably the loss, is not finite. The weights stay as they were.
        """
        norm = float(torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.config.max_grad_norm))
        if not math.isfinite(norm):
            rate = self.schedule.get_last_lr()[0]
            raise FloatingPointError(
                f"step {self.step + 1}: the norm of the gradient is {norm}. Training has diverged: lower the learning "
                f"rate, which was {rate:g}. {self.config.out} has the weights of the last checkpoint, if there is one"
            )
        self.optimiser.step()
        self.schedule.step()
        self.average.update_parameters(self.network)
        return norm

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
        """Write a checkpoint, and the current weights to ``last.safetensors``.

        Until the first validation, ``best.safetensors`` gets them as well, so that every run has this file.
        """
        progress = {name: getattr(self, name) for name in PROGRESS}
        state = {
            "config": self.config.to_dict(),
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "random": checkpoint.random_state(self.rng),
            "progress": progress | {"processes": world_size()},
        }
        checkpoint.write(checkpoint_path(self.config), state | self.state_dict())
        if rank() == 0:
            self.save_weights("last.safetensors")
            if math.isinf(self.best):
                self.save_weights("best.safetensors")

    def restore(self) -> None:
        """Continue from the checkpoint in ``config.out``.

        Raises:
            FileNotFoundError: there is none.
            ValueError: it is damaged, or of a run with another configuration or another number of processes; or the
                processes have no whole checkpoint of the same step.
        """
        path = checkpoint_path(self.config)
        try:
            state = self._common_state(path)
            checkpoint.check_same_run(state["config"], self.config)
            before = state["progress"].get("processes", world_size())  # older checkpoints do not say
            if before != world_size():
                raise ValueError(f"{path}: the run had {before} processes, and would now have {world_size()}")
            self.network.load_state_dict(state["network"])
            self.average.load_state_dict(state["average"])
            self.load_state_dict(state)
            for name in PROGRESS:
                setattr(self, name, state["progress"][name])
            checkpoint.set_random_state(self.rng, state["random"])
        except BrokenExecutor:  # a process that makes labels has died
            raise
        except (LookupError, TypeError, AttributeError, RuntimeError) as error:
            reason = f"{type(error).__name__}: {error}"
            raise ValueError(f"{path}: it does not hold the state of a {type(self).__name__} ({reason})") from error

    def _common_state(self, path: Path) -> dict[str, Any]:
        """The checkpoint at ``path``. Under torchrun: the newest whole one of a step that all processes have saved.

        Processes that train together are at the same step when they save. But one may be killed before it has saved, or
        its file may be damaged: then all of them go back to the checkpoint before it.
        """
        if world_size() == 1:
            return checkpoint.read(path)
        found: dict[int, tuple[Path, dict[str, Any]]] = {}  # by step
        problems = []
        for file in (path, checkpoint.previous(path)):
            try:
                state = checkpoint.read(file)
                found.setdefault(int(state["progress"]["step"]), (file, state))
            except (ValueError, OSError) as error:
                problems.append(str(error))
            except (LookupError, TypeError) as error:
                problems.append(f"{file}: it does not say its step ({type(error).__name__}: {error})")
        steps = torch.tensor([*found, -1, -1][:2], device=self.config.device)  # -1: none
        everywhere = gather(steps).view(-1, 2).tolist()  # (number of processes, 2), the same in all of them
        common = set.intersection(*map(set, everywhere)) - {-1}
        if not common:
            raise ValueError(
                f"{path}: the processes share no whole checkpoint: they have those of steps "
                f"{[sorted({*steps} - {-1}) for steps in everywhere]} {'; '.join(problems)}"
            )
        file, state = found[max(common)]
        if file != path:
            reason = problems[0] if problems else "another process has not come as far"
            print(f"train: {path} is left out, step {max(common)} is continued ({reason})", file=sys.stderr, flush=True)
            checkpoint.go_back(path)
        return state


def checkpoint_path(config: RunConfig) -> Path:
    """This process's checkpoint: every process has its own, because each draws from its own generators."""
    return config.out / (f"checkpoint-{rank()}.pt" if rank() else "checkpoint.pt")
