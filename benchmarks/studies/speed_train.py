"""Speed of training: episodes, demonstrations and decisions per second, and the share of the machine's FLOP rate.

Useful FLOP are those of the network's matrix products, forwards and backwards once each. They are divided by the rate
of a large float32 product on the same device, measured in the same run; with bfloat16 a share can exceed 100 %.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from rich.table import Table
from torch.utils.flop_counter import FlopCounterMode

from benchmarks.studies.timing import machine_title, matmul_rate, per_second, wait_for
from train.collect import draw, play, repeat
from train.demonstrations import demonstrate
from train.imitate import ImitationLearner
from train.presets import REFINE
from train.reinforce import ReinforceLearner
from train.supervised_config import ImitateConfig

SIZES = ((20, 3), (50, 5), (100, 10), (200, 20))
TOKENS = 3200  # instances times nodes in a batch
Precision = Literal["float32", "bfloat16"]


def speed_table(
    device: str = "cpu", seconds: float = 3.0, precision: Precision = "float32", tokens: int = TOKENS
) -> Table:
    """Measure every size for ``seconds`` each, with batches of ``tokens`` nodes."""
    rate = matmul_rate(device)
    table = Table("what", "size", "instances/s", "decisions/s", "of the matrix-product rate")
    table.title = (
        f"{machine_title(device)}; official DAN, pruned, {precision}; float32 product {rate / 1e9:.0f} GFLOP/s"
    )
    for n_nodes, n_agents in SIZES:
        batch = max(8, tokens // n_nodes)
        for name, measure in (("rollout", rollouts), ("imitation", imitation), ("REINFORCE, 8 samples", reinforcement)):
            size = {"n_nodes": (n_nodes, n_nodes), "n_agents": (n_agents, n_agents), "nodes_per_agent": 1}
            setting = {**size, "device": device, "precision": precision}
            instances, decisions, flops = measure(setting, batch, seconds)
            share = f"{100 * flops / rate:.0f} %"
            table.add_row(name, f"n={n_nodes}, m={n_agents}, B={batch}", f"{instances:.1f}", f"{decisions:.0f}", share)
        rate_of_teacher = teaching(n_nodes, n_agents, seconds)
        table.add_row("teacher, one core", f"n={n_nodes}, m={n_agents}", f"{rate_of_teacher:.1f}", "", "")
    return table


def rollouts(setting: dict, batch: int, seconds: float) -> tuple[float, float, float]:
    """Sampled episodes: instances, decisions and useful FLOP per second."""
    config = replace(REFINE, **setting)
    learner = ReinforceLearner(config)
    problem = draw(np.random.default_rng(0), config, batch)
    with FlopCounterMode(display=False) as counter:
        episode = play(learner.network, problem, config, "sample")
    decisions, flops = int(episode.valid.sum()), counter.get_total_flops()

    def once() -> int:
        play(learner.network, problem, config, "sample")
        return 1

    times = per_second(once, seconds, wait_for(config.device))
    return times * batch, times * decisions, times * flops


def imitation(setting: dict, batch: int, seconds: float) -> tuple[float, float, float]:
    """Optimiser steps on existing demonstrations: instances, decisions and useful FLOP per second."""
    tokens = batch * setting["n_nodes"][0]
    config = replace(ImitateConfig(), **setting, workers=0, teacher_iterations=1, set_tokens=tokens, buffer=4)
    learner = ImitationLearner(config)
    learner.buffer.draw(1)
    sets = list(learner.buffer.sets)

    def step() -> int:
        halfway = [decisions[len(valid) // 2][valid[len(valid) // 2]] for decisions, valid in sets]  # half visited
        learner.buffer.draw = lambda _: halfway
        learner.train_step()
        return sum(map(len, halfway))

    step()
    with FlopCounterMode(display=False) as counter:
        decisions = step()
    rate = per_second(step, seconds, wait_for(config.device))
    decisions_per_instance = setting["n_nodes"][0] - 1 + setting["n_agents"][0]
    return rate / decisions_per_instance, rate, rate / decisions * counter.get_total_flops()


def reinforcement(setting: dict, batch: int, seconds: float) -> tuple[float, float, float]:
    """Whole training steps of the preset "refine": instances, decisions and useful FLOP per second."""
    config = replace(REFINE, **setting, batch_size=max(1, batch // REFINE.samples), batch_tokens=None)
    learner = ReinforceLearner(config)
    problem = repeat(draw(np.random.default_rng(0), config, config.batch_size), config.samples)
    decisions = int(play(learner.network, problem, config, "sample").valid.sum())

    def step() -> int:
        learner.train_step()
        return 1

    with FlopCounterMode(display=False) as counter:
        step()
    times = per_second(step, seconds, wait_for(config.device))
    return times * len(problem.nodes), times * decisions, times * counter.get_total_flops()


def teaching(n_nodes: int, n_agents: int, seconds: float) -> float:
    """Instances that the reference solver labels per second, on one core."""
    size = {"n_nodes": (n_nodes, n_nodes), "n_agents": (n_agents, n_agents), "nodes_per_agent": 1}
    config = ImitateConfig(**size, set_tokens=16 * n_nodes)
    index = iter(range(10**9))

    def once() -> int:
        return len(demonstrate(config, next(index)).nodes)

    return per_second(once, seconds)
