"""Imitation of the reference solver, a warm start for REINFORCE, from top to bottom."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import time
from concurrent.futures import Future, ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor

from dan_policy.actor import make_actor
from dan_policy.registry import find
from train.collect import autocast
from train.config import ImitateConfig
from train.demonstrations import Demonstrations, demonstrate, replay
from train.learner import Learner, check_folder, run
from train.loss import log_probs


class Imitator(Learner):
    """What changes during a run, and one step of it."""

    config: ImitateConfig

    def __init__(self, config: ImitateConfig):
        super().__init__(config)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimiser, partial(rate, config))
        self.buffer = Buffer(config, self.rng)

    def train_step(self) -> dict[str, float]:
        """One optimiser step on some rows of the buffer: cross-entropy with the teacher's choice."""
        config, start = self.config, time.perf_counter()
        rows = self.buffer.draw(config.rows)
        waited = time.perf_counter() - start
        self.optimiser.zero_grad()
        loss, decisions, right = 0.0, 0, 0
        for row in rows:  # a row of 16 games at n = 200 counts as much as one of 256 at n = 20
            with autocast(config):
                log_prob = log_probs(make_actor(self.network), row)
                part = -log_prob.mean() / len(rows)
            part.backward()
            loss += part.detach()
            decisions += len(row)
            right = right + (log_prob.detach() > math.log(0.5)).sum()
        norm = torch.nn.utils.clip_grad_norm_(self.network.parameters(), config.max_grad_norm)
        self.optimiser.step()
        self.schedule.step()
        self.average.update_parameters(self.network)

        self.step += 1
        self.instances = self.buffer.instances
        return {
            "loss": float(loss),
            "sure_and_right": float(right) / decisions,
            "grad_norm": float(norm),
            "learning_rate": self.schedule.get_last_lr()[0],
            "decisions_per_second": decisions / (time.perf_counter() - start),
            "waited": waited,
        }

    def state_dict(self) -> dict[str, Any]:
        """Optimiser, schedule, and where the buffer stands."""
        parts = ("optimiser", "schedule", "buffer")
        return {part: getattr(self, part).state_dict() for part in parts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for part in ("optimiser", "schedule", "buffer"):
            getattr(self, part).load_state_dict(state[part])

    def close(self) -> None:
        """End the worker processes."""
        self.buffer.close()


def rate(config: ImitateConfig, step: int) -> float:
    """Factor on the learning rate: a linear warm-up, then half a cosine down to ``final_rate``."""
    if step < config.warmup:
        return (step + 1) / config.warmup
    over = min(1.0, (step - config.warmup) / max(1, config.steps - config.warmup))
    return config.final_rate + (1 - config.final_rate) * (1 + math.cos(math.pi * over)) / 2


class Buffer:
    """Sets of demonstrations to learn from, made by worker processes while the network learns.

    Set i depends on the configuration and i alone, so the buffer's state is a few numbers: a continuation makes the
    same sets again.
    """

    def __init__(self, config: ImitateConfig, rng: np.random.Generator):
        self.config, self.rng = config, rng
        self.student = None if config.roll_in is None else hashlib.sha256(find(config.roll_in).read_bytes()).hexdigest()
        self.indices: list[int] = []  # of the sets at hand
        self.left: list[list[int]] = []  # decision indices of each that are yet to be learnt from
        self.sets: list[tuple[TensorDictBase, Tensor]] = []  # decisions [T, B], valid (T, B)
        self.next, self.instances = 0, 0
        self._pool: ProcessPoolExecutor | None = None
        self._pending: dict[int, Future] = {}

    def draw(self, count: int) -> list[TensorDictBase]:
        """One row, all decisions at one index, of each of ``count`` sets; used-up sets give way to fresh ones."""
        while len(self.sets) < self.config.buffer:
            self._add(self.next)
        rows = []
        for i in self.rng.choice(len(self.sets), count, replace=False).tolist():
            (decisions, valid), step = self.sets[i], self.left[i].pop()
            rows.append(decisions[step][valid[step]])
        kept = [i for i, left in enumerate(self.left) if left]
        self.indices, self.left, self.sets = ([of[i] for i in kept] for of in (self.indices, self.left, self.sets))
        return rows

    def _add(self, index: int) -> None:
        demonstrations = self._made(index)
        decisions, valid = replay(demonstrations, self.config)
        count = max(1, round(self.config.passes * len(valid)))
        if self.config.roll_in is None:
            steps = self.rng.permutation(len(valid))[:count]
        else:  # where the student's mistakes still show
            steps = self.rng.permutation(np.arange(demonstrations.begin, len(valid))[:count])
        self.indices.append(index)
        self.left.append(steps.tolist())
        self.sets.append((decisions, valid))
        self.next, self.instances = index + 1, self.instances + valid.shape[1]

    def _made(self, index: int) -> Demonstrations:
        """The set, from the workers, who are kept ahead by twice their number."""
        if self.config.workers == 0:
            return demonstrate(self.config, index)
        if self._pool is None:
            spawn = multiprocessing.get_context("spawn")  # a fork of a process with threads may hang
            self._pool = ProcessPoolExecutor(self.config.workers, spawn, _one_thread)
        for ahead in range(index, index + 2 * self.config.workers + 1):
            if ahead not in self._pending:
                self._pending[ahead] = self._pool.submit(demonstrate, self.config, ahead)
        return self._pending.pop(index).result()

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
            ValueError: the student that played in them is another one now.
        """
        if state.get("student", self.student) != self.student:  # older checkpoints do not say
            raise ValueError(f"roll_in={self.config.roll_in!r} holds other weights than when the run began")
        self.indices, self.left = list(state["indices"]), [list(left) for left in state["left"]]
        self.sets = [replay(self._made(index), self.config) for index in self.indices]
        self._pending.clear()
        self.next, self.instances = state["next"], state["instances"]

    def close(self) -> None:
        """End the worker processes."""
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None
            self._pending.clear()


def _one_thread() -> None:
    """Workers share the cores with the network: they run beside it, and step back for it."""
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(5)


def imitate(config: ImitateConfig) -> Imitator:
    """Train until ``config.steps`` or ``config.seconds`` are over, or Ctrl-C; saves in any case.

    Raises:
        FileExistsError: ``config.out`` holds another run and ``resume`` was not asked for.
        ModuleNotFoundError: no Numba for the teacher.
        ValueError, OSError: nothing to resume, or another configuration.
    """
    import mtsp_env.reference  # noqa: F401 (say at once that Numba is missing)

    check_folder(config)
    if config.roll_in is not None:
        find(config.roll_in)  # say at once that there are no such weights
    imitator = Imitator(config)
    run(imitator)
    return imitator
