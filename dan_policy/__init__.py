"""DAN, the decentralised attention-based policy for the MinMax mTSP, as a TorchRL module with trained weights."""

from importlib import import_module

_HOMES = {
    "DAN": "dan",
    "DANConfig": "dan",
    "JointDAN": "joint",
    "JointConfig": "joint",
    "AttentionLayer": "layers",
    "make_actor": "actor",
    "Episode": "episode",
    "rollout": "episode",
    "NETWORKS": "registry",
    "build": "registry",
    "load": "registry",
    "save": "registry",
    "Solution": "solution",
    "solve": "solution",
}

__all__ = list(_HOMES)


def __getattr__(name: str) -> object:
    """Import on first use: the command ``mtsp`` lives in this package and need not wait for torch to print its help."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
