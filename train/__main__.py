"""``python -m train imitate [options]``, ``reinforce {paper,refine,quick} [options]``, ``average``, ``validate``."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

# Kernels that oneDNN keeps, read when torch is loaded: sizes change all the time, and building one takes milliseconds
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "8192")

import tyro

from train.average import average, validate
from train.config import ImitateConfig, RunConfig
from train.imitate import imitate
from train.presets import PRESETS, REFINE
from train.reinforce import reinforce

Preset = tyro.extras.subcommand_type_from_defaults(
    {name: preset for name, (_, preset) in PRESETS.items()},
    {name: description for name, (description, _) in PRESETS.items()},
)
app = tyro.extras.SubcommandApp()


@app.command(name="reinforce")
def reinforce_command(config: Annotated[Preset, tyro.conf.arg(name="")]) -> None:
    """Train a DAN by REINFORCE with a greedy rollout baseline, from a preset with any option changed."""
    reinforce(config)


@app.command(name="imitate")
def imitate_command(config: Annotated[ImitateConfig, tyro.conf.arg(name="")]) -> None:
    """Train a DAN to choose as the reference solver does: a warm start for `reinforce`."""
    imitate(config)


@app.command(name="average")
def average_command(files: tyro.conf.Positional[tuple[str, ...]], out: Path) -> None:
    """Average the weights of runs that began with the same ones.

    Args:
        files: weights, or names of shipped models, at least 2.
        out: file to write.
    """
    average(files, out)


@app.command(name="validate")
def validate_command(
    files: tyro.conf.Positional[tuple[str, ...]],
    n_nodes: tuple[int, int] = REFINE.n_nodes,
    n_agents: tuple[int, int] = REFINE.n_agents,
    instances: int = 256,
    device: str = "cpu",
) -> None:
    """Print the mean greedy cost of weights on the held-out instances that runs are validated on.

    Args:
        files: weights, or names of shipped models.
        n_nodes: range of n, as of the run.
        n_agents: range of m, as of the run.
        instances: how many.
        device: cpu, cuda, ...
    """
    if not files:
        raise ValueError("name at least 1 file to validate")
    same = {"nodes_per_agent": REFINE.nodes_per_agent, "speed": REFINE.speed, "depot": REFINE.depot, "device": device}
    config = RunConfig(n_nodes=n_nodes, n_agents=n_agents, validation_instances=instances, **same)
    for file in files:
        print(f"{validate(file, config):.4f}  {file}", flush=True)


def main(argv: list[str] | None = None) -> int:
    """Parse the command line and train. Exit code 2 and one line on bad input."""
    try:
        app.cli(prog="python -m train", args=argv)
    except (ValueError, OSError, ImportError) as error:
        print(f"train: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
