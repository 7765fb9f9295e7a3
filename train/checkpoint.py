"""The whole state of a training run in one file, replaced atomically, and the check that a run may continue from it."""

from __future__ import annotations

import pickle
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mtsp_env.writing import atomic_write
from train.config import RunConfig

# Options that may differ between a run and its continuation; all others are part of what is being trained.
FREE_ON_RESUME = (
    "out",
    "resume",
    "steps",
    "seconds",
    "threads",
    "tensorboard",
    "checkpoint_every",
    "device",
    "workers",
    "anneal_seconds",
)


def write(path: Path, state: dict[str, Any]) -> None:
    """Write tensors, numbers, strings, lists and dicts. If writing fails, the old file stays as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary:
        torch.save(state, temporary)


def read(path: Path) -> dict[str, Any]:
    """Read what ``write`` wrote. No code in the file is executed.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is not a checkpoint, or it is damaged.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}")
    try:
        return torch.load(path, weights_only=True, map_location="cpu")
    except (pickle.UnpicklingError, RuntimeError, EOFError, KeyError, ValueError) as error:
        raise ValueError(f"{path}: not a checkpoint, or a damaged one ({error})") from error


def random_state(rng: np.random.Generator) -> dict[str, Any]:
    """The state of every generator that a run draws from: ``rng`` and torch's."""
    cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return {"numpy": rng.bit_generator.state, "torch": torch.get_rng_state(), "cuda": cuda}


def set_random_state(rng: np.random.Generator, state: dict[str, Any]) -> None:
    """Set every generator to a state that ``random_state`` returned."""
    rng.bit_generator.state = state["numpy"]
    torch.set_rng_state(state["torch"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])


def check_same_run(old: dict[str, Any], config: RunConfig) -> None:
    """Raise ValueError if ``config`` would change what the run with the options ``old`` (JSON values) was training.

    An option that is younger than the checkpoint counts as its default.
    """
    new = config.to_dict()
    unknown = sorted(old.keys() - new.keys())
    if unknown:
        raise ValueError(f"the checkpoint is of another version: it has the unknown options {unknown}")
    old = type(config)().to_dict() | old
    for option in fields(config):
        value = getattr(config, option.name)
        if is_dataclass(value):
            options_type: Any = type(value)
            old[option.name] = asdict(options_type()) | old[option.name]
    changed = [name for name in new if name not in FREE_ON_RESUME and old[name] != new[name]]
    if changed:
        differences = ", ".join(f"{name} was {old[name]!r}, is {new[name]!r}" for name in changed)
        raise ValueError(f"a resumed run keeps its configuration: {differences}")
