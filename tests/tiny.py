"""The options of training runs that take a second, and how to interrupt one."""

import signal
from dataclasses import replace

import pytest

from dan_policy import DANConfig, JointConfig
from train.learner import Learner
from train.presets import QUICK
from train.supervised_config import ImitateConfig

TINY = replace(
    QUICK,
    n_nodes=(5, 8),
    n_agents=(1, 3),
    batch_size=6,
    network=DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True),
    challenge_every=2,
    challenge_instances=8,
    validate_every=2,
    validation_instances=8,
    checkpoint_every=2,
    decay=0.5,
    decay_every=2,
    steps=6,
    tensorboard=False,
)

TINY_PLANS = ImitateConfig(
    policy="joint",
    joint=JointConfig(embed_dim=16, feedforward_dim=32, n_heads=2, n_layers=1),
    n_nodes=(6, 9),
    n_agents=(1, 3),
    nodes_per_agent=2,
    set_tokens=100,
    buffer=3,
    sets_per_step=2,
    workers=0,
    teacher_iterations=20,
    warmup=2,
    steps=12,
    average=0.5,
    validate_every=4,
    validation_instances=8,
    checkpoint_every=4,
    tensorboard=False,
)


def interrupt_after(step: int, learner: type[Learner], monkeypatch: pytest.MonkeyPatch) -> None:
    """Send SIGINT after this step of every run of a learner, until ``monkeypatch.undo()``."""
    train_step = learner.train_step

    def interrupted(self: Learner) -> dict[str, float]:
        logs = train_step(self)
        if self.step == step:
            signal.raise_signal(signal.SIGINT)
        return logs

    monkeypatch.setattr(learner, "train_step", interrupted)
