"""DAN, the decentralised attention-based policy for the MinMax mTSP, other networks, trained weights, and ``solve``.

Names are imported on first use: the command ``mtsp`` lives in this package, and its help should not wait for torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dan_policy.actor import make_actor
    from dan_policy.dan import DAN, DANConfig
    from dan_policy.episode import Episode, rollout
    from dan_policy.joint import JointConfig, JointDAN
    from dan_policy.layers import AttentionLayer
    from dan_policy.planning import Solution, SolveOptions, solve
    from dan_policy.registry import NETWORKS, build, load, save

_MODULES = {
    "DAN": "dan",
    "NETWORKS": "registry",
    "AttentionLayer": "layers",
    "DANConfig": "dan",
    "Episode": "episode",
    "JointConfig": "joint",
    "JointDAN": "joint",
    "Solution": "planning",
    "SolveOptions": "planning",
    "build": "registry",
    "load": "registry",
    "make_actor": "actor",
    "rollout": "episode",
    "save": "registry",
    "solve": "planning",
}

__all__ = [
    "DAN",
    "NETWORKS",
    "AttentionLayer",
    "DANConfig",
    "Episode",
    "JointConfig",
    "JointDAN",
    "Solution",
    "SolveOptions",
    "build",
    "load",
    "make_actor",
    "rollout",
    "save",
    "solve",
]


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
