"""The mean of several networks' weights, and the measure by which to choose among networks."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dan_policy.dan import DAN
from dan_policy.registry import load, load_extra, save
from train.collect import costs, draw_set
from train.config import RunConfig
from train.learner import VALIDATION_SEED


def average(files: Sequence[str | os.PathLike], out: str | os.PathLike) -> None:
    """Write the mean of DANs' weights (Wortsman et al. 2022, "model soups"), and how each was trained.

    Runs that began with the same weights learn alike, and their noise cancels. Where they have no common ancestor, the
    mean may be worse than each of them: ``validate`` tells.

    Args:
        files: weights, or names of shipped models, at least 2; one that is named twice counts twice.
        out: the file to write.

    Raises:
        OSError: no such weights, or ``out`` cannot be written.
        ValueError: fewer than 2, or networks of different shapes.
    """
    if len(files) < 2:
        raise ValueError(f"name at least 2 files to average, got {len(files)}")
    networks = [load(file) for file in files]
    for file, network in zip(files, networks, strict=True):
        if network.config != networks[0].config:
            raise ValueError(f"{file}: another configuration than {files[0]}'s: {network.config}, {networks[0].config}")
    states = [network.state_dict() for network in networks]
    mean = DAN(networks[0].config)
    mean.load_state_dict({name: sum(state[name] for state in states) / len(states) for name in states[0]})
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    save(out, mean, averaged=[load_extra(file) for file in files])


def validate(file: str | os.PathLike, config: RunConfig) -> float:
    """Mean greedy cost on the held-out instances that a run with ``config`` is validated on. Raises as ``load``."""
    held_out = draw_set(np.random.default_rng(VALIDATION_SEED), config, config.validation_instances)
    return float(costs(load(file, config.device), held_out, config).mean())
