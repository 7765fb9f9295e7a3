"""The loop around a learner's steps: progress, logs, validation, checkpoints, and a clean end on Ctrl-C."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path

from mtsp_env.writing import lock, remove_leftovers
from train import checkpoint
from train.config import RunConfig
from train.distributed import any_process, rank
from train.interrupts import ENDING, postponed
from train.learner import Learner, checkpoint_path
from train.logs import Logs
from train.progress import progress


@contextmanager
def run_folder(config: RunConfig) -> Iterator[None]:
    """A context in which no other process may train in ``config.out``.

    Raises:
        FileExistsError: it holds another run, and ``resume`` is not set.
        FileNotFoundError: there is no run to resume.
        OSError: the folder cannot be written.
        ValueError: another process trains in it.
    """
    path = checkpoint_path(config)
    if config.resume and not path.exists():
        before = checkpoint.previous(path)
        hint = f"; to continue from the one before it: mv {before} {path}" if before.is_file() else ""
        raise FileNotFoundError(f"no checkpoint at {path}{hint}")
    if rank():  # under torchrun, process 0 holds the lock for all
        _check_unused(config)
        yield
        return
    with sole_writer(config.out):
        _check_unused(config)
        remove_leftovers(config.out)
        yield


@contextmanager
def sole_writer(folder: Path) -> Iterator[None]:
    """A context in which no other process may hold this folder, which is made if it is missing.

    Raises:
        OSError: the folder cannot be written.
        ValueError: another process holds it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".lock", "a") as file:
        try:
            lock(file)
        except BlockingIOError:
            raise ValueError(f"{folder}: another run is writing to it") from None
        yield


def _check_unused(config: RunConfig) -> None:
    if not config.resume and checkpoint_path(config).exists():
        raise FileExistsError(f"{config.out} holds a run already: add --resume to continue it, or choose another --out")


def run(learner: Learner) -> None:
    """Train until the configured steps or seconds are over, or a signal comes; log, and save in any case.

    A signal (Ctrl-C, SIGTERM or SIGHUP) ends the run. Once everything is saved, it is raised again for the handler that
    was there before.
    """
    with closing(learner):
        if learner.config.resume:
            learner.restore()
        with postponed(*ENDING) as caught:
            _train(learner, caught)


def _train(learner: Learner, caught: list[int]) -> None:
    """Take steps until one of the run's limits is reached or a signal is ``caught``."""
    config, first = learner.config, rank() == 0
    stop_at = learner.seconds + (config.seconds or math.inf)  # on the run's own clock, which is logged and saved
    logging = closing(Logs(config.out, learner.step, config.tensorboard)) if first else nullcontext()
    saved = -1  # the step of the last checkpoint
    with progress(config.steps, learner.step, silent=not first) as show, logging as logs:
        while learner.step < config.steps:
            if any_process(bool(caught) or learner.seconds >= stop_at, config.device):
                break
            start = time.perf_counter()
            numbers = learner.train_step()
            if learner.step % config.validate_every == 0 and first:
                numbers["validation_cost"] = learner.validate()
            learner.seconds += time.perf_counter() - start
            if "validation_cost" in numbers:
                numbers["seconds"] = learner.seconds  # for curves over time, even of an interrupted run
            if logs is not None:
                logs.write(learner.step, numbers)
            show(learner.step, numbers | ({"best": learner.best} if learner.best < math.inf else {}))
            if learner.step % config.checkpoint_every == 0:
                learner.save()
                saved = learner.step
        if saved != learner.step:  # saved twice, a step would leave a process that is killed meanwhile two behind
            learner.save()
