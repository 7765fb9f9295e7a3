"""Ablations: networks and ways of training them, trained equally long and compared on one set of instances.

Variants that begin with the same stages share these stages' runs, also across studies: each stage has its folder in
that of the stage before it.
"""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
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
from benchmarks.studies.variants import NOTES, STUDIES, Budget, Stage, Study, Variant
from benchmarks.suite import SEED, Cell
from dan_policy import DANConfig
from dan_policy.episode import rollout
from dan_policy.joint import JointConfig
from dan_policy.network import Decode
from dan_policy.planning import SPEED
from dan_policy.registry import load
from mtsp_env.batched import BatchedMTSP
from mtsp_env.checks import check_count, check_seconds
from mtsp_env.files import read_json
from mtsp_env.processes import end_with_parent
from mtsp_env.tours import makespan
from train import checkpoint
from train.config import RunConfig
from train.imitate import imitate
from train.improve import improve
from train.learner import checkpoint_path
from train.presets import REFINE
from train.reinforce import reinforce
from train.supervised_config import ImitateConfig, ImproveConfig

RESULTS = Path(__file__).parents[1] / "results"
CELLS = (Cell(50, 5, 20), Cell(50, 10, 20), Cell(100, 10, 20))  # of Table 1
SAMPLES = 64
SIZES = {"n_nodes": (20, 50), "n_agents": (2, 10), "nodes_per_agent": 5}  # of the training instances

IMITATE: dict[str, Any] = {"workers": 0}
REGRETS = IMITATE | {
    "labels": "regrets",
    "regret_temperature": 0.004,
    "teacher_iterations": 300,
    "learning_rate": 5e-4,
    "warmup": 20,
    "average": 0.99,
    "passes": 4.0,
    "set_tokens": 512,  # small sets and few of them: the first ones are ready after a minute
    "buffer": 8,
}
ROLLOUT: dict[str, Any] = {  # as many episodes in a step as with the shared baseline
    "baseline": "rollout",
    "samples": 1,
    "batch_size": 256,
    "batch_tokens": REFINE.batch_tokens * REFINE.samples,
    "challenge_every": 20,
    "challenge_instances": 256,
}
TRAIN: dict[Stage, Callable[[Any], Any]] = {
    "imitate": imitate,
    "regrets": imitate,
    "improve": improve,
    "reinforce": reinforce,
    "rollout": reinforce,
}


def main(
    study: Study = "dan",
    minutes: float = 15.0,
    steps: int | None = None,
    seeds: tuple[int, ...] = (0,),
    folder: Path = Path("runs/ablations"),
    results: Path = RESULTS / "ablations",
    out: Path | None = None,
) -> None:
    """Train variants of a network and of its training equally long on one thread, and compare them in a table.

    The same command continues an interrupted study, also within a variant.

    Args:
        study: "dan" for parts of DAN and of its training, "dense-labels" for networks and what they are taught: the
            next node of the deciding agent alone, that of every agent, the agent of every city, or both; "joint" for
            distances and polar coordinates in the joint network, and its optimiser; "refinement" for what may follow
            its imitation.
        minutes: training time of each variant and seed on one thread, the labelling of its instances included.
        steps: optimiser steps of each variant and seed, instead of the time: all of them then learn from the same
            labelled instances, and results of different machines can be compared. Not for variants with several stages.
        seeds: seeds of the training; every variant is trained once with each. The instances that variants are compared
            on are never trained on.
        folder: folder of the runs; stages that are finished there are not trained again.
        results: folder of the results; a variant that has one there is not trained again. Give another folder to
            measure anew.
        out: file for the table in Markdown; by default the study's file in benchmarks/results.

    Raises:
        ValueError: ``minutes`` is not a finite number above 0, ``steps`` is below 1 or given for variants with several
            stages, there are no seeds, or a file in one of the folders is damaged.
    """
    check_seconds("minutes", minutes, unit="minutes")
    if steps is not None:
        check_count("steps", steps, minimum=1)
        if any(len(variant.stages) > 1 for variant in STUDIES[study]):
            raise ValueError(f"steps must be None for the study {study!r}, whose variants have stages, got {steps}")
    budget = Budget(minutes) if steps is None else Budget(steps, "steps")
    if not seeds:
        raise ValueError("name at least one seed")
    measured = []
    for seed in seeds:  # a whole table for each seed, should the time end early
        for variant in STUDIES[study]:
            file = result_file(variant, budget, seed, results)
            measured.append({"seed": seed, "name": variant.name} | _result(variant, budget, seed, folder, file))
            write_text(out or RESULTS / _file_name(study), _report(study, budget, seeds, measured))
    print(to_markdown(measured))


def _file_name(study: Study) -> str:
    return "ablations.md" if study == "dan" else f"ablations-{study}.md"


def stage_folders(variant: Variant, budget: Budget, seed: int, folder: Path) -> list[Path]:
    """The folder of each stage's run. Those of the first stages are the same for variants that begin alike."""
    folders = [folder / variant.learner / f"seed-{seed}"]
    for stage, share in variant.stages:
        folders.append(folders[-1] / f"{stage}-{budget.part(share)}")
    return folders[1:]


def result_file(variant: Variant, budget: Budget, seed: int, results: Path) -> Path:
    """The file with the result of a variant and seed."""
    stages = [f"{stage}-{budget.part(share)}" for stage, share in variant.stages]
    return results / f"{'_'.join([variant.learner, *stages])}_seed-{seed}.json"


def _result(variant: Variant, budget: Budget, seed: int, folder: Path, file: Path) -> dict[str, Any]:
    """What ``train_and_evaluate`` returns for a variant and seed, and where; from ``file`` if it exists."""
    if not file.exists():
        print(f"{variant.name}, seed {seed}: {budget}", flush=True)
        spawn = multiprocessing.get_context("spawn")  # a process for each: memory left by one slows no other
        with ProcessPoolExecutor(1, spawn, end_with_parent) as pool:
            result = pool.submit(train_and_evaluate, variant, budget, seed, folder).result()
        write_text(file, json.dumps(result | {"processor": describe_machine()["processor"]}))
    return read_json(file, keys=("steps", "seconds", "weights", "gaps", "processor"))


def train_and_evaluate(variant: Variant, budget: Budget, seed: int, folder: Path) -> dict[str, Any]:
    """Train a variant; returns the steps of its stages, its seconds and number of weights, and its gaps on each cell.

    Stages that are finished in ``folder`` are not trained again, and one that was interrupted is continued.
    """
    torch.set_num_threads(1)
    steps, seconds, init = {}, 0.0, None
    for (stage, share), out in zip(variant.stages, stage_folders(variant, budget, seed, folder), strict=True):
        finished = out / "finished.json"
        if not finished.exists():
            part = budget.part(share)
            run = TRAIN[stage](continued(stage_config(stage, variant, part, seed, out, init), part))
            write_text(finished, json.dumps({"steps": run.step, "seconds": run.seconds}))
        done = read_json(finished, keys=("steps", "seconds"))
        steps[stage], seconds, init = done["steps"], seconds + done["seconds"], str(out / "last.safetensors")
    network = load(init, network=variant.policy if ":" in variant.policy else None)
    return {
        "steps": steps,
        "seconds": seconds,
        "weights": sum(p.numel() for p in network.parameters()),
        "gaps": {cell.label: {d: gaps(network, cell, d) for d in ("greedy", "sample")} for cell in CELLS},
    }


def stage_config(stage: Stage, variant: Variant, budget: Budget, seed: int, out: Path, init: str | None) -> RunConfig:
    """The options of a stage's run, from the weights ``init`` of the stage before it."""
    options: dict[str, Any] = {
        "out": out,
        "init": init,
        "policy": variant.policy,
        "seed": seed,
        "steps": int(budget.amount) if budget.unit == "steps" else 10**9,  # 10^9: the time decides
        "threads": 1,
        "validation_instances": 2,  # the instances of the table are what counts
        "validate_every": 10**9,
        "checkpoint_every": 50,
        "tensorboard": False,
    }
    options |= SIZES
    if variant.policy == "joint":
        options["joint"] = JointConfig(**variant.network)
    else:
        options["network"] = DANConfig(**{"prune_visited": True} | variant.network)
    if stage in ("reinforce", "rollout"):
        return replace(REFINE, **options | (ROLLOUT if stage == "rollout" else {}))
    options |= {
        "anneal_seconds": 60 * budget.amount if budget.unit == "minutes" else None,
        "next_weight": variant.next_weight,
        "assignment_weight": variant.assignment_weight,
        "optimiser": variant.optimiser,
    }
    if stage == "improve":
        return ImproveConfig(**options)
    return ImitateConfig(**options | (IMITATE if stage == "imitate" else REGRETS | {"roll_in": init}))


def continued(config: RunConfig, budget: Budget) -> RunConfig:
    """The options of a run that trains for ``budget`` in total, from its folder's checkpoint if there is one."""
    file = checkpoint_path(config)
    resume = file.exists()
    if budget.unit == "steps":
        return replace(config, resume=resume)
    spent = checkpoint.read(file)["progress"]["seconds"] if resume else 0.0
    return replace(config, seconds=max(60 * budget.amount - spent, 1e-9), resume=resume)  # at least one more step


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
                ", ".join(
                    f"{stage} {np.mean([result['steps'][stage] for result in group]):,.0f}"
                    for stage in group[0]["steps"]
                ),
                f"{group[0]['weights']:,}",
            ]
        )
    seeds = ["greedy, seed by seed"] if several else []
    return markdown_table(["gap to best known, %", *heads, *seeds, "minutes", "steps", "weights"], lines)


def _report(study: Study, budget: Budget, seeds: Sequence[int], results: Sequence[dict[str, Any]]) -> str:
    processors = " and ".join(sorted({result["processor"] for result in results}))
    done = sorted({result["seed"] for result in results})
    labelling = ", labelling included," if budget.unit == "minutes" else ""
    options = f"--study {study} --{budget.unit} {budget.number} --seeds {' '.join(map(str, seeds))}"
    return (
        f"# Ablations\n\nEach variant was trained for {budget.number} {budget.unit} on one thread ({processors})"
        f"{labelling} on n in {list(SIZES['n_nodes'])} and m in {list(SIZES['n_agents'])}, with seed "
        f"{' and '.join(map(str, done))}: {NOTES[study]}. Mean gap to the best known tours of Table 1's "
        f"{CELLS[0].count} instances in each column (n, m), ± standard error over the instances. A few trainings say "
        f"little about small differences. Made by `python -m benchmarks ablations {options}`.\n\n"
        f"{to_markdown(results)}\n"
    )
