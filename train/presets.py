"""Configurations by name."""

from __future__ import annotations

from dataclasses import replace

from dan_policy.dan import DANConfig
from train.config import ReinforceConfig

PAPER = ReinforceConfig(curriculum=((80_000, 20, 200, 5, 10),))
"""The paper's training (Sec. 5.1), with one optimiser step per batch instead of one per agent.

The last fifth of the steps is on up to 200 nodes, as the last 24 of the paper's 120 hours were.
"""

QUICK = replace(
    PAPER,
    curriculum=(),
    steps=2_000,
    n_nodes=(10, 30),
    n_agents=(2, 5),
    speed=0.1,
    depot="final",
    batch_size=128,
    network=replace(DANConfig.paper(), prune_visited=True),
    learning_rate=3e-4,
    decay=0.97,
    decay_every=50,
    challenge_every=50,
    challenge_instances=512,
    validate_every=50,
    checkpoint_every=50,
)
"""Small instances, the depot rule "final" and a larger step: learns within minutes on two CPU cores."""

REFINE = replace(
    PAPER,
    curriculum=(),
    steps=1_000,
    n_nodes=(20, 100),
    n_agents=(2, 10),
    nodes_per_agent=5,
    speed=0.01,
    depot="final",
    baseline="shared",
    samples=8,
    batch_size=64,
    batch_tokens=800,
    normalise=True,
    network=DANConfig(prune_visited=True),
    learning_rate=1e-4,
    decay=1.0,
    validate_every=50,
    checkpoint_every=50,
)
"""From imitated weights (``init``): many samples of few instances, each other's baseline."""

PRESETS = {
    "paper": ("the paper's: n in [20, 100], later up to 200, m in [5, 10], 8 instances a step, Adam 1e-5", PAPER),
    "refine": ("sharpens imitated weights (--init): 8 samples of each instance, each other's baseline", REFINE),
    "quick": ("n in [10, 30], m in [2, 5], 128 instances a step: learns within minutes on a CPU", QUICK),
}
