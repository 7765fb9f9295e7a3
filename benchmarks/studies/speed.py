"""``python -m benchmarks speed``: decisions and instances per second on this machine."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.studies import speed_peers, speed_solve, speed_train
from benchmarks.studies.speed_train import Precision
from benchmarks.studies.timing import machine_title, matmul_rate, per_second, wait_for
from dan_policy import DAN, DANConfig, load, rollout
from dan_policy.network import find_device
from mtsp_env import mtsp_v0
from mtsp_env.batched import BatchedMTSP
from mtsp_env.checks import check_count, check_seconds
from train.presets import QUICK
from train.reinforce import ReinforceLearner


def main(
    train: bool = False,
    solve: bool = False,
    peers: bool = False,
    device: str = "cpu",
    seconds: float = 3.0,
    precision: Precision = "float32",
    repeats: int = 5,
    peer_python: Path = speed_peers.PYTHON,
) -> None:
    """Measure the speed of environments, networks and training on this machine, and print a table.

    Args:
        train: measure rollouts, imitation and REINFORCE at n = 20, 50, 100 and 200 instead, with their share of the
            machine's FLOP rate.
        solve: measure time and memory of ``solve`` with the models `default` and `dan` instead, on the CPU.
        peers: measure a step of the batched environment and one of RL4CO's instead, on one thread of the CPU.
        device: cpu or cuda.
        seconds: seconds of measuring for each line.
        precision: precision of training.
        repeats: number of repetitions with ``solve`` and ``peers``.
        peer_python: Python of an environment with RL4CO (benchmarks/peers/README.md).

    Raises:
        OSError: there is no such interpreter, or it cannot import RL4CO.
        ValueError: an argument outside its range, or an unknown device.
    """
    if train + solve + peers > 1:
        raise ValueError("choose one of --train, --solve and --peers")
    check_seconds("seconds", seconds)
    check_count("repeats", repeats, minimum=1)
    find_device(device)
    if solve:
        table = speed_solve.speed_table(repeats=repeats)
    elif peers:
        table = speed_peers.speed_table(seconds, repeats, peer_python)
    elif train:
        table = speed_train.speed_table(device, seconds, precision)
    else:
        table = speed_table(device, seconds)
    Console(width=max(Console().width, 130)).print(table)


def speed_table(device: str = "cpu", seconds: float = 3.0) -> Table:
    """Measure both environments, greedy episodes and training for ``seconds`` each."""
    table = Table("what", "size", "per second", "target", "of the matrix-product rate", title=machine_title(device))
    flops = matmul_rate(device)
    table.add_row("float32 matrix product", "2048^3", f"{flops / 1e9:.0f} GFLOP", "", "100 %")
    for n, m, target in ((50, 5, 20_000), (200, 20, 10_000)):
        rate = aec_decisions(n, m, seconds)
        table.add_row("AEC decisions, random legal actions", f"n={n}, m={m}", f"{rate:,.0f}", f"{target:,}", "")
    for batch, target in ((1, ""), (64, ""), (1024, "1,000,000")):
        rate = batched_decisions(batch, device, seconds)
        size = f"n=50, m=5, B={batch}"
        table.add_row("batched decisions, random legal actions", size, f"{rate:,.0f}", target, "")
    networks = {
        "DAN official": (DAN(DANConfig.official()), "30"),
        "DAN paper": (DAN(DANConfig.paper()), ""),
        "shipped dan": (load("dan"), ""),
        "shipped default": (load("default"), ""),
    }
    for name, (network, target) in networks.items():
        rate, work = greedy_instances(network.to(device).eval(), device, seconds)
        share = f"{100 * rate * work / flops:.0f} %"
        table.add_row(f"instances solved greedily, {name}", "n=50, m=5, B=64", f"{rate:.1f}", target, share)
    for precision in ("float32", "bfloat16"):
        rate = trained_instances(device, precision, seconds)
        table.add_row(f"instances trained on, quick, {precision}", "n=20, m=3, B=128", f"{rate:.1f}", "", "")
    return table


def aec_decisions(n_nodes: int, n_agents: int, seconds: float) -> float:
    """Decisions per second of the raw AEC environment under random legal actions, observations included."""
    env, rng = mtsp_v0.raw_env(n_nodes=n_nodes, n_agents=n_agents), np.random.default_rng(0)

    def episode() -> int:
        env.reset(seed=0)
        decisions = 0
        while True:
            observation, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                return decisions
            legal = observation["action_mask"].nonzero()[0]
            env.step(legal[int(rng.random() * len(legal))])
            decisions += 1

    return per_second(episode, seconds)


def batched_decisions(batch: int, device: str, seconds: float) -> float:
    """Decisions per second of whole episodes under random legal actions; finished games do not count."""
    env = BatchedMTSP(50, 5, batch, depot="final", device=device, seed=0, check_actions=False)

    def episodes() -> int:
        td = env.reset()
        while not td["done"].all():
            td = env.step(env.rand_action(td))["next"]
        return int(td["game", "decisions"].sum())

    return per_second(episodes, seconds, wait_for(device))


def greedy_instances(network: nn.Module, device: str, seconds: float) -> tuple[float, float]:
    """Instances solved greedily per second at n = 50, m = 5, B = 64, and FLOP per instance."""
    env = BatchedMTSP(50, 5, 64, depot="final", device=device, seed=0, check_actions=False)
    with FlopCounterMode(display=False) as counter:
        rollout(network, env, "greedy")

    def solve_batch() -> int:
        rollout(network, env, "greedy")
        return 64

    return per_second(solve_batch, seconds, wait_for(device)), counter.get_total_flops() / 64


def trained_instances(device: str, precision: str, seconds: float) -> float:
    """Instances per second of whole training steps of the preset "quick": rollout, baseline, gradient, update."""
    learner = ReinforceLearner(
        replace(
            QUICK,
            device=device,
            precision=precision,
            n_nodes=(20, 20),
            n_agents=(3, 3),
            challenge_instances=8,
            challenge_every=10**9,
            validate_every=10**9,
        )
    )

    def step() -> int:
        learner.train_step()
        return learner.config.batch_size

    return per_second(step, seconds, wait_for(device))
