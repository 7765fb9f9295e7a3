"""Imitation of the reference solver: a warm start for REINFORCE."""

from __future__ import annotations

import time
from typing import Annotated, Any

import tyro

from dan_policy.registry import find
from train.buffer import Buffer
from train.loop import run, run_folder
from train.network import observation_keys
from train.supervised import SupervisedLearner
from train.supervised_config import ImitateConfig


class ImitationLearner(SupervisedLearner):
    """What changes during a run of imitation, and one step of it."""

    config: ImitateConfig

    def __init__(self, config: ImitateConfig):
        super().__init__(config)
        self.buffer = Buffer(config, observation_keys(self.network), self.rng, self.learns_plans)

    def train_step(self) -> dict[str, float]:
        """Take one optimiser step on decisions of some sets of the buffer. Returns the numbers to log."""
        start = time.perf_counter()
        batches = self.buffer.draw(self.config.sets_per_step)
        waited = time.perf_counter() - start
        # All sets weigh the same: one of 16 games at n = 200 as much as one of 256 at n = 20
        logs = self.descend(batches, [1 / len(batches)] * len(batches))
        self.step += 1
        self.instances = self.buffer.instances
        speed = sum(map(len, batches)) / (time.perf_counter() - start)
        return logs | {"decisions_per_second": speed, "seconds_waited": waited}

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, schedule and buffer."""
        return super().state_dict() | {"buffer": self.buffer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        super().load_state_dict(state)
        self.buffer.load_state_dict(state["buffer"])

    def close(self) -> None:
        """End the worker processes."""
        self.buffer.close()


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
