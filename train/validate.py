"""The measure by which to choose among weights: the mean greedy cost on held-out instances."""

from __future__ import annotations

import numpy as np
import tyro

from dan_policy.registry import load
from train.collect import costs, draw_set
from train.config import RunConfig
from train.learner import VALIDATION_SEED
from train.presets import REFINE


def validate(
    files: tyro.conf.Positional[tuple[str, ...]],
    network: str | None = None,
    n_nodes: tuple[int, int] = REFINE.n_nodes,
    n_agents: tuple[int, int] = REFINE.n_agents,
    nodes_per_agent: int = REFINE.nodes_per_agent,
    instances: int = 256,
    device: str = "cpu",
) -> list[float]:
    """Print the mean greedy cost of weights on the held-out instances that runs are validated on.

    A run with the same ranges prints the same number as its validation cost if its speed is 0.01 and its depot rule
    "final".

    Args:
        files: weights, or names of shipped models, at least 1.
        network: package.module:factory, for weights of a network of your own.
        n_nodes: range of n, as in the run.
        n_agents: range of m, as in the run.
        nodes_per_agent: least number of nodes per agent, as in the run.
        instances: number of instances.
        device: cpu, cuda, ...

    Returns:
        The mean cost of each file.

    Raises:
        OSError: no such weights.
        ValueError: no files, weights that do not fit, or a value outside its range.
    """
    if not files:
        raise ValueError("name at least 1 file to validate")
    config = RunConfig(
        n_nodes=n_nodes,
        n_agents=n_agents,
        nodes_per_agent=nodes_per_agent,
        validation_instances=instances,
        speed=REFINE.speed,
        depot="final",
        device=device,
    )
    held_out = draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances)
    means = []
    for file in files:
        means.append(float(costs(load(file, device, network), held_out, config).mean()))
        print(f"{means[-1]:.4f}  {file}", flush=True)
    return means
