"""Networks by name, and on disk: safetensors files whose metadata hold the configuration as JSON.

A checksum in the metadata covers everything; files without one, which older versions wrote, are read as well. Nothing
is unpickled, and a file never decides by itself which code is imported: it may name a factory of the user's own, but
``load`` calls one only if its caller names it.
"""

from __future__ import annotations

import hashlib
import json
import os
import pkgutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as serialise
from torch import Tensor, nn

from dan_policy.dan import DAN, DANConfig
from dan_policy.joint import JointConfig, JointDAN
from dan_policy.network import Network, find_device, network_keys
from mtsp_env.writing import atomic_write

FORMAT = "dan-policy-2"
DAN_ONLY = "dan-policy-1"  # the first format, which knew no other network by name; its files are still read
SHIPPED = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class NetworkType:
    """A network of the registry: ``module(config(**fields))`` builds it, and it keeps its ``config``.

    All its tensors are in its ``state_dict()``: no buffer is registered with ``persistent=False``.
    """

    config: type
    module: type[nn.Module]


NETWORKS: dict[str, NetworkType] = {
    "dan": NetworkType(DANConfig, DAN),
    "joint": NetworkType(JointConfig, JointDAN),
}


class FunctionNetwork(nn.Module):
    """A plain function as a module without parameters, so that it can stand wherever a module is expected."""

    def __init__(self, function: Network):
        super().__init__()
        self.function, self.in_keys = function, network_keys(function)

    def forward(self, *observation: Tensor) -> Tensor:
        return self.function(*observation)


def build(name: str, config: Mapping[str, Any] | None = None) -> nn.Module:
    """A new network.

    Args:
        name: a key of ``NETWORKS``, or ``package.module:factory``, which is called as ``factory(**config)`` and returns
            a network; a plain function becomes a ``FunctionNetwork``. The working directory is importable.
        config: fields of the network's configuration, or keyword arguments of the factory.

    Raises:
        ValueError: an unknown name, a factory that cannot be imported, a bad configuration, or no network.
    """
    if name in NETWORKS:
        try:
            return NETWORKS[name].module(NETWORKS[name].config(**(config or {})))
        except TypeError as error:
            raise ValueError(f"bad configuration of the network {name!r}: {error}") from error
    factory = _import_factory(name)
    try:
        network = factory(**(config or {}))
    except TypeError as error:
        raise ValueError(f"{name} cannot be called with the configuration {dict(config or {})}: {error}") from error
    if not callable(network):
        raise ValueError(f"{name} must return a module or a function, got {type(network).__name__}")
    return network if isinstance(network, nn.Module) else FunctionNetwork(network)


def save(
    path: str | os.PathLike[str],
    network: nn.Module,
    factory: str | None = None,
    factory_config: Mapping[str, Any] | None = None,
    **extra: object,
) -> None:
    """Write ``network`` to a ``.safetensors`` file. A crash leaves an older file whole.

    Args:
        path: the file.
        network: a module of ``NETWORKS``, whose name and configuration the file then holds, or any other module.
        factory: ``package.module:factory`` of a network that is not in ``NETWORKS``; None: the file holds its weights
            alone.
        factory_config: keyword arguments of the factory, JSON values.
        **extra: JSON values to keep beside the weights, such as how they were trained; see ``load_extra``.

    Raises:
        OSError: the file cannot be written.
        TypeError: a value that is not JSON, or a network that is no module: a plain function has no weights.
        ValueError: a parameter that is not finite.
    """
    if not isinstance(network, nn.Module):
        raise TypeError(f"network must be a torch.nn.Module, got {type(network).__name__}")
    name = _registered_name(network)
    config = asdict(cast(Any, network.config)) if name else dict(factory_config or {})
    metadata = {
        "format": FORMAT,
        "network": json.dumps({"name": name} if name else {"factory": factory}),
        "config": json.dumps(config),
        "extra": json.dumps(extra),
    }
    tensors = {key: value.detach().cpu().contiguous() for key, value in network.state_dict().items()}
    _check_finite(network, tensors)
    metadata["checksum"] = _checksum(metadata, tensors)
    with atomic_write(path) as temporary:
        temporary.write_bytes(serialise(tensors, metadata))  # save_file's files can be read by their owner alone


def load(
    path: str | os.PathLike[str], device: torch.device | str = "cpu", network: nn.Module | str | None = None
) -> nn.Module:
    """The network that ``save`` wrote to ``path``, in evaluation mode.

    Args:
        path: a file, or the name of a shipped model such as "default".
        device: where its parameters go.
        network: None builds the network of ``NETWORKS`` that the file names. ``package.module:factory`` is called with
            the file's configuration, if the file does not hold a network of ``NETWORKS``. A module gets the weights
            itself, and is moved to ``device`` and put in evaluation mode.

    Raises:
        OSError: no such file.
        ValueError: not such a file, a damaged one, parameters that are not finite, weights that do not fit, a file that
            holds no network of ``NETWORKS`` while ``network`` is None, or no such device.
    """
    path, device = find(path), find_device(device)
    kept = _read(path)
    try:
        module = network if isinstance(network, nn.Module) else _described_network(kept, network)
        _check_finite(module, kept.tensors)
        module.load_state_dict(kept.tensors)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise ValueError(f"{path}: weights and network do not fit ({error})") from error
    return module.to(device).eval()


def load_extra(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The values that were given to ``save`` beside the network. Raises as ``load``."""
    return _read(find(path)).extra


def load_config(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The configuration of a file's network, or the keyword arguments of its factory. Raises as ``load``."""
    return _read(find(path)).config or {}


def shipped() -> list[str]:
    """Names of the models that come with the package."""
    return sorted(path.stem for path in SHIPPED.glob("*.safetensors"))


def find(path: str | os.PathLike[str]) -> Path:
    """The file behind a path or the name of a shipped model. Raises FileNotFoundError if there is none."""
    if str(path) in shipped():
        return SHIPPED / f"{path}.safetensors"
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no weights at {path}; shipped are {shipped()}")
    return path


def network_name(network: object) -> str:
    """For tables: its name in ``NETWORKS``, or else that of its function or class."""
    if isinstance(network, FunctionNetwork):
        network = network.function
    name = _registered_name(network) if isinstance(network, nn.Module) else None
    return name or str(getattr(network, "__name__", type(network).__name__))


def _registered_name(network: nn.Module) -> str | None:
    return next((name for name, kind in NETWORKS.items() if isinstance(network, kind.module)), None)


def _described_network(kept: _Contents, network: str | None) -> nn.Module:
    """The network that a file describes, built by ``network`` if the file names none of ``NETWORKS``."""
    name, factory = kept.described.get("name"), kept.described.get("factory")
    if name is not None:
        if name not in NETWORKS:
            raise ValueError(f"it holds the network {name!r}, which is none of {sorted(NETWORKS)}")
        if network not in (None, name):
            raise ValueError(f"it holds the network {name!r}, not {network!r}")
        with torch.device("meta"):  # no random weights, which would be overwritten, and no use of the global generator
            empty = build(name, kept.config)
        shapes = {key: value.shape for key, value in empty.state_dict().items()}
        if shapes != {key: value.shape for key, value in kept.tensors.items()}:  # before they take any memory
            raise ValueError(f"its tensors do not have the names and shapes of the network {name!r} that it describes")
        return empty.to_empty(device="cpu")
    if network is None or network in NETWORKS:
        named = f"names the factory {factory!r}" if factory else "holds weights alone"
        raise ValueError(f"it {named}: give the network, network={factory or 'package.module:factory'!r} for example")
    return build(network, kept.config)


def _import_factory(name: str) -> Any:
    try:
        if ":" not in name:
            raise ValueError("no colon in it")
        with _working_directory_importable():
            factory = pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"network must be one of {sorted(NETWORKS)} or package.module:factory, got {name!r} ({error})"
        ) from error
    if not callable(factory):
        raise ValueError(f"{name} must be callable, got {type(factory).__name__}")
    return factory


@contextmanager
def _working_directory_importable() -> Iterator[None]:
    """The command ``mtsp``, unlike ``python -m``, does not have the working directory on its path."""
    here = os.getcwd()
    if here in sys.path or "" in sys.path:
        yield
        return
    sys.path.append(here)
    try:
        yield
    finally:
        sys.path.remove(here)


@dataclass(frozen=True)
class _Contents:
    """What a file holds: how to build the network, its configuration (None: weights alone), more, and its tensors."""

    described: dict[str, Any]
    config: dict[str, Any] | None
    extra: dict[str, Any]
    tensors: dict[str, Tensor]


def _read(path: Path) -> _Contents:
    """The contents of a file that ``save`` wrote, on the CPU; its checksum is verified if it has one."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 (not a dict)
    except SafetensorError as error:
        raise ValueError(f"{path}: not a safetensors file, or a damaged one ({error})") from error
    if metadata.get("format") not in (FORMAT, DAN_ONLY):
        raise ValueError(f"{path}: expected format {FORMAT!r} in its metadata, got {metadata.get('format')!r}")
    if "checksum" in metadata and metadata["checksum"] != _checksum(metadata, tensors):  # older files have none
        raise ValueError(f"{path}: damaged: its checksum does not fit")
    try:
        config = json.loads(metadata["config"])
        if metadata["format"] == FORMAT:
            described = json.loads(metadata["network"])
        else:
            described = {"factory": None} if config is None else {"name": "dan"}
        extra = json.loads(metadata.get("extra", "{}"))
    except (KeyError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: bad metadata ({type(error).__name__}: {error})") from error
    for key, value in (("network", described), ("config", config), ("extra", extra)):
        if not isinstance(value, dict) and not (key == "config" and value is None):
            raise ValueError(f"{path}: bad metadata: {key} must be a JSON object, got {value!r}")
    return _Contents(described, config, extra, tensors)


def _checksum(metadata: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    """SHA-256 over the metadata, and over the names, dtypes, shapes and values of the tensors."""
    described = {key: value for key, value in metadata.items() if key != "checksum"}
    digest = hashlib.sha256(json.dumps(described, sort_keys=True).encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _check_finite(network: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Raise ValueError if a parameter's values are not finite. Buffers may hold infinity, as masks do."""
    for name, _ in network.named_parameters():
        if name in tensors and not tensors[name].isfinite().all():
            raise ValueError(f"the parameter {name!r} holds NaN or infinity: the training behind it has diverged")
