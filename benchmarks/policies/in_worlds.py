"""The methods that are compared in worlds that change, and the two that need no network and no solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dan_policy import registry
from mtsp_env import rules

Decide = Callable[[rules.State, rules.Rules], int]
"""A game (B = 1, NumPy arrays) -> the deciding agent's next node. Each game gets one of its own."""

OBSERVED = "local: its open cities, and what each agent announces about itself"


@dataclass(frozen=True)
class Method:
    """How a method is called in tables, what it needs to know, and what it is.

    Exactly one of ``rule``, ``network`` and ``milliseconds`` says how it decides: a function of a random generator
    that makes a ``Decide``, weights, or a planner's time for each search.
    """

    title: str
    needs: str
    rule: Callable[[np.random.Generator], Decide] | None = None
    network: str | None = None
    milliseconds: float | None = None


def _random(rng: np.random.Generator) -> Decide:
    def decide(game: rules.State, game_rules: rules.Rules) -> int:
        legal = rules.legal_actions(game, game_rules, rules.agent_to_decide(game))[0]
        return int(rng.choice(np.flatnonzero(legal)))

    return decide


def _nearest(rng: np.random.Generator) -> Decide:
    def decide(game: rules.State, game_rules: rules.Rules) -> int:
        seen = rules.observe(game, game_rules)
        distance = np.where(seen.action_mask[0], np.hypot(*seen.cities[0].T), np.inf)
        distance[0] = 1e9  # the depot only if no city is legal
        return int(np.argmin(distance))

    return decide


METHODS: dict[str, Method] = {
    "random": Method("random", "local: its open cities", rule=_random),
    "nearest": Method("nearest city", "local: its open cities", rule=_nearest),
    "default": Method("`default`, greedy", OBSERVED, network="default"),
    "dan": Method("`dan`, greedy", OBSERVED, network="dan"),
    "world": Method("`world`, greedy", OBSERVED, network="world"),
    "plan-once": Method("plan once (50 ms), then the nearest agent", "global: at the start", milliseconds=50.0),
    "replanner-5": Method("Replanner, 5 ms per event", "global: at every event", milliseconds=5.0),
    "replanner-50": Method("Replanner, 50 ms per event", "global: at every event", milliseconds=50.0),
}
BASELINE = "replanner-50"


def find_method(name: str) -> Method:
    """The method of a name in ``METHODS``, or that of a file of weights."""
    if name in METHODS:
        return METHODS[name]
    return Method(f"`{name}`, greedy", OBSERVED, network=name)


def is_available(name: str) -> bool:
    """Whether a method can be played: its network is shipped, or it has none."""
    return METHODS[name].network is None or METHODS[name].network in registry.shipped()
