"""Parameter-shared REINFORCE with a greedy rollout baseline (paper, Sec. 5.1), from top to bottom."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torchrl.record import CSVLogger, TensorboardLogger
from tqdm import tqdm

from dan_policy.actor import make_actor
from dan_policy.episode import find_device
from dan_policy.network import DAN
from dan_policy.weights import load, save
from train import checkpoint
from train.baseline import RolloutBaseline
from train.collect import autocast, costs, draw, draw_set, play
from train.config import ReinforceConfig, check_same_run
from train.loss import EpisodicReinforceLoss, backward, decisions_with_advantage

VALIDATION_SEED = 987_654_321  # the same held-out instances in every run; never drawn from in training


class Trainer:
    """What changes during a run, and one step of it."""

    def __init__(self, config: ReinforceConfig):
        self.config = config
        if config.threads:
            torch.set_num_threads(config.threads)
        torch.manual_seed(config.seed)
        self.rng = np.random.default_rng(config.seed)
        network = load(config.init) if config.init else DAN(config.network)
        self.network = network.to(find_device(config.device)).train()
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.schedule = torch.optim.lr_scheduler.StepLR(self.optimiser, config.decay_every, config.decay)
        self.baseline = RolloutBaseline(self.network, config, self.rng)
        held_out = np.random.default_rng(VALIDATION_SEED)
        self.validation_set = draw_set(held_out, config, config.validation_instances)
        self.step, self.instances, self.seconds, self.best = 0, 0, 0.0, math.inf

    def train_step(self) -> dict[str, float]:
        """One batch: play it, let the baseline play it, one optimiser step. Returns what to log."""
        config, start = self.config, time.perf_counter()
        instances = draw(self.rng, config, config.batch_size)
        episode = play(self.network, instances, config, "sample", keep=True)
        value = self.baseline.value(instances)

        decisions = decisions_with_advantage(episode, episode.reward - value)
        self.optimiser.zero_grad()
        with autocast(config):
            loss = EpisodicReinforceLoss(make_actor(self.network), n_episodes=config.batch_size)
            backward(loss, decisions, config.chunk)
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.max_grad_norm)
        self.optimiser.step()
        self.schedule.step()

        self.step += 1
        self.instances += config.batch_size
        logs = {"cost": -float(episode.reward.mean()), "baseline": -float(value.mean()), "grad_norm": float(norm)}
        if self.step % config.challenge_every == 0:
            logs["baseline_replaced"] = float(self.baseline.challenge(self.network))
        if self.step % config.validate_every == 0:
            logs["validation_cost"] = self.validate()
        seconds = time.perf_counter() - start
        self.seconds += seconds
        return logs | {
            "instances_per_second": config.batch_size / seconds,
            "learning_rate": self.schedule.get_last_lr()[0],
        }

    def validate(self) -> float:
        """Mean greedy cost on the held-out instances; the best policy by it is kept in ``best.safetensors``."""
        cost = float(costs(self.network, self.validation_set, self.config).mean())
        if cost < self.best:
            self.best = cost
            self.save_weights("best.safetensors")
        return cost

    def save_weights(self, name: str) -> None:
        """The network alone, ready for ``dan_policy.solve``."""
        self.config.out.mkdir(parents=True, exist_ok=True)
        save(
            self.config.out / name, self.network, step=self.step, instances=self.instances, config=self.config.to_dict()
        )

    def save(self) -> None:
        """Everything that a continuation needs, and the weights of now."""
        state = {
            "config": self.config.to_dict(),
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "schedule": self.schedule.state_dict(),
            "baseline": self.baseline.state_dict(),
            "random": checkpoint.random_state(self.rng),
            "progress": {"step": self.step, "instances": self.instances, "seconds": self.seconds, "best": self.best},
        }
        checkpoint.write(self.config.out / "checkpoint.pt", state)
        self.save_weights("last.safetensors")

    def restore(self) -> None:
        """Continue from the checkpoint in ``out``. Raises ValueError where the configuration is another."""
        state = checkpoint.read(self.config.out / "checkpoint.pt")
        check_same_run(state["config"], self.config)
        self.network.load_state_dict(state["network"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.schedule.load_state_dict(state["schedule"])
        self.baseline.load_state_dict(state["baseline"])
        for name, value in state["progress"].items():
            setattr(self, name, value)
        checkpoint.set_random_state(self.rng, state["random"])


def reinforce(config: ReinforceConfig) -> Trainer:
    """Train until ``config.steps`` or ``config.seconds`` are over, or Ctrl-C; saves in any case.

    Raises:
        FileExistsError: ``config.out`` holds another run and ``resume`` was not asked for.
        ValueError, OSError: nothing to resume, or another configuration.
    """
    if not config.resume and (config.out / "checkpoint.pt").exists():
        raise FileExistsError(f"{config.out} holds a run already: give --resume to go on with it, or another --out")
    trainer = Trainer(config)
    if config.resume:
        trainer.restore()
    loggers = [CSVLogger("logs", str(config.out))]
    if config.tensorboard:
        loggers.append(TensorboardLogger("tensorboard", str(config.out)))
    stop_at = time.monotonic() + (config.seconds or math.inf)
    bar = tqdm(total=config.steps, initial=trainer.step, unit="step", dynamic_ncols=True)
    with bar, _interrupts() as interrupted:
        while trainer.step < config.steps and time.monotonic() < stop_at and not interrupted:
            logs = trainer.train_step()
            for logger in loggers:
                for name, number in logs.items():
                    logger.log_scalar(name, number, step=trainer.step)
            bar.update()
            bar.set_postfix(
                cost=f"{logs['cost']:.3f}",
                baseline=f"{logs['baseline']:.3f}",
                best=f"{trainer.best:.3f}",
                inst_s=f"{logs['instances_per_second']:.0f}",
            )
            if trainer.step % config.checkpoint_every == 0:
                trainer.save()
        trainer.save()
    return trainer


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
