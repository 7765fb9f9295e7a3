"""The whole state of a training run in one file, replaced atomically, and the check that a run may continue from it.

A file is ``MAGIC``, the SHA-256 of the rest, and what ``torch.save`` writes. Any change of any bit is noticed.
"""

from __future__ import annotations

import hashlib
import io
import shutil
import zipfile
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mtsp_env.writing import atomic_write
from train.config import RunConfig

MAGIC = b"mtsp checkpoint\n"
DIGEST_SIZE = hashlib.sha256().digest_size

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
    """Write tensors, numbers, strings, lists and dicts; the file that was there is kept as ``previous(path)``.

    If writing fails, the old file stays as it was.
    """
    content = io.BytesIO()
    torch.save(state, content)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.exists():
        with atomic_write(previous(path)) as temporary:
            shutil.copyfile(path, temporary)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        file.write(MAGIC + hashlib.sha256(content.getbuffer()).digest())
        file.write(content.getbuffer())


def previous(path: Path) -> Path:
    """Where ``write`` keeps the checkpoint before the one at ``path``."""
    return path.with_name(f"{path.stem}.previous{path.suffix}")


def go_back(path: Path) -> None:
    """Let the checkpoint before the one at ``path`` take its place, and keep it as ``previous(path)`` as well."""
    with atomic_write(path) as temporary:
        shutil.copyfile(previous(path), temporary)


def read(path: Path) -> dict[str, Any]:
    """Read what ``write`` wrote. No code in the file is executed.

    Files without ``MAGIC``, which older versions wrote, are read if the checksums inside their ZIP archive fit. Those
    cover the tensors, but not every byte of the file.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is not a checkpoint, or it is damaged; the message says how to go on.
    """
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint at {path}")
    try:
        state = torch.load(io.BytesIO(_verified(path.read_bytes())), weights_only=True, map_location="cpu")
    except OSError:
        raise
    except Exception as error:  # whatever an unpickler meets in damaged bytes
        reason = (str(error).splitlines() or [""])[0] or type(error).__name__
        raise ValueError(f"{path}: not a checkpoint, or a damaged one ({reason}){_way_out(path)}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{path}: not a checkpoint: it holds a {type(state).__name__}{_way_out(path)}")
    return state


def seconds(path: Path) -> float:
    """The seconds of training and validation behind the checkpoint at ``path``. Raises as ``read``."""
    state = read(path)
    try:
        return float(state["progress"]["seconds"])
    except (LookupError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: it does not say how long its run took ({type(error).__name__}: {error})") from error


def _verified(data: bytes) -> memoryview:
    """The part of a file's content that ``torch.save`` wrote. Raises ValueError if a checksum does not fit."""
    if data.startswith(MAGIC):
        begin = len(MAGIC) + DIGEST_SIZE
        content = memoryview(data)[begin:]
        if hashlib.sha256(content).digest() != data[len(MAGIC) : begin]:
            raise ValueError("its checksum does not fit")
        return content
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if (name := archive.testzip()) is not None:
            raise ValueError(f"the checksum of its part {name!r} does not fit")
    return memoryview(data)


def _way_out(path: Path) -> str:
    """What to do about a damaged checkpoint."""
    if previous(path).is_file():
        return f"; to continue from the checkpoint before it: mv {previous(path)} {path}"
    return f"; start another run, from this one's weights if it has any: --init {path.with_name('last.safetensors')}"


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
