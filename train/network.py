"""The network that a run trains: a registered one by its name, or one of your own by its factory."""

from __future__ import annotations

import os
from dataclasses import asdict, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torchrl.modules import ProbabilisticActor

from dan_policy.actor import make_actor
from dan_policy.network import Key
from dan_policy.registry import NETWORKS, build, load, save
from mtsp_env.batched import BatchedMTSP
from train.config import OVERRIDES, RunConfig
from train.optimisers import hidden_layers
from train.supervised_config import ImitateConfig


def make_network(config: RunConfig) -> nn.Module:
    """The network that ``config.policy`` names, with fresh weights or those of ``config.init``.

    Raises:
        OSError: no such weights.
        ValueError: no such factory, no network that plays, or weights that do not fit.
    """
    if config.init is None:
        network = build(config.policy, config.network_options())
        if not config.registered:
            _check_plays(network, config)
        return network
    network = load_weights(config.init, config)
    if config.registered and not isinstance(network, NETWORKS[config.policy].module):
        raise ValueError(
            f"init={config.init!r} holds a {type(network).__name__}, but policy is {config.policy!r}: "
            f"give another policy of {sorted(NETWORKS)}"
        )
    return _changed(network, config)


def compile_layers(network: nn.Module) -> None:
    """Run the network's ``hidden_layers`` through ``torch.compile`` from now on, for batches of any shape.

    The parameters and their names stay the same. What surrounds the layers depends on the data and is not compiled.

    Raises:
        ValueError: the network has no such layers.
    """
    for layer in hidden_layers(network, "compile=True"):
        layer.compile(dynamic=True)


def _check_plays(network: nn.Module, config: RunConfig) -> None:
    """Raise ValueError unless a network of the user's has parameters and returns logits for an observation."""
    if not any(parameter.requires_grad for parameter in network.parameters()):
        raise ValueError(f"policy={config.policy!r} has no parameters to train")
    env = BatchedMTSP(4, 2, 2, seed=0)
    try:
        with torch.random.fork_rng(), torch.no_grad():  # the run draws the same numbers as without this check
            logits = make_actor(network)(env.reset())["logits"]
    except Exception as error:  # whatever the user's code does
        raise ValueError(
            f"policy={config.policy!r} fails on an observation ({type(error).__name__}: {error})"
        ) from error
    if logits.shape != (2, 4):
        raise ValueError(f"policy={config.policy!r} must return logits (B, n) = (2, 4), got {tuple(logits.shape)}")


def load_weights(path: str | os.PathLike, config: RunConfig) -> nn.Module:
    """The network in a weights file: one that the file describes, or ``config.policy``'s factory with its weights."""
    return load(path, network=None if config.registered else build(config.policy, config.network_options()))


@lru_cache(maxsize=1)
def student(config: ImitateConfig) -> ProbabilisticActor:
    """The actor of the network of ``config.roll_in``, in evaluation mode; loaded once."""
    if config.roll_in is None:
        raise ValueError("roll_in must name the student's weights, got None")
    return make_actor(load_weights(config.roll_in, config).eval())


def save_weights(path: Path, network: nn.Module, config: RunConfig, extra: dict[str, Any]) -> None:
    """Write a network that was trained with ``config``, and how to build it again; ``extra`` as for ``save``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if config.registered:
        save(path, network, **extra)
    else:
        save(path, network, config.policy, config.network_options(), **extra)


def observation_keys(network: nn.Module) -> tuple[Key, ...]:
    """What must be kept of an observation to evaluate the network's policy again: its inputs and ``action_mask``."""
    return tuple(dict.fromkeys(make_actor(network).in_keys))


def _changed(network: nn.Module, config: RunConfig) -> nn.Module:
    """The same weights in a network with what the run overrides, if anything. Parameters that it adds begin as zero."""
    changes = {name: getattr(config, name) for name in OVERRIDES if getattr(config, name) is not None}
    if not changes:
        return network
    options: dict[str, Any] = asdict(network.config) if is_dataclass(network.config) else {}
    for name in changes.keys() - options.keys():
        raise ValueError(f"{name} must be None: the policy {config.policy!r} has no such option")
    changed = build(config.policy, options | changes)
    lost = sorted(network.state_dict().keys() - changed.state_dict().keys())
    if lost:
        raise ValueError(f"{changes} would leave out weights that init={config.init!r} holds: {lost}")
    added = {name: torch.zeros_like(tensor) for name, tensor in changed.state_dict().items()}
    changed.load_state_dict(added | network.state_dict())
    return changed.eval()
