"""Memory of long processes: it must not grow with the number of episodes, resets, solutions or training steps.

Each case runs in a process of its own. Its resident memory is read after a tenth of its rounds, when caches are full,
and at the end; the difference is the growth.
"""

from __future__ import annotations

import math
import multiprocessing
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import torch
from rich.console import Console
from rich.table import Table

from benchmarks.studies.timing import machine_title
from mtsp_env.checks import check_count
from mtsp_env.processes import end_with_parent

WARM_UP = 0.1  # share of the rounds before the first reading


@dataclass(frozen=True)
class Memory:
    """Resident memory of a process in bytes.

    Attributes:
        warm: after the warm-up.
        end: after the last round.
        peak: the greatest so far.
        seconds: time of all rounds.
    """

    warm: int
    end: int
    peak: int
    seconds: float


def aec_episodes() -> Generator[None, None, None]:
    """Episodes of random legal actions in the PettingZoo environment, n = 10, m = 3."""
    from mtsp_env import mtsp_v0

    env = mtsp_v0.env(n_nodes=10, n_agents=3)
    rng = np.random.default_rng(0)
    for seed in range(sys.maxsize):
        env.reset(seed=seed)
        for _ in env.agent_iter():
            observation, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                break
            env.step(int(rng.choice(np.flatnonzero(observation["action_mask"]))))
        yield


def batched_resets() -> Generator[None, None, None]:
    """Resets of the batched environment, 256 instances, n = 50, m = 5."""
    from mtsp_env.batched import BatchedMTSP

    env = BatchedMTSP(50, 5, 256, seed=0)
    while True:
        env.reset()
        yield


def solutions() -> Generator[None, None, None]:
    """Solutions with the shipped model of instances with changing n in [10, 30] and m in [2, 5]."""
    from dan_policy import solve
    from mtsp_env.distributions import sample

    rng = np.random.default_rng(0)
    while True:
        n_nodes, n_agents = int(rng.integers(10, 31)), int(rng.integers(2, 6))
        solve(sample("uniform", rng, 1, n_nodes, n_agents).instance(0), device="cpu")
        yield


def training_steps() -> Generator[None, None, None]:
    """Steps of REINFORCE with changing n in [10, 30] and m in [2, 5], with logs, but without checkpoints."""
    from train.logs import Logs
    from train.presets import QUICK
    from train.reinforce import ReinforceLearner

    with tempfile.TemporaryDirectory() as folder:
        learner = ReinforceLearner(replace(QUICK, batch_size=8, challenge_every=50, challenge_instances=16))
        with closing(Logs(Path(folder), 0, tensorboard=True)) as logs:  # its thread writes to the folder until then
            while True:
                logs.write(learner.step + 1, learner.train_step())
                yield


CASES: dict[str, tuple[Callable[[], Generator[None, None, None]], int]] = {
    "AEC episodes": (aec_episodes, 20_000),
    "batched resets": (batched_resets, 2_000),
    "solutions": (solutions, 500),
    "training steps": (training_steps, 1_000),
}


def main(share: float = 1.0, cases: tuple[str, ...] = tuple(CASES)) -> None:
    """Measure the memory of long processes, and how much it grows.

    Args:
        share: how many rounds to run, as a share of the usual number.
        cases: which to measure.

    Raises:
        ValueError: an unknown case, or a share that leaves fewer than 10 rounds.
    """
    table = Table("rounds", "of", "after a tenth, MiB", "at the end, MiB", "growth, MiB", "peak, MiB", "seconds")
    table.title = f"Memory; {machine_title()}"
    for name in cases:
        if name not in CASES:
            raise ValueError(f"unknown case {name!r}; choose from {list(CASES)}")
        if not 0 < share < math.inf:
            raise ValueError(f"share must be a finite number above 0, got {share!r}")
        rounds = int(share * CASES[name][1])
        check_count(f"rounds of {name!r}", rounds, 10)
        with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), end_with_parent) as pool:
            memory = pool.submit(measure, name, rounds).result()
        growth = (memory.end - memory.warm) / 2**20
        print(f"{rounds} {name}: {growth:+.1f} MiB in {memory.seconds:.0f} s", file=sys.stderr)
        sizes = (memory.warm, memory.end, memory.end - memory.warm, memory.peak)
        table.add_row(str(rounds), name, *(f"{size / 2**20:,.1f}" for size in sizes), f"{memory.seconds:.0f}")
    Console().print(table)


def measure(name: str, rounds: int) -> Memory:
    """Run a case in this process, on one thread."""
    torch.set_num_threads(1)
    case, process, start = CASES[name][0](), psutil.Process(), time.perf_counter()
    for number in range(1, rounds + 1):
        next(case)
        if number == int(WARM_UP * rounds):
            warm = process.memory_info().rss
    end, seconds = process.memory_info().rss, time.perf_counter() - start
    case.close()
    unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, which may lag a little behind
    peak = max(warm, end, unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    return Memory(warm, end, peak, seconds)
