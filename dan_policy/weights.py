"""Networks on disk: safetensors with the configuration as JSON inside its metadata. No pickle, nothing is executed."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from torch import nn

from dan_policy.network import DAN, DANConfig

FORMAT = "dan-policy-1"
SHIPPED = Path(__file__).parent / "weights"


def save(path: str | os.PathLike, network: nn.Module, **extra: object) -> None:
    """Write ``network`` to a ``.safetensors`` file; ``extra`` (JSON values: how it was trained) into its metadata.

    A DAN's file holds its configuration; any other network's holds its weights alone. Written to a temporary name and
    moved, so that a crash leaves an older file whole.
    """
    path = Path(path)
    config = asdict(network.config) if isinstance(network, DAN) else None
    metadata = {"format": FORMAT, "config": json.dumps(config), "extra": json.dumps(extra)}
    tensors = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(serialise(tensors, metadata))  # save_file's files are for their owner's eyes alone
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load(
    path: str | os.PathLike, device: torch.device | str = "cpu", network: nn.Module | None = None
) -> DAN | nn.Module:
    """The network that ``save`` wrote to ``path``, or a shipped one by its name ("default"), in evaluation mode.

    Args:
        network: gets the weights, where they are not those of a DAN (which a file describes by itself).

    Raises:
        OSError: no such file.
        ValueError: not such a file, a damaged one, or weights that do not fit their configuration or ``network``.
    """
    return _read(path, device, network)


def load_extra(path: str | os.PathLike) -> dict:
    """What was given to ``save`` beside the network. Raises as ``load``."""
    return json.loads(_open(find(path), "cpu")[0]["extra"])


def shipped() -> list[str]:
    """Names of the models that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def find(path: str | os.PathLike) -> Path:
    """The file behind a path or the name of a shipped model."""
    if str(path) in shipped():
        return SHIPPED / f"{path}.safetensors"
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no weights at {path}; shipped are {shipped()}")
    return path


def _read(path: str | os.PathLike, device: torch.device | str, network: nn.Module | None) -> nn.Module:
    path = find(path)
    metadata, tensors = _open(path, device)
    try:
        config = json.loads(metadata["config"])
        if network is None:
            if config is None:
                raise ValueError("it holds no DAN: give the network that the weights are for")
            network = DAN(DANConfig(**config))
        network.load_state_dict(tensors)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: weights and configuration do not fit ({error})") from error
    return network.to(device).eval()


def _open(path: Path, device: torch.device | str) -> tuple[dict[str, str], dict[str, torch.Tensor]]:
    """Metadata and tensors of a file that ``save`` wrote."""
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    except SafetensorError as error:
        raise ValueError(f"{path}: not a safetensors file, or a damaged one ({error})") from error
    if metadata.get("format") != FORMAT:
        raise ValueError(f"{path}: expected format {FORMAT!r} in its metadata, got {metadata.get('format')!r}")
    return metadata, tensors
