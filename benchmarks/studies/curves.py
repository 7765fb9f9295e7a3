"""Learning curves on one small size: REINFORCE from scratch beside imitation, over the same wall-clock time."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.files import replace_text
from benchmarks.plots import save
from benchmarks.run import describe_machine
from mtsp_env.reference import improve_batch
from mtsp_env.tours import makespan
from train import checkpoint
from train.collect import draw_set
from train.config import ImitateConfig, RunConfig
from train.imitate import imitate
from train.learner import VALIDATION_SEED, checkpoint_path
from train.presets import QUICK
from train.reinforce import reinforce

RESULTS = Path(__file__).parent / "results"
SIZE = {"n_nodes": (20, 20), "n_agents": (3, 3), "nodes_per_agent": 2, "speed": 0.01, "validation_instances": 512}


def main(minutes: float = 30.0, folder: Path = Path("runs/curves"), out: Path = RESULTS) -> None:
    """Train both that have not been trained for so long yet, one after the other on one thread; write data and picture.

    Args:
        minutes: of each.
        folder: of the runs; broken-off ones are resumed.
        out: folder for curves.csv and curves.png.

    Raises:
        ValueError: ``minutes`` not above 0.
    """
    if not minutes > 0:
        raise ValueError(f"minutes must be above 0, got {minutes!r}")
    common = SIZE | {"threads": 1, "tensorboard": False, "network": QUICK.network, "steps": 10**9}
    runs = {
        "REINFORCE from scratch": (reinforce, replace(QUICK, out=folder / "reinforce", validate_every=10, **common)),
        "imitation": (imitate, ImitateConfig(out=folder / "imitate", workers=0, validate_every=50, **common)),
    }
    curves = {}
    for name, (train, config) in runs.items():
        begun = config.out.exists()
        left = 60 * minutes - (checkpoint.read(checkpoint_path(config))["progress"]["seconds"] if begun else 0.0)
        if left > 0:
            train(replace(config, seconds=left, resume=begun))
        curves[name] = read(config.out)
    teacher = best_cost(next(iter(runs.values()))[1])
    lines = ["method,step,seconds,validation_cost"]
    lines += [f"{name},{step},{second:.1f},{cost:.5f}" for name, rows in curves.items() for step, second, cost in rows]
    lines.append(f"reference solver,,,{teacher:.5f}")
    replace_text(out / "curves.csv", "\n".join(lines) + "\n")
    draw(curves, teacher, out / "curves.png")
    for name, rows in curves.items():
        print(f"{name}: {rows[0][2]:.3f} -> {rows[-1][2]:.3f} after {rows[-1][1] / 60:.1f} minutes")
    print(f"reference solver: {teacher:.3f}\n{out / 'curves.png'}")


def read(folder: Path) -> list[tuple[int, float, float]]:
    """Step, seconds of training and validation cost, from a run's logs."""

    def scalars(name: str) -> dict[int, float]:
        (file,) = folder.glob(f"logs/**/{name}.csv")
        with file.open(encoding="utf-8", newline="") as lines:
            return {int(step): float(value) for step, value in csv.reader(lines)}

    seconds = scalars("seconds")
    return [(step, seconds[step], cost) for step, cost in scalars("validation_cost").items()]


def best_cost(config: RunConfig) -> float:
    """Mean makespan of the reference solver's tours on the instances that runs are validated on."""
    found = []
    for part in draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances):
        nodes = part.nodes.numpy()
        tours = improve_batch(nodes, part.n_agents, iterations=500 * nodes.shape[1], seed=0)
        found += [makespan(*one) for one in zip(nodes, tours, strict=True)]
    return float(np.mean(found))


def draw(curves: dict[str, list[tuple[int, float, float]]], teacher: float, path: Path) -> None:
    """Mean greedy cost on the validation set against minutes."""
    figure = Figure(figsize=(6.4, 4.0), layout="constrained")
    ax = figure.subplots()
    for (name, rows), colour in zip(curves.items(), ("#d73027", "#4575b4"), strict=True):
        ax.plot([second / 60 for _, second, _ in rows], [cost for *_, cost in rows], color=colour, label=name)
    ax.axhline(teacher, color="black", lw=1, ls="--", label="reference solver")
    machine = describe_machine()["processor"]
    ax.set(xlabel=f"minutes on one thread ({machine})", ylabel="mean makespan, greedy, 512 instances")
    ax.set_title("n = 20, m = 3", fontsize=10)
    ax.grid(True, color="0.92", lw=0.8)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False)
    save(figure, path)
