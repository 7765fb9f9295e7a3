"""Sets of demonstrations to learn from, made by worker processes while the network learns."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from threading import Thread
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from dan_policy.network import Key
from dan_policy.registry import find
from mtsp_env.machine import check_memory
from mtsp_env.processes import end_with_parent
from train.demonstrations import LEAST_GAMES, Demonstrations, as_decisions, demonstrate
from train.interrupts import ENDING
from train.lessons import Lessons
from train.plans import PLAN_KEYS, add_plans
from train.regrets import Corrections
from train.supervised_config import ImitateConfig

BYTES_PER_WORKER = 2**28  # of a process that has imported torch, at least


class Buffer:
    """The sets at hand, and which of their decisions are still to be drawn.

    Set i depends on the configuration and i alone, so that the buffer's state is a few numbers: a continuation makes
    the same sets again.

    Args:
        keys: the parts of the observation that the network needs.
        rng: draws sets and decision indices.
        plans: label each decision with the teacher's plan for all agents (``train.plans``).

    Raises:
        ValueError: the sets or the workers do not fit into the memory.
    """

    def __init__(self, config: ImitateConfig, keys: Sequence[Key], rng: np.random.Generator, plans: bool = False):
        check_memory("workers", config.workers, BYTES_PER_WORKER)
        # The coordinates alone, in float32, of the smallest set, in which each game takes n - 1 decisions or more
        check_memory("buffer", config.buffer, 8 * LEAST_GAMES * (config.n_nodes[0] - 1) * config.n_nodes[0])
        self.config, self.keys, self.rng, self.plans = config, keys, rng, plans
        self.student = None if config.roll_in is None else hashlib.sha256(find(config.roll_in).read_bytes()).hexdigest()
        self.indices: list[int] = []  # index of each set at hand
        self.left: list[list[int]] = []  # decision indices of each that are still to be drawn
        self.sets: list[tuple[TensorDictBase, Tensor]] = []  # decisions [T, B], valid (T, B)
        self.next, self.instances = 0, 0
        self._pool: ProcessPoolExecutor | None = None
        self._others: list[BaseProcess] = []  # children of this process that are not workers
        self._pending: dict[int, Future] = {}

    def draw(self, count: int) -> list[TensorDictBase]:
        """All decisions at one index of each of ``count`` sets. Fresh sets replace those that are used up."""
        while len(self.sets) < self.config.buffer:
            self.add(self.next)
        batches = []
        for i in self.rng.choice(len(self.sets), count, replace=False).tolist():
            (decisions, valid), step = self.sets[i], self.left[i].pop()
            batches.append(decisions[step][valid[step]])
        remaining = [i for i, left in enumerate(self.left) if left]
        self.indices = [self.indices[i] for i in remaining]
        self.left = [self.left[i] for i in remaining]
        self.sets = [self.sets[i] for i in remaining]
        return batches

    def add(self, index: int) -> None:
        """Make the set of that index, and choose which of its decision indices to draw, in random order."""
        demonstrations = self._demonstrations(index)
        decisions, valid = self._decisions(demonstrations)
        count = max(1, round(self.config.passes * len(valid)))
        if isinstance(demonstrations, Corrections):
            rounds = [self.rng.permutation(len(valid)) for _ in range(math.ceil(self.config.passes))]
            steps = np.concatenate(rounds)[:count]
        elif isinstance(demonstrations, Lessons) and self.config.roll_in is not None:
            steps = self.rng.permutation(len(valid))  # all of them follow the student's part
        elif self.config.roll_in is None:
            steps = self.rng.permutation(len(valid))[:count]
        else:  # right after the student's part, where its mistakes still show
            assert isinstance(demonstrations, Demonstrations)
            steps = self.rng.permutation(np.arange(demonstrations.begin, len(valid))[:count])
        if len(steps):
            self.indices.append(index)
            self.left.append(steps.tolist())
            self.sets.append((decisions, valid))
        self.next, self.instances = index + 1, self.instances + valid.shape[1]

    def _decisions(self, demonstrations: Demonstrations | Lessons | Corrections) -> tuple[TensorDictBase, Tensor]:
        """The set's decisions [T, B] with everything that is learnt from, and valid (T, B)."""
        if isinstance(demonstrations, (Lessons, Corrections)):
            decisions, valid = demonstrations.decisions(self.config.device)
            return decisions if self.plans else decisions.exclude("plan"), valid
        if not self.plans:
            return as_decisions(demonstrations, self.keys, self.config)
        keys = tuple(dict.fromkeys((*self.keys, *PLAN_KEYS)))
        decisions, valid = as_decisions(demonstrations, keys, self.config)
        return add_plans(decisions, demonstrations), valid

    def _demonstrations(self, index: int) -> Demonstrations | Lessons | Corrections:
        """The set of that index. Workers are kept busy with the next sets, twice as many as there are workers."""
        self._begin(range(index, index + 2 * self.config.workers + 1))
        return self._end(index)

    def _begin(self, indices: Iterable[int]) -> None:
        """Let the workers, if there are any, make the sets of these indices."""
        if self.config.workers == 0:
            return
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
            self._others = multiprocessing.active_children()
            with _signals_blocked():  # its resource tracker inherits that, and unblocks some of them here as it starts
                self._pool = ProcessPoolExecutor(self.config.workers, spawn, _set_up_worker)
        with _signals_blocked():  # which workers inherit when they start: signals are for the learning process
            for index in indices:
                if index not in self._pending:
                    self._pending[index] = self._pool.submit(demonstrate, self.config, index)

    def _end(self, index: int) -> Demonstrations | Lessons | Corrections:
        """The set of that index, once it is made."""
        return self._pending.pop(index).result() if self.config.workers else demonstrate(self.config, index)

    def state_dict(self) -> dict[str, Any]:
        """Which sets are at hand, and what is left of each."""
        return {
            "indices": self.indices,
            "left": self.left,
            "next": self.next,
            "instances": self.instances,
            "student": self.student,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Make the same sets again.

        Raises:
            ValueError: the student's weights have changed since the run began, or the sets come out shorter than they
                were, since another version of the code makes them.
        """
        if state["student"] != self.student:
            raise ValueError(f"roll_in={self.config.roll_in!r} holds other weights than when the run began")
        self.indices, self.left = list(state["indices"]), [list(left) for left in state["left"]]
        self._begin(self.indices)
        self.sets = [self._decisions(self._end(index)) for index in self.indices]
        for index, left, (_, valid) in zip(self.indices, self.left, self.sets, strict=True):
            if max(left) >= len(valid):
                raise ValueError(
                    f"set {index} of the run had at least {max(left) + 1} decision indices, now it has {len(valid)}: "
                    "another version of the code made it"
                )
        self.next, self.instances = state["next"], state["instances"]

    def close(self) -> None:
        """End the worker processes at once; a continuation makes their unfinished sets again."""
        if self._pool is not None:
            for process in multiprocessing.active_children():
                if process not in self._others:
                    process.terminate()
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
            self._pending.clear()


@contextmanager
def _signals_blocked() -> Iterator[None]:
    """A context in which SIGINT, SIGTERM and SIGHUP wait."""
    old = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)


def _set_up_worker() -> None:
    """A worker shares the cores with the learning process at a lower priority, and ends when that process does.

    A terminal or a job scheduler sends its signals to all processes of a run. The learning process decides what they
    mean, and still needs labels to finish its step.
    """
    end_with_parent()
    if hasattr(signal, "sigwaitinfo"):
        Thread(target=_end_on_parents_signal, daemon=True).start()
    else:  # macOS does not say who sent a signal, and the pool ends its workers by SIGTERM if one of them has died
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(5)


def _end_on_parents_signal() -> None:
    """Take the signals that are blocked in this process, and end on SIGTERM if the parent has sent it."""
    while True:
        received = signal.sigwaitinfo(ENDING)
        if received.si_signo == signal.SIGTERM and received.si_pid == os.getppid():
            os._exit(1)
