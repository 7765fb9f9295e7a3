"""Random games of the PettingZoo environment."""

from __future__ import annotations

import numpy as np
import pettingzoo


def random_action(env: pettingzoo.AECEnv, rng: np.random.Generator) -> int:
    return int(rng.choice(np.flatnonzero(env.observe(env.agent_selection)["action_mask"])))


def over(env: pettingzoo.AECEnv) -> bool:
    return any(env.terminations.values()) or any(env.truncations.values())


def play(env: pettingzoo.AECEnv, seed: int = 0) -> list[tuple]:
    """Play random legal actions until the episode is over; returns (agent, observation, action, rewards) per step."""
    rng, steps = np.random.default_rng(seed), []
    while not over(env):
        seen, agent, action = env.observe(env.agent_selection), env.agent_selection, random_action(env, rng)
        env.step(action)
        steps.append((agent, seen, action, dict(env.rewards)))
    return steps
