"""``python -m mtsp_env``: prints versions and plays a game, to check an installation."""

from __future__ import annotations

import platform
import sys
from importlib.metadata import PackageNotFoundError, version

import numpy as np

from mtsp_env import __version__, check_tours, lower_bound, mtsp_v0

NEEDED = ("numpy", "gymnasium", "pettingzoo", "array-api-compat")
OPTIONAL = ("torch", "tensordict", "torchrl", "numba", "matplotlib", "vrplib", "fastapi")
GAME = {"n_nodes": 20, "n_agents": 3, "seed": 0}


def main() -> int:
    """Print the versions, play one game with the nearest city, check its tours; returns 0."""
    print(f"mtsp-env {__version__}, Python {platform.python_version()}, {platform.platform()}")
    for name in (*NEEDED, *OPTIONAL):
        print(f"{name} {_version(name)}")
    makespan, bound = play(**GAME)
    print(f"played a game of {GAME['n_nodes']} nodes and {GAME['n_agents']} agents, going to the nearest city:")
    print(f"makespan {makespan:.4f}, no less than the lower bound {bound:.4f}; the tours are valid")
    return 0


def play(n_nodes: int, n_agents: int, seed: int) -> tuple[float, float]:
    """Makespan and lower bound of a game in which every agent goes to the nearest unvisited city.

    Raises:
        ValueError: the tours do not solve the instance.
    """
    env = mtsp_v0.env(n_nodes=n_nodes, n_agents=n_agents)
    env.reset(seed=seed)
    for _ in env.agent_iter():
        seen, _, terminated, truncated, info = env.last()
        if terminated or truncated:
            break
        distance = np.linalg.norm(seen["observation"]["cities"], axis=1)  # (n,)
        cities = np.where(seen["action_mask"], distance, np.inf)[1:]
        env.step(1 + int(np.argmin(cities)))
    instance = env.unwrapped.instance
    check_tours(instance, env.unwrapped.tours)
    return info["makespan"], lower_bound(instance)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "is not installed"


if __name__ == "__main__":
    sys.exit(main())
