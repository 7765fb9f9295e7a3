"""Ablations: networks and ways of training them, trained for the same time and compared on one set of instances."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

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
from dan_policy.joint import JointConfig
from dan_policy.planning import SPEED
from mtsp_env.batched import BatchedMTSP
from mtsp_env.checks import check_seconds
from mtsp_env.files import read_json
from mtsp_env.processes import end_with_parent
from mtsp_env.tours import makespan
from train import checkpoint
from train.config import RunConfig
from train.imitate import imitate
from train.learner import checkpoint_path
from train.optimisers import OptimiserName
from train.presets import REFINE
from train.reinforce import reinforce
from train.supervised_config import ImitateConfig

RESULTS = Path(__file__).parents[1] / "results"
CELLS = (Cell(50, 5, 20), Cell(50, 10, 20), Cell(100, 10, 20))  # of Table 1
SAMPLES = 64
SIZES = {"n_nodes": (20, 50), "n_agents": (2, 10), "nodes_per_agent": 5}  # of the training instances


@dataclass(frozen=True)
class Variant:
    """A network and how its training time is spent.

    Attributes:
        name: its name in the table.
        imitation: share of the time for imitation; the rest is REINFORCE with a baseline shared by samples.
        network: differences from the shipped configuration of the network, for the policies dan and joint.
        policy: the network, as ``RunConfig.policy`` takes it.
        next_weight: weight of the other agents' next nodes in the loss of imitation.
        assignment_weight: weight of each city's visitor in the loss of imitation.
        optimiser: the optimiser of imitation.
    """

    name: str
    imitation: float = 0.7
    network: dict[str, Any] = field(default_factory=dict)
    policy: str = "dan"
    next_weight: float = 0.0
    assignment_weight: float = 0.0
    optimiser: OptimiserName = "adamw"


DAN_VARIANTS = (
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

DENSE_LABELS = (
    Variant("DAN", imitation=1.0),
    Variant("DAN, agent of every city", imitation=1.0, network={"assignment": True}, assignment_weight=1.0),
    Variant("joint", imitation=1.0, policy="joint"),
    Variant("joint, next node of every agent", imitation=1.0, policy="joint", next_weight=0.5),
    Variant("joint, agent of every city", imitation=1.0, policy="joint", assignment_weight=1.0),
    Variant("joint, both", imitation=1.0, policy="joint", next_weight=0.5, assignment_weight=1.0),
)

_JOINT = Variant("joint", imitation=1.0, policy="joint", next_weight=0.5, assignment_weight=1.0)

JOINT_VARIANTS = (
    _JOINT,
    replace(_JOINT, name="joint, distances", network={"distances": True}),
    replace(_JOINT, name="joint, Muon", optimiser="muon"),
    replace(_JOINT, name="joint, distances, Muon", network={"distances": True}, optimiser="muon"),
)

Study = Literal["dan", "dense-labels", "joint"]
STUDIES: dict[Study, tuple[Variant, ...]] = {
    "dan": DAN_VARIANTS,
    "dense-labels": DENSE_LABELS,
    "joint": JOINT_VARIANTS,
}
NOTES: dict[Study, str] = {
    "dan": "70 % imitation and 30 % REINFORCE, unless its name says otherwise",
    "dense-labels": "imitation alone. The labels are the next node of the deciding agent and what the name says",
    "joint": "imitation alone. The labels are the next node of every agent and the agent of every city; the optimiser "
    "is AdamW unless the name says otherwise",
}


def main(
    study: Study = "dan",
    minutes: float = 15.0,
    seeds: tuple[int, ...] = (0,),
    folder: Path = Path("runs/ablations"),
    out: Path | None = None,
) -> None:
    """Train variants of a network and of its training for the same time on one thread, and compare them in a table.

    The same command continues an interrupted study, also within a variant.

    Args:
        study: "dan" for parts of DAN and of its training, "dense-labels" for networks and what they are taught: the
            next node of the deciding agent alone, that of every agent, the agent of every city, or both; "joint" for
            distances in the joint network, and its optimiser.
        minutes: training time of each variant and seed on one thread, the labelling of its instances included.
        seeds: seeds of the training; every variant is trained once with each. The instances that variants are compared
            on are never trained on.
        folder: folder of the runs; variants that have a result there are not trained again.
        out: file for the table in Markdown; by default the study's file in benchmarks/results.

    Raises:
        ValueError: ``minutes`` is not a finite number above 0, there are no seeds, or ``folder`` has damaged results or
            those of runs of another length.
    """
    check_seconds("minutes", minutes, unit="minutes")
    if not seeds:
        raise ValueError("name at least one seed")
    results = []
    for seed in seeds:  # a whole table for each seed, should the time end early
        for number, variant in enumerate(STUDIES[study]):
            results.append(_result(variant, minutes, seed, folder / f"{study}-{number}-seed{seed}"))
            write_text(out or RESULTS / _file_name(study), _report(study, minutes, seeds, results))
    print(to_markdown(results))


def _file_name(study: Study) -> str:
    return "ablations.md" if study == "dan" else f"ablations-{study}.md"


def _result(variant: Variant, minutes: float, seed: int, folder: Path) -> dict[str, Any]:
    """The result of a variant and seed from its file beside ``folder``; if there is none, the variant is trained."""
    file = folder.with_suffix(".json")
    if not file.exists():
        print(f"{variant.name}, seed {seed}: {minutes:g} minutes", flush=True)
        spawn = multiprocessing.get_context("spawn")  # a process for each: memory left by one slows no other
        with ProcessPoolExecutor(1, spawn, end_with_parent) as pool:
            result = pool.submit(train_and_evaluate, variant, 60 * minutes, seed, folder).result()
        write_text(file, json.dumps({"minutes": minutes, "seed": seed} | asdict(variant) | result))
    result = read_json(file, keys=("minutes", "seed", "name"))
    if (result["minutes"], result["seed"], result["name"]) != (minutes, seed, variant.name):
        raise ValueError(f"{file} belongs to another run: {result['name']!r}, {result['minutes']:g} minutes")
    return result


def train_and_evaluate(variant: Variant, seconds: float, seed: int, folder: Path) -> dict[str, Any]:
    """Train a variant; returns its steps, seconds and number of weights, and its gaps on each cell.

    A checkpoint in ``folder`` is continued.
    """
    torch.set_num_threads(1)
    options: dict[str, Any] = {"policy": variant.policy}
    if variant.policy == "joint":
        options["joint"] = JointConfig(**variant.network)
    else:
        options["network"] = DANConfig(**{"prune_visited": True} | variant.network)
    common: dict[str, Any] = {
        "seed": seed,
        "steps": 10**9,  # the time decides
        "threads": 1,
        "validation_instances": 2,  # the instances of the table are what counts
        "validate_every": 10**9,
        "checkpoint_every": 50,
        "tensorboard": False,
    }
    common |= options | SIZES
    imitation_steps, reinforce_steps, spent, init = 0, 0, 0.0, None
    if variant.imitation > 0:
        time = variant.imitation * seconds
        config = ImitateConfig(
            out=folder / "imitation",
            workers=0,
            anneal_seconds=time,
            next_weight=variant.next_weight,
            assignment_weight=variant.assignment_weight,
            optimiser=variant.optimiser,
            **common,
        )
        run = imitate(continued(config, time))
        imitation_steps, spent, init = run.step, run.seconds, str(config.out / "last.safetensors")
    if variant.imitation < 1:
        config = replace(REFINE, out=folder / "reinforce", init=init, **common)
        run = reinforce(continued(config, (1 - variant.imitation) * seconds))
        reinforce_steps, spent = run.step, spent + run.seconds
    network = run.averaged_network.eval()
    return {
        "imitation_steps": imitation_steps,
        "reinforce_steps": reinforce_steps,
        "seconds": spent,
        "weights": sum(p.numel() for p in network.parameters()),
        "gaps": {cell.label: {d: gaps(network, cell, d) for d in ("greedy", "sample")} for cell in CELLS},
    }


Config = TypeVar("Config", bound=RunConfig)


def continued(config: Config, seconds: float) -> Config:
    """The options of a run that trains for ``seconds`` in total, from its folder's checkpoint if there is one."""
    file = checkpoint_path(config)
    if not file.exists():
        return replace(config, seconds=seconds, resume=False)
    spent = checkpoint.read(file)["progress"]["seconds"]
    return replace(config, seconds=max(seconds - spent, 1e-9), resume=True)  # at least one more step


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


def to_markdown(results: Sequence[dict[str, Any]]) -> str:
    """A table with a line for each variant: the mean over its seeds, ± the standard error over the instances.

    With several seeds, a column shows how much a seed matters: the greedy gap over all cells, seed by seed.
    """
    decodes = {"greedy": "g.", "sample": f"s.{SAMPLES}"}
    heads = [f"{cell.heading}, {short}" for cell in CELLS for short in decodes.values()]
    by_name: dict[str, list[dict[str, Any]]] = {}
    for result in results:
        by_name.setdefault(result["name"], []).append(result)
    several = any(len(group) > 1 for group in by_name.values())
    lines = []
    for name, group in by_name.items():
        columns = [
            100 * np.mean([result["gaps"][cell.label][d] for result in group], axis=0)
            for cell in CELLS
            for d in decodes
        ]
        by_seed = [100 * np.mean([result["gaps"][cell.label]["greedy"] for cell in CELLS]) for result in group]
        lines.append(
            [
                name,
                *(f"{gap.mean():.1f} ± {sem(gap):.1f}" for gap in columns),
                *([", ".join(f"{gap:.1f}" for gap in by_seed)] if several else []),
                f"{np.mean([result['seconds'] for result in group]) / 60:.1f}",
                f"{np.mean([result['imitation_steps'] for result in group]):,.0f}",
                f"{np.mean([result['reinforce_steps'] for result in group]):,.0f}",
                f"{group[0]['weights']:,}",
            ]
        )
    seeds = ["greedy, seed by seed"] if several else []
    return markdown_table(
        ["gap to best known, %", *heads, *seeds, "minutes", "steps of imitation", "of REINFORCE", "weights"], lines
    )


def _report(study: Study, minutes: float, seeds: Sequence[int], results: Sequence[dict[str, Any]]) -> str:
    machine, done = describe_machine(), sorted({result["seed"] for result in results})
    command = (
        f"python -m benchmarks ablations --study {study} --minutes {minutes:g} --seeds {' '.join(map(str, seeds))}"
    )
    return (
        f"# Ablations\n\nEach variant was trained for {minutes:g} minutes on one thread ({machine['processor']}), "
        f"labelling included, on n in {list(SIZES['n_nodes'])} and m in {list(SIZES['n_agents'])}, with seed "
        f"{' and '.join(map(str, done))}: {NOTES[study]}. Mean gap to the best known tours of Table 1's "
        f"{CELLS[0].count} instances in each column (n, m), ± standard error over the instances. A few trainings say "
        f"little about small differences. Made by `{command}`.\n\n{to_markdown(results)}\n"
    )
