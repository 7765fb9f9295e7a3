"""Parameter-shared REINFORCE with a greedy rollout baseline (paper, Sec. 5.1), from top to bottom."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import torch
from torch.optim.lr_scheduler import ChainedScheduler, LinearLR, StepLR

from dan_policy.actor import make_actor
from dan_policy.episode import Episode
from mtsp_env.instance import Problem
from train.baseline import Baseline, RolloutBaseline, SharedBaseline
from train.collect import autocast, draw, play, repeat
from train.distributed import average_gradients, processes, world_size
from train.learner import Learner
from train.loop import run, run_folder
from train.loss import EpisodicReinforceLoss, backward, decisions_with_advantage, subsample
from train.presets import Preset
from train.reinforce_config import ReinforceConfig

if TYPE_CHECKING:
    from train.remote import RayWorkers


class ReinforceLearner(Learner):
    """What changes during a run of REINFORCE, and one step of it."""

    config: ReinforceConfig

    def __init__(self, config: ReinforceConfig):
        super().__init__(config)
        self.optimiser = torch.optim.Adam(self.network.parameters(), lr=config.learning_rate)
        self.schedule = make_schedule(self.optimiser, config)
        if config.baseline == "shared":
            self.baseline: Baseline = SharedBaseline(config.samples)
        else:
            self.baseline = RolloutBaseline(self.network, config, self.rng)
        self.workers: RayWorkers | None = None

    def train_step(self) -> dict[str, float]:
        """Play a batch, compare it with the baseline, take one optimiser step. Returns the numbers to log."""
        config, start = self.config, time.perf_counter()
        problem, episode = self.collect()
        value = self.baseline.value(problem, episode.reward)

        advantage = episode.reward - value
        if config.normalise:
            advantage = advantage / (advantage.std() + 1e-8)
        decisions = subsample(decisions_with_advantage(episode, advantage), config.decisions)
        self.optimiser.zero_grad()
        with autocast(config):
            loss = EpisodicReinforceLoss(make_actor(self.network), n_episodes=len(advantage))
            backward(loss, decisions, config.chunk)
        average_gradients(self.network)
        norm = self.update()

        self.step += 1
        self.instances += len(problem.nodes) // config.samples * world_size()
        logs: dict[str, float] = {
            "cost": -float(episode.reward.mean()),
            "baseline": -float(value.mean()),
            "grad_norm": norm,
            "learning_rate": float(self.schedule.get_last_lr()[0]),
            "episodes_per_second": len(advantage) * world_size() / (time.perf_counter() - start),
        }
        if self.step % config.challenge_every == 0:
            logs["baseline_replaced"] = float(self.baseline.challenge(self.averaged_network))
        return logs

    def collect(self) -> tuple[Problem, Episode]:
        """Fresh instances and the network's episodes on them, played in this process or by Ray workers."""
        config = self.config
        if config.collector == "ray":
            from train.remote import RayWorkers  # slow to import

            self.workers = self.workers or RayWorkers(self.network, config, self.step)
            return self.workers.collect()
        drawn = draw(self.rng, config.at(self.step), config.batch_size, config.batch_tokens)
        problem = repeat(drawn, config.samples)
        return problem, play(self.network, problem, config, "sample", keep=True)

    def close(self) -> None:
        """End the Ray workers."""
        if self.workers is not None:
            self.workers.close()
            self.workers = None

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, schedule and baseline."""
        parts = ("optimiser", "schedule", "baseline")
        return {part: getattr(self, part).state_dict() for part in parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for part in ("optimiser", "schedule", "baseline"):
            getattr(self, part).load_state_dict(state[part])


def make_schedule(optimiser: torch.optim.Optimizer, config: ReinforceConfig) -> StepLR | ChainedScheduler:
    """The learning rate's decay, after a linear warm-up if there is one."""
    decay = StepLR(optimiser, config.decay_every, config.decay)
    if config.warmup < 2:  # the first step of a warm-up of 1 step has the whole rate already
        return decay
    return ChainedScheduler([LinearLR(optimiser, 1 / config.warmup, total_iters=config.warmup - 1), decay])


def reinforce(config: Preset) -> ReinforceLearner:
    """Train a network by REINFORCE, from a preset with any option changed.

    A run ends after `steps`, after `seconds`, or on Ctrl-C, and saves in any case. Under torchrun every process trains
    on its own batches, and all take the same steps.

    Args:
        config: the preset.

    Raises:
        FileExistsError: ``config.out`` holds another run and ``resume`` is not set.
        ValueError: the run to resume had another configuration, a value does not fit, or another process trains in
            ``config.out``.
        OSError: there is no run to resume, or no such weights.
    """
    with processes(config.device):
        if config.collector == "ray" and world_size() > 1:
            raise ValueError("collector must be 'here' under torchrun, got 'ray'")
        with run_folder(config):
            learner = ReinforceLearner(config)
            run(learner)
    return learner
