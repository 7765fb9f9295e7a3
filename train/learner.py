"""What every kind of training shares: validation, checkpoints that continue bit by bit, and the loop around a step."""

from __future__ import annotations

import math
import pkgutil
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl.record import CSVLogger, TensorboardLogger
from tqdm import tqdm

from dan_policy.dan import DAN
from dan_policy.episode import find_device
from dan_policy.registry import load, save
from train import checkpoint
from train.collect import costs, draw_set
from train.config import RunConfig, check_same_run
from train.distributed import anyone, rank, world_size

VALIDATION_SEED = 987_654_321  # the same held-out instances in every run; never drawn from in training


class Learner(ABC):
    """A network, its progress, and one step of its training (``train_step``)."""

    def __init__(self, config: RunConfig):
        self.config = config
        if config.threads:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        self.network = make_network(config).to(find_device(config.device)).train()
        if world_size() > 1:  # the same network everywhere, then everybody's own instances and actions
            torch.manual_seed(config.seed + rank())
            self.rng = np.random.default_rng([config.seed, rank()])
        self.average = AveragedModel(self.network, multi_avg_fn=get_ema_multi_avg_fn(config.average))
        held_out = np.random.default_rng(VALIDATION_SEED)
        self.validation_set = draw_set(held_out, config, config.validation_instances)
        self.step, self.instances, self.seconds, self.best = 0, 0, 0.0, math.inf

    @abstractmethod
    def train_step(self) -> dict[str, float]:
        """One optimiser step; counts itself in ``step``, ``instances`` and ``seconds``. Returns what to log."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """What a continuation needs beside the network, the random generators and the progress."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""

    @property
    def checkpoint(self) -> Path:
        """Everything that this process needs to go on."""
        return checkpoint_path(self.config)

    def policy(self) -> nn.Module:
        """The network to validate and to keep: the running average of the weights."""
        return self.average.module

    def close(self) -> None:  # noqa: B027 (most have nothing to do)
        """Let go of other processes."""

    def validate(self) -> float:
        """Mean greedy cost on the held-out instances; the best policy by it is kept in ``best.safetensors``."""
        cost = float(costs(self.policy(), self.validation_set, self.config).mean())
        if cost < self.best:
            self.best = cost
            self.save_weights("best.safetensors")
        return cost

    def save_weights(self, name: str) -> None:
        """The policy alone, ready for ``dan_policy.solve``."""
        self.config.out.mkdir(parents=True, exist_ok=True)
        told = {"step": self.step, "instances": self.instances, "config": self.config.to_dict()}
        save(self.config.out / name, self.policy(), **told)

    def save(self) -> None:
        """Everything that a continuation needs, and the weights of now."""
        progress = {"step": self.step, "instances": self.instances, "seconds": self.seconds, "best": self.best}
        state = {
            "config": self.config.to_dict(),
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "random": checkpoint.random_state(self.rng),
            "progress": progress,
        }
        checkpoint.write(self.checkpoint, state | self.state_dict())
        if rank() == 0:
            self.save_weights("last.safetensors")

    def restore(self) -> None:
        """Continue from the checkpoint in ``out``. Raises ValueError where the configuration is another."""
        state = checkpoint.read(self.checkpoint)
        check_same_run(state["config"], self.config)
        self.network.load_state_dict(state["network"])
        self.average.load_state_dict(state["average"])
        self.load_state_dict(state)
        for name, value in state["progress"].items():
            setattr(self, name, value)
        checkpoint.set_random_state(self.rng, state["random"])


def make_network(config: RunConfig) -> nn.Module:
    """A DAN, or what ``config.policy`` makes; with the weights of ``config.init`` where given.

    Raises:
        OSError: no such weights.
        ValueError: no such factory, or weights that do not fit.
    """
    if config.policy is None:
        network = load(config.init) if config.init else DAN(config.network)
        if config.prune_visited is not None:
            network.config = replace(network.config, prune_visited=config.prune_visited)
        return network
    try:
        network = pkgutil.resolve_name(config.policy)()
    except (ImportError, AttributeError) as error:
        raise ValueError(f"policy must be package.module:factory, got {config.policy!r} ({error})") from error
    return load(config.init, network=network) if config.init else network


def checkpoint_path(config: RunConfig) -> Path:
    """One file for each process: they draw from generators of their own."""
    return config.out / (f"checkpoint-{rank()}.pt" if rank() else "checkpoint.pt")


def check_folder(config: RunConfig) -> None:
    """Raise FileExistsError where ``config.out`` holds another run and ``resume`` was not asked for."""
    if not config.resume and checkpoint_path(config).exists():
        raise FileExistsError(f"{config.out} holds a run already: give --resume to go on with it, or another --out")


def run(learner: Learner) -> None:
    """Train until the configured steps or seconds are over, or Ctrl-C; logs, and saves in any case."""
    config = learner.config
    if config.resume:
        learner.restore()
    first = rank() == 0
    loggers = [CSVLogger("logs", str(config.out))] if first else []
    if config.tensorboard and first:
        loggers.append(TensorboardLogger("tensorboard", str(config.out)))
    stop_at = learner.seconds + (config.seconds or math.inf)  # on the clock that is logged and kept
    every = 0.5 if sys.stderr.isatty() else 60.0  # a log file wants few lines
    bar = tqdm(
        total=config.steps, initial=learner.step, unit="step", dynamic_ncols=True, mininterval=every, disable=not first
    )
    with bar, _interrupts() as interrupted:
        try:
            while learner.step < config.steps:
                if anyone(bool(interrupted) or learner.seconds >= stop_at, config.device):
                    break
                start = time.perf_counter()
                logs = learner.train_step()
                if learner.step % config.validate_every == 0 and first:
                    logs["validation_cost"] = learner.validate()
                learner.seconds += time.perf_counter() - start
                if "validation_cost" in logs:
                    logs["seconds"] = learner.seconds  # for curves over time, however often a run was interrupted
                for logger in loggers:
                    for name, number in logs.items():
                        logger.log_scalar(name, number, step=learner.step)
                bar.update()
                shown = logs | {"best": learner.best}
                bar.set_postfix({name: f"{number:.3g}" for name, number in shown.items()}, refresh=False)
                if learner.step % config.checkpoint_every == 0:
                    learner.save()
            learner.save()
        finally:
            learner.close()


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Ctrl-C or a polite kill ends the run after the step at hand; a second one at once."""
    caught: list[int] = []

    def handler(number: int, _frame: object) -> None:
        if caught:
            raise KeyboardInterrupt
        caught.append(number)

    old = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield caught
    finally:
        for number, previous in old.items():
            signal.signal(number, previous)
