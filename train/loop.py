"""The loop around a learner's steps: progress, logs, validation, checkpoints, and a clean end on Ctrl-C."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager

from torchrl.record import CSVLogger, TensorboardLogger

from train.config import RunConfig
from train.distributed import any_process, rank
from train.learner import Learner, checkpoint_path
from train.progress import progress


def check_folder(config: RunConfig) -> None:
    """Raise FileExistsError if ``config.out`` holds another run and ``resume`` is not set."""
    if not config.resume and checkpoint_path(config).exists():
        raise FileExistsError(f"{config.out} holds a run already: add --resume to continue it, or choose another --out")


def run(learner: Learner) -> None:
    """Train until the configured steps or seconds are over, or until Ctrl-C; log, and save in any case."""
    config = learner.config
    if config.resume:
        learner.restore()
    first = rank() == 0
    loggers = [CSVLogger("logs", str(config.out))] if first else []
    if config.tensorboard and first:
        loggers.append(TensorboardLogger("tensorboard", str(config.out)))
    stop_at = learner.seconds + (config.seconds or math.inf)  # on the run's own clock, which is logged and saved
    with progress(config.steps, learner.step, silent=not first) as show, _interrupts() as interrupted:
        try:
            while learner.step < config.steps:
                if any_process(bool(interrupted) or learner.seconds >= stop_at, config.device):
                    break
                start = time.perf_counter()
                logs = learner.train_step()
                if learner.step % config.validate_every == 0 and first:
                    logs["validation_cost"] = learner.validate()
                learner.seconds += time.perf_counter() - start
                if "validation_cost" in logs:
                    logs["seconds"] = learner.seconds  # for curves over time, even of an interrupted run
                for logger in loggers:
                    for name, number in logs.items():
                        logger.log_scalar(name, number, step=learner.step)
                show(learner.step, logs | ({"best": learner.best} if learner.best < math.inf else {}))
                if learner.step % config.checkpoint_every == 0:
                    learner.save()
            learner.save()
        finally:
            learner.close()


@contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Collect SIGINT and SIGTERM: the first ends the run after the current step, the second ends it at once."""
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
