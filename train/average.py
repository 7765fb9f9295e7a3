"""Weighted means of several networks' weights."""

from __future__ import annotations

import math
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from dan_policy.registry import load, load_config, load_extra, save
from train.config import OVERRIDES


def average(
    files: tyro.conf.Positional[tuple[str, ...]],
    out: Path,
    shares: tuple[float, ...] | None = None,
    network: str | None = None,
) -> None:
    """Write the mean of the weights of runs that started from the same ones ("model soup", Wortsman et al. 2022).

    Runs with a common ancestor learn similar weights, and their noise cancels. Without one, the mean may be worse than
    each of them: compare them with `validate`. A negative share carries over what one run has learnt to the weights of
    another ("task arithmetic", Ilharco et al. 2023): with `--shares 1 0.4 -0.4`, files A, B and C give A and 0.4 times
    what B has learnt since C. Networks may differ in what a run with `init` can override, such as `distances`: the mean
    is the network of the first file that has every weight, and weights that another one lacks count as zero.

    Args:
        files: weights, or names of shipped models, at least 2; one that is named twice counts twice.
        out: file to write.
        shares: the share of each file; they add up to 1, and may be negative. By default all are equal.
        network: package.module:factory, for weights of a network of your own.

    Raises:
        OSError: no such weights, or ``out`` cannot be written.
        ValueError: fewer than 2 files, shares that are not one finite number for each file or do not add up to 1, or
            networks of different kinds or shapes.
    """
    if len(files) < 2:
        raise ValueError(f"name at least 2 files to average, got {len(files)}")
    if shares is None:
        shares = (1 / len(files),) * len(files)
    if len(shares) != len(files) or not math.isclose(sum(shares), 1.0, abs_tol=1e-6):  # NaN and inf are not close to 1
        raise ValueError(f"shares must be {len(files)} numbers, one for each file, that add up to 1, got {shares}")
    networks = [load(file, network=network) for file in files]
    states = [one.state_dict() for one in networks]
    largest = max(range(len(files)), key=lambda k: len(states[k]))  # the first of those
    configs = [getattr(one, "config", load_config(file)) for one, file in zip(networks, files, strict=True)]
    for file, config, state in zip(files, configs, states, strict=True):
        if _fixed(config) != _fixed(configs[largest]) or not state.keys() <= states[largest].keys():
            raise ValueError(f"{file} has another configuration than {files[largest]}: {config}, {configs[largest]}")
    mean = load(files[largest], network=network)
    mean.load_state_dict(
        {
            name: sum(
                share * state.get(name, torch.zeros_like(weight)) for share, state in zip(shares, states, strict=True)
            )
            for name, weight in states[largest].items()
        }
    )
    out.parent.mkdir(parents=True, exist_ok=True)
    sources = [load_extra(file) for file in files]
    save(out, mean, network, load_config(files[largest]), averaged=sources, shares=list(shares))


def _fixed(config: Any) -> Any:
    """The configuration of a network without what a run can override."""
    if not is_dataclass(config) or isinstance(config, type):
        return config
    return {name: value for name, value in asdict(config).items() if name not in OVERRIDES}
