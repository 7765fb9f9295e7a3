"""The same game with another future."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mtsp_env import Instance
from mtsp_env.distributions import everything


def other_future(instance: Instance, log: list, time: float, rng: np.random.Generator) -> Instance:
    """``instance`` with everything changed that nobody knows at ``time`` in the game of ``log``."""
    n, m = instance.n_nodes, instance.n_agents
    factors = instance.traffic.copy()
    for agent, legs in enumerate(log):
        finished = sum(leg.ready <= time for leg in legs)
        factors[agent, finished] *= 1.7  # the leg under way takes longer, so that it is not finished by then either
        factors[agent, finished + 1 :] = rng.lognormal(0.0, 0.3, factors.shape[1] - finished - 1)
    if instance.appears is None:
        return replace(instance, traffic=factors)
    unknown = instance.appears > time
    later = (instance.breaks > time) & np.isfinite(instance.breaks)
    return replace(
        instance,
        nodes=np.where(unknown[:, None], rng.random((n, 2)), instance.nodes),
        service=np.where(unknown, rng.uniform(0.0, 0.1, n), instance.service),
        appears=np.where(unknown, time + rng.uniform(0.01, 2.0, n), instance.appears),
        breaks=np.where(later, time + rng.uniform(0.01, 2.0, m), instance.breaks),
        traffic=factors,
    )


def long_traffic(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    """A traffic factor for every leg of a game, so that changes of later ones are in the future."""
    return {"traffic": rng.lognormal(0.0, 0.3, (batch, n_agents, 200))}


def long_everything(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
    return everything(rng, batch, n_nodes, n_agents) | long_traffic(rng, batch, n_nodes, n_agents)
