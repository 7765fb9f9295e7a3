"""A step of the batched environment beside a step of RL4CO's, which runs in a Python environment of its own.

Both play whole random episodes at n = 50 and m = 5 on one thread of the CPU, draw actions with the same
``torch.multinomial``, and step in the same loop, ``td = env.step(td)["next"]``. RL4CO's environment has no clock: its
agents leave one after the other. The repetitions of all environments are interleaved, so that a change in the machine's
speed affects them alike.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median

import torch
from rich.table import Table
from tensordict import TensorDictBase

from benchmarks.studies.timing import machine_title
from mtsp_env.batched import BatchedMTSP

FOLDER = Path(__file__).parents[1] / "peers"
PYTHON = FOLDER / ".venv" / "bin" / "python"
N_NODES, N_AGENTS = 50, 5
BATCHES = (64, 1024)
RL4CO, EAGER, COMPILED = "RL4CO MTSPEnv", "BatchedMTSP", "BatchedMTSP, compiled"


@dataclass
class Timings:
    """Measurements of one environment and batch size: a list for each episode, with a value for each of its steps.

    Attributes:
        env: seconds of ``env.step``, without drawing the action.
        loop: seconds of a whole pass of the loop, drawing included.
        decisions: decisions of each episode in ``loop``; those of finished games do not count.
    """

    env: list[list[float]] = field(default_factory=list)
    loop: list[list[float]] = field(default_factory=list)
    decisions: list[int] = field(default_factory=list)

    def extend(self, other: Timings) -> None:
        """Add the measurements of more episodes."""
        self.env += other.env
        self.loop += other.loop
        self.decisions += other.decisions

    @property
    def decisions_per_second(self) -> float:
        """Decisions per second of the whole loop, at its best."""
        steps = mean(len(episode) for episode in self.loop)
        return mean(self.decisions) / (steps * best(self.loop))


def best(episodes: list[list[float]]) -> float:
    """Mean over an episode's steps of the shortest time that each of them took in any episode.

    On a busy machine every episode is interrupted at some steps, but no step is interrupted in all episodes.
    """
    return mean(min(times) for times in zip(*episodes, strict=False))


def typical(episodes: list[list[float]]) -> float:
    """Median over all steps of all episodes."""
    return median(time for episode in episodes for time in episode)


def speed_table(seconds: float, repeats: int, python: Path = PYTHON, compiled: bool = True) -> Table:
    """Measure RL4CO's environment and ours, eager and compiled, in turns.

    Args:
        seconds: seconds of measuring for each environment and batch size in each repetition.
        repeats: number of repetitions.
        python: Python of an environment with RL4CO.
        compiled: measure the compiled rules too; compiling takes a minute.

    Raises:
        OSError: there is no such interpreter, or it cannot run RL4CO.
    """
    if not python.exists():
        raise FileNotFoundError(
            f"{python} does not exist; {FOLDER / 'README.md'} says how to install RL4CO in an environment of its own, "
            "and --peer-python names its interpreter"
        )
    versions: dict[str, str] = {}
    timings: dict[tuple[str, int], Timings] = {}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        environments = {(EAGER, batch): _environment(batch) for batch in BATCHES}
        if compiled:
            environments |= {(COMPILED, batch): _environment(batch).compile() for batch in BATCHES}
        for key, env in environments.items():
            timings[key] = Timings()
            measure(env, seconds=0.0)  # warms up and compiles
        for _ in range(repeats):
            for batch in BATCHES:
                versions, peer = measure_rl4co(python, batch, seconds)
                timings.setdefault((RL4CO, batch), Timings()).extend(peer)
                for (name, size), env in environments.items():
                    if size == batch:
                        timings[name, size].extend(measure(env, seconds))
        title = machine_title()
    finally:
        torch.set_num_threads(threads)
    return _table(timings, versions, title)


def _environment(batch: int) -> BatchedMTSP:
    return BatchedMTSP(N_NODES, N_AGENTS, batch, depot="final", seed=0, check_actions=False)


def measure(env: BatchedMTSP, seconds: float) -> Timings:
    """Play pairs of episodes for ``seconds``, at least one pair: one for ``env``, one for ``loop``."""
    timings, start = Timings(), time.perf_counter()
    while not timings.env or time.perf_counter() - start < seconds:
        timings.env.append(env_seconds(env))
        loop, decisions = loop_seconds(env)
        timings.loop.append(loop)
        timings.decisions.append(decisions)
    return timings


def draw(td: TensorDictBase) -> torch.Tensor:
    """Uniformly random legal actions (B,)."""
    return torch.multinomial(td["action_mask"].float(), 1).squeeze(-1)


def env_seconds(env: BatchedMTSP) -> list[float]:
    """Seconds of each ``env.step`` of a random episode, without drawing the actions."""
    td, seconds = env.reset(), []
    while not td["done"].all():
        td.set("action", draw(td))
        start = time.perf_counter()
        td = env.step(td)["next"]
        seconds.append(time.perf_counter() - start)
    return seconds


def loop_seconds(env: BatchedMTSP) -> tuple[list[float], int]:
    """Seconds of each pass of the loop of a random episode, drawing included, and the number of decisions."""
    td, done, times = env.reset(), [], [time.perf_counter()]
    while not td["done"].all():
        td.set("action", draw(td))
        td = env.step(td)["next"]
        done.append(td["done"])
        times.append(time.perf_counter())
    decisions = int((~torch.cat(done)).sum()) + len(done[0])
    return [end - start for start, end in itertools.pairwise(times)], decisions


def measure_rl4co(python: Path, batch: int, seconds: float) -> tuple[dict[str, str], Timings]:
    """Run ``peers/rl4co_speed.py`` with another Python; returns the versions of its packages and the measurements.

    Raises:
        OSError: it fails; the message ends with the last line of its standard error.
    """
    command = [str(python), str(FOLDER / "rl4co_speed.py"), "--nodes", str(N_NODES), "--agents", str(N_AGENTS)]
    command += ["--batch", str(batch), "--seconds", str(seconds)]
    process = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
    if process.returncode:
        last_line = (process.stderr.strip().splitlines() or ["no message"])[-1]
        raise OSError(f"{python} cannot run {FOLDER / 'rl4co_speed.py'} ({FOLDER / 'README.md'}): {last_line}")
    report = json.loads(process.stdout)
    return report["versions"], Timings(report["env"], report["loop"], report["decisions"])


def _table(timings: dict[tuple[str, int], Timings], versions: dict[str, str], title: str) -> Table:
    """Best and median of every measurement, and ratios to RL4CO's; below 1 ours is faster (above 1 for decisions)."""
    peer = ", ".join(f"{name} {version}" for name, version in versions.items())
    table = Table(
        "environment",
        "B",
        "env.step, best ms",
        "median ms",
        "best / RL4CO's",
        "median / RL4CO's",
        "whole loop, best ms",
        "decisions/s, best",
        "/ RL4CO's",
        title=f"n={N_NODES}, m={N_AGENTS}, whole random episodes; {title}; {peer}",
    )
    for batch in BATCHES:
        base = timings[RL4CO, batch]
        for (name, size), values in sorted(timings.items(), key=lambda item: item[0][0] != RL4CO):
            if size == batch:
                table.add_row(
                    name,
                    str(batch),
                    f"{1e3 * best(values.env):.3f}",
                    f"{1e3 * typical(values.env):.3f}",
                    f"{best(values.env) / best(base.env):.2f}",
                    f"{typical(values.env) / typical(base.env):.2f}",
                    f"{1e3 * best(values.loop):.3f}",
                    f"{values.decisions_per_second:,.0f}",
                    f"{values.decisions_per_second / base.decisions_per_second:.2f}",
                )
    return table
