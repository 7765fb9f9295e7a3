"""How fast: decisions and instances per second on this machine, against the floor where one is known."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from rich.console import Console
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode
from torchrl.envs.utils import step_mdp

from benchmarks.run import describe_machine
from dan_policy import DAN, DANConfig, load, make_actor, rollout
from dan_policy.episode import find_device
from mtsp_env import mtsp_v0
from mtsp_env.batched import BatchedMTSP
from train.presets import QUICK
from train.reinforce import Trainer


def machine(device: str = "cpu") -> str:
    """Processor, cores and versions, for the head of a table."""
    here = describe_machine()
    gpu = f", {torch.cuda.get_device_name()}" if device == "cuda" else ""
    return (
        f"{here['processor']}, {here['cores']} cores{gpu}; Python {here['python']}, NumPy {np.__version__}, "
        f"torch {torch.__version__} with {torch.get_num_threads()} threads"
    )


def speed(device: str = "cpu", seconds: float = 3.0) -> Table:
    """Measure everything; ``seconds`` each."""
    table = Table("what", "size", "per second", "aim", "of the matrix-product rate", title=machine(device))
    flops = matmul_rate(device)
    table.add_row("float32 matrix product", "2048^3", f"{flops / 1e9:.0f} GFLOP", "", "100 %")
    for n, m, aim in ((50, 5, 20_000), (200, 20, 10_000)):
        rate = aec_decisions(n, m, seconds)
        table.add_row("raw AEC decisions, random legal", f"n={n}, m={m}", f"{rate:,.0f}", f"{aim:,}", "")
    for batch, aim in ((1, ""), (64, ""), (1024, "1,000,000")):
        rate = batched_decisions(batch, device, seconds)
        table.add_row("batched decisions, random legal", f"n=50, m=5, B={batch}", f"{rate:,.0f}", aim, "")
    networks = {
        "official": (DAN(DANConfig.official()), "30"),
        "paper": (DAN(DANConfig.paper()), ""),
        "default": (load("default"), ""),
    }
    for name, (network, aim) in networks.items():
        rate, work = greedy_instances(network.to(device).eval(), device, seconds)
        share = f"{100 * rate * work / flops:.0f} %"
        table.add_row(f"DAN greedy instances, {name}", "n=50, m=5, B=64", f"{rate:.1f}", aim, share)
    for precision in ("float32", "bfloat16"):
        rate = trained_instances(device, precision, seconds)
        table.add_row(f"trained instances, quick, {precision}", "n=20, m=3, B=128", f"{rate:.1f}", "", "")
    return table


def per_second(work: Callable[[], int], seconds: float, wait: Callable[[], None] = lambda: None) -> float:
    """Units of ``work`` done per second, after one round to warm up."""
    work()
    wait()
    done, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds:
        done += work()
        wait()
    return done / elapsed


def wait_for(device: str) -> Callable[[], None]:
    """What waits until the device has done its work."""
    return torch.cuda.synchronize if device == "cuda" else lambda: None


def matmul_rate(device: str) -> float:
    """FLOP/s of a large float32 matrix product: the floor for the networks' time."""
    a = torch.randn(2048, 2048, device=device)

    def multiply() -> int:
        a @ a
        return 2 * 2048**3

    return per_second(multiply, 1.0, wait_for(device))


def aec_decisions(n_nodes: int, n_agents: int, seconds: float) -> float:
    """Decisions per second of the raw AEC environment, observations included, under random legal actions."""
    env, rng = mtsp_v0.raw_env(n_nodes=n_nodes, n_agents=n_agents), np.random.default_rng(0)

    def episode() -> int:
        env.reset(seed=0)
        while True:
            seen, _, terminated, truncated, _ = env.last()
            if terminated or truncated:
                return int(env.game.decisions[0])
            legal = seen["action_mask"].nonzero()[0]
            env.step(legal[int(rng.random() * len(legal))])

    return per_second(episode, seconds)


def batched_decisions(batch: int, device: str, seconds: float) -> float:
    """Decisions per second of whole random episodes, each row's first only, through TorchRL's ``step``."""
    env = BatchedMTSP(50, 5, [batch], depot="final", device=device, seed=0, check_actions=False)

    def episodes() -> int:
        td = env.reset()
        while not td["done"].all():
            td = step_mdp(env.step(env.rand_action(td)))
        return int(td["game", "decisions"].sum())

    return per_second(episodes, seconds, wait_for(device))


def greedy_instances(network: DAN, device: str, seconds: float) -> tuple[float, float]:
    """Instances per second of greedy episodes at (50, 5), B = 64, and FLOP per instance."""
    env = BatchedMTSP(50, 5, [64], depot="final", device=device, seed=0, check_actions=False)
    actor = make_actor(network)
    with FlopCounterMode(display=False) as counter:
        rollout(actor, env, "greedy")

    def batch() -> int:
        rollout(actor, env, "greedy")
        return 64

    return per_second(batch, seconds, wait_for(device)), counter.get_total_flops() / 64


def trained_instances(device: str, precision: str, seconds: float) -> float:
    """Instances per second of whole training steps of the preset "quick": play, baseline, gradient, update."""
    trainer = Trainer(
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
        trainer.train_step()
        return trainer.config.batch_size

    return per_second(step, seconds, wait_for(device))


def main(device: str = "cpu", seconds: float = 3.0) -> None:
    """Print the table. Raises ValueError where there is no such device."""
    find_device(device)
    Console(width=max(Console().width, 110)).print(speed(device, seconds))
