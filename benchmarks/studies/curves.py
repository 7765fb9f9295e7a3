"""Learning curves at n = 20, m = 3: REINFORCE from scratch and imitation over the same wall-clock time."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.files import write_text
from benchmarks.harness.machine import describe_machine
from benchmarks.reports.plots import save
from mtsp_env.checks import check_seconds
from mtsp_env.instance import Instance
from mtsp_env.reference import improve_batch
from mtsp_env.tours import makespan
from train import checkpoint
from train.collect import draw_set
from train.config import RunConfig
from train.imitate import imitate
from train.learner import VALIDATION_SEED, checkpoint_path
from train.presets import QUICK
from train.reinforce import reinforce
from train.supervised_config import ImitateConfig

RESULTS = Path(__file__).parents[1] / "results"
SETTING = {"n_nodes": (20, 20), "n_agents": (3, 3), "nodes_per_agent": 2, "speed": 0.01, "validation_instances": 512}

Curve = list[tuple[int, float, float]]
"""Points of a learning curve: step, seconds of training, mean validation cost."""


def main(minutes: float = 30.0, folder: Path = Path("runs/curves"), out: Path = RESULTS) -> None:
    """Train with REINFORCE from scratch and by imitation, for the same time on one thread; write data and a plot.

    Args:
        minutes: training time of each.
        folder: folder of the runs; existing runs are resumed, and only the time that is left is trained.
        out: folder for curves.csv and curves.png.

    Raises:
        ValueError: ``minutes`` is not a finite number above 0, or a run in ``folder`` is damaged.
    """
    check_seconds("minutes", minutes, unit="minutes")
    common = SETTING | {"threads": 1, "tensorboard": False, "network": QUICK.network, "steps": 10**9}
    runs = {
        "REINFORCE from scratch": (reinforce, replace(QUICK, out=folder / "reinforce", validate_every=10, **common)),
        "imitation": (imitate, ImitateConfig(out=folder / "imitate", workers=0, validate_every=50, **common)),
    }
    curves = {}
    for name, (train, config) in runs.items():
        exists = checkpoint_path(config).exists()
        left = 60 * minutes - (checkpoint.seconds(checkpoint_path(config)) if exists else 0.0)
        if left > 0:
            train(replace(config, seconds=left, resume=exists))
        curves[name] = read(config.out)
    reference = reference_cost(next(iter(runs.values()))[1])
    lines = ["method,step,seconds,validation_cost"]
    lines += [
        f"{name},{step},{second:.1f},{cost:.5f}" for name, curve in curves.items() for step, second, cost in curve
    ]
    lines.append(f"reference solver,,,{reference:.5f}")
    write_text(out / "curves.csv", "\n".join(lines) + "\n")
    draw(curves, reference, out / "curves.png")
    for name, curve in curves.items():
        print(f"{name}: {curve[0][2]:.3f} -> {curve[-1][2]:.3f} after {curve[-1][1] / 60:.1f} minutes")
    print(f"reference solver: {reference:.3f}\n{out / 'curves.png'}")


def read(folder: Path) -> Curve:
    """Read the learning curve of a run from its logs."""

    def scalars(name: str) -> dict[int, float]:
        (file,) = folder.glob(f"logs/**/{name}.csv")
        with file.open(encoding="utf-8", newline="") as lines:
            return {int(step): float(value) for step, value in csv.reader(lines)}

    seconds = scalars("seconds")
    return [(step, seconds[step], cost) for step, cost in scalars("validation_cost").items()]


def reference_cost(config: RunConfig) -> float:
    """Mean makespan of the reference solver on the instances that runs are validated on."""
    costs = []
    for part in draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances):
        nodes = part.nodes.numpy()
        tours = improve_batch(nodes, part.n_agents, iterations=500 * nodes.shape[1], seed=0)
        instances = [Instance(one, part.n_agents) for one in nodes]
        costs += [makespan(instance, one) for instance, one in zip(instances, tours, strict=True)]
    return float(np.mean(costs))


def draw(curves: dict[str, Curve], reference: float, path: Path) -> None:
    """Plot the mean greedy cost on the validation set against minutes."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.subplots()
    for (name, curve), colour in zip(curves.items(), ("#d73027", "#4575b4"), strict=True):
        ax.plot([second / 60 for _, second, _ in curve], [cost for *_, cost in curve], color=colour, label=name)
    ax.axhline(reference, color="black", lw=1, ls="--", label="reference solver")
    machine = describe_machine()["processor"]
    ax.set(xlabel=f"minutes on one thread ({machine})", ylabel="mean makespan, greedy, 512 instances")
    ax.set_title("n = 20, m = 3", fontsize=10)
    ax.grid(True, color="0.92", lw=0.8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False)
    save(figure, path)
