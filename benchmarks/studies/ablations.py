"""Ablations: variants of DAN and of its training, trained for the same time and compared on one set of instances."""

from __future__ import annotations

import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import sem
from torch import nn

from benchmarks import best_known
from benchmarks.files import write_text
from benchmarks.harness.machine import describe_machine
from benchmarks.reports.markdown import markdown_table
from benchmarks.suite import SEED, Cell
from dan_policy import DANConfig
from dan_policy.episode import Decode, rollout
from dan_policy.planning import SPEED
from mtsp_env.batched import BatchedMTSP
from mtsp_env.tours import makespan
from train.config import ImitateConfig
from train.imitate import ImitationLearner, imitate
from train.presets import REFINE
from train.reinforce import reinforce

REPORT = Path(__file__).parents[1] / "results" / "ablations.md"
CELLS = (Cell(50, 5, 20), Cell(50, 10, 20), Cell(100, 10, 20))  # of Table 1
SAMPLES = 64
SIZES = {"n_nodes": (20, 50), "n_agents": (2, 10), "nodes_per_agent": 5}  # of the training instances
TRIAL = 20.0  # seconds of training from which the number of imitation steps is derived


@dataclass(frozen=True)
class Variant:
    """A network and how its training time is spent.

    Attributes:
        name: its name in the table.
        imitation: share of the time for imitation; the rest is REINFORCE with a baseline shared by samples.
        network: differences from the shipped configuration of DAN.
        policy: the network, as ``RunConfig.policy`` takes it.
    """

    name: str
    imitation: float = 0.7
    network: dict[str, Any] = field(default_factory=dict)
    policy: str = "dan"


VARIANTS = (
    Variant("as shipped: imitation, then REINFORCE"),
    Variant("imitation alone", imitation=1.0),
    Variant("REINFORCE alone", imitation=0.0),
    Variant("visited cities not pruned", network={"prune_visited": False}),
    Variant("one layer in the city encoder", network={"city_layers": 1}),
    Variant("no agent encoder", network={"agent_layers": 0}),
    Variant("no city-agent encoder", network={"city_agent_layers": 0}),
    Variant("neither agent nor city-agent encoder", network={"agent_layers": 0, "city_agent_layers": 0}),
    Variant("attention model (Kool et al. 2019)", policy="benchmarks.policies.attention_model:AttentionModel"),
)


def main(minutes: float = 15.0, folder: Path = Path("runs/ablations"), seed: int = 0, out: Path = REPORT) -> None:
    """Train variants of DAN and of its training for the same time on one thread, and compare them in a table.

    Args:
        minutes: training time of each variant on one thread, the labelling of its instances included.
        folder: folder of the runs; variants that have a result there are not trained again.
        seed: seed of the training. The instances that variants are compared on are never trained on.
        out: file for the table in Markdown.

    Raises:
        ValueError: ``minutes`` is not above 0, or ``folder`` has results of runs with another length or seed.
    """
    if not minutes > 0:
        raise ValueError(f"minutes must be above 0, got {minutes!r}")
    setting = {"minutes": minutes, "seed": seed}
    results = []
    for number, variant in enumerate(VARIANTS):
        file = folder / f"{number}.json"
        if not file.exists():
            print(f"{variant.name}: {minutes:g} minutes", flush=True)
            spawn = multiprocessing.get_context("spawn")  # a process for each: memory left by one slows no other
            with ProcessPoolExecutor(1, spawn) as pool:
                result = pool.submit(train_and_evaluate, variant, 60 * minutes, seed, folder / str(number)).result()
            write_text(file, json.dumps(setting | asdict(variant) | result))
        result = json.loads(file.read_text(encoding="utf-8"))
        if {key: result[key] for key in setting} != setting or result["name"] != variant.name:
            raise ValueError(f"{file} belongs to another run: {result['name']!r}, {result['minutes']:g} minutes")
        results.append(result)
    table = to_markdown(results)
    print(table)
    write_text(out, f"# Ablations\n\n{_head(minutes, seed)}\n\n{table}\n")


def train_and_evaluate(variant: Variant, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """Train a variant; returns its steps, seconds and number of weights, and its gaps on each cell."""
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    common = {
        "seed": seed,
        "threads": 1,
        "network": DANConfig(**{"prune_visited": True} | variant.network),
        "policy": variant.policy,
        "validation_instances": 64,
        "tensorboard": False,
        "resume": False,
    } | SIZES
    stem = f"{time.time_ns()}"  # unique, so that an interrupted run is not resumed
    imitation_steps, reinforce_steps, spent, init = 0, 0, 0.0, None
    if variant.imitation > 0:
        config = ImitateConfig(out=folder / f"{stem}-imitation", steps=10**9, workers=0, **common)
        steps = max(1, int(variant.imitation * seconds / seconds_per_step(config)))
        run = imitate(replace(config, steps=steps, validate_every=steps, warmup=max(1, min(200, steps // 5))))
        imitation_steps, spent, init = run.step, run.seconds, str(run.config.out / "last.safetensors")
    if variant.imitation < 1:
        config = replace(REFINE, out=folder / f"{stem}-reinforce", steps=10**9, init=init, **common)
        run = reinforce(replace(config, seconds=(1 - variant.imitation) * seconds))
        reinforce_steps, spent = run.step, spent + run.seconds
    network = run.averaged_network.eval()
    return {
        "imitation_steps": imitation_steps,
        "reinforce_steps": reinforce_steps,
        "seconds": spent,
        "weights": sum(p.numel() for p in network.parameters()),
        "gaps": {cell.label: {d: gaps(network, cell, d) for d in ("greedy", "sample")} for cell in CELLS},
    }


def seconds_per_step(config: ImitateConfig) -> float:
    """Seconds for a step of imitation, labelling included, measured on a run that is thrown away."""
    learner = ImitationLearner(config)
    learner.train_step()
    start, steps = time.perf_counter(), 0
    while time.perf_counter() - start < TRIAL:
        learner.train_step()
        steps += 1
    learner.close()
    return (time.perf_counter() - start) / steps


def gaps(network: nn.Module, cell: Cell, decode: Decode) -> list[float]:
    """The gap of each instance to its best known tours, greedy or for the best of SAMPLES; 0.1 is 10 %."""
    instances, kept = cell.instances(SEED), best_known.read(cell, SEED)
    batch = SAMPLES if decode == "sample" else 1
    env = BatchedMTSP(cell.n_nodes, cell.n_agents, batch, SPEED, depot="final", check_actions=False)
    torch.manual_seed(SEED)
    values = []
    for i, instance in enumerate(instances):
        nodes = torch.as_tensor(instance.nodes.copy()).expand(batch, -1, -1)
        cost = float(env.makespan(rollout(network, env, decode, nodes).last).min())
        values.append(cost / makespan(instance, kept[i]) - 1)
    return values


def to_markdown(results: list[dict[str, Any]]) -> str:
    """A table with a line for each variant."""
    decodes = {"greedy": "g.", "sample": f"s.{SAMPLES}"}
    heads = [f"{cell.heading}, {short}" for cell in CELLS for short in decodes.values()]
    lines = []
    for result in results:
        gaps = [np.array(result["gaps"][cell.label][d]) * 100 for cell in CELLS for d in decodes]
        lines.append(
            [
                result["name"],
                *(f"{gap.mean():.1f} ± {sem(gap):.1f}" for gap in gaps),
                f"{result['seconds'] / 60:.1f}",
                f"{result['imitation_steps']:,}",
                f"{result['reinforce_steps']:,}",
                f"{result['weights']:,}",
            ]
        )
    return markdown_table(
        ["gap to best known, %", *heads, "minutes", "steps of imitation", "of REINFORCE", "weights"], lines
    )


def _head(minutes: float, seed: int) -> str:
    machine = describe_machine()
    return (
        f"Each variant was trained for {minutes:g} minutes on one thread ({machine['processor']}), labelling included, "
        f"on n in {list(SIZES['n_nodes'])} and m in {list(SIZES['n_agents'])}, seed {seed}: 70 % imitation and "
        "30 % REINFORCE, unless its name says otherwise. Mean gap to the best known tours of Table 1's 20 instances in "
        "each column (n, m), ± standard error. Each variant was trained once, so small differences may be chance. "
        "The number of imitation steps was derived from a short trial; the column of minutes says how long they took. "
        f"Made by `python -m benchmarks ablations --minutes {minutes:g}`."
    )
