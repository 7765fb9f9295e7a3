"""What the examples of this folder share: the game, and policies to compare with on the same held-out instances.

A policy is a function of what the deciding agent sees: ``choose(observation, mask)`` returns the node to go to next.
``observation`` is the dict of ``gymnasium.make("mtsp/MinMaxMTSP-v0")``, and ``mask`` (n,) bool are the legal nodes.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import gymnasium
import numpy as np

import mtsp_env
from mtsp_env.reference import improve

# The depot and 9 cities. An agent that goes home stays there ("final"), so that games end whatever a policy does.
GAME = {"n_nodes": 10, "n_agents": 3, "depot": "final", "reward": "shaped"}
TEST_SEED, TEST_INSTANCES = 1_000_003, 100
Policy = Callable[[dict[str, np.ndarray], np.ndarray], int]


def make_env() -> gymnasium.Env:
    """The game that is learned and judged; each step is one decision of the agent that has just arrived."""
    return gymnasium.make("mtsp/MinMaxMTSP-v0", disable_env_checker=True, **GAME)


def flat(observation: dict[str, np.ndarray]) -> np.ndarray:
    """(3 n + 4 m,) float32: the vector of ``mtsp_env.wrappers.flatten`` and ``gymnasium``'s ``FlattenObservation``."""
    return gymnasium.spaces.flatten(_JUDGE.observation_space, observation).astype(np.float32)


def arguments(description: str | None, steps: int) -> argparse.Namespace:
    """``--steps``, the decisions to learn from, and ``--seed``, of the learner and its training instances."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=steps, help=f"decisions to learn from (default {steps})")
    parser.add_argument("--seed", type=int, default=0, help="of the learner and its training instances (default 0)")
    return parser.parse_args()


def compare(library: str, choose: Policy, steps: int, seconds: float) -> None:
    """Print the mean makespan, and its standard error, of five policies on the held-out instances.

    Args:
        library: its name.
        choose: its greedy policy.
        steps: decisions that it has learned from.
        seconds: CPU time that it took to learn, all threads together (``time.process_time``).
    """
    rng = np.random.default_rng(TEST_SEED)
    instances = [mtsp_env.uniform(rng, GAME["n_nodes"], GAME["n_agents"]) for _ in range(TEST_INSTANCES)]
    makespans = {
        "random": play(Random(home_last=False), instances),
        "home-last": play(Random(home_last=True), instances),
        library: play(choose, instances),
        "nearest": play(nearest, instances),
        "reference": [mtsp_env.makespan(instance, improve(instance)) for instance in instances],
    }
    print(f"{steps} steps, {seconds:.0f} s of CPU time")
    print(f"makespan on {len(instances)} held-out instances, mean +- standard error:")
    for name, values in makespans.items():
        print(f"{name:12s} {np.mean(values):.3f} +- {np.std(values, ddof=1) / np.sqrt(len(values)):.3f}")


def play(choose: Policy, instances: list[mtsp_env.Instance]) -> list[float]:
    """The makespan of each instance."""
    makespans = []
    for instance in instances:
        observation, info = _JUDGE.reset(options={"instance": instance})
        over = False
        while not over:
            action = int(choose(observation, info["action_mask"].astype(bool)))
            observation, _, terminated, truncated, info = _JUDGE.step(action)
            over = terminated or truncated
        makespans.append(info["makespan"])
    return makespans


class Random:
    """Any legal node; with ``home_last`` only cities while there are any, which most learners find out first."""

    def __init__(self, home_last: bool):
        self.home_last, self.rng = home_last, np.random.default_rng(0)

    def __call__(self, observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
        nodes = np.flatnonzero(mask)
        return self.rng.choice(nodes[nodes > 0] if self.home_last and mask[1:].any() else nodes)


def nearest(observation: dict[str, np.ndarray], mask: np.ndarray) -> int:
    """The nearest unvisited city; home if there is none."""
    distance = np.where(mask, np.linalg.norm(observation["cities"], axis=1), np.inf)  # (n,)
    distance[0] = 1e9 if mask[0] else np.inf
    return int(distance.argmin())


_JUDGE = make_env()
