"""Configurations of REINFORCE by name."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import tyro

from dan_policy.dan import DANConfig
from train.reinforce_config import ReinforceConfig

PAPER = ReinforceConfig(curriculum=((80_000, 20, 200, 5, 10),))
"""The paper's training (Sec. 5.1), except that the optimiser takes one step per batch instead of one per agent.

The last fifth of the steps is on up to 200 nodes, like the last 24 of the paper's 120 hours.
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
"""Small instances, the depot rule "final" and a larger learning rate: learns within minutes on two CPU cores."""

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
"""For weights that were trained by imitation (``init``): many samples of few instances, with the shared baseline."""

PRESETS = {"paper": PAPER, "refine": REFINE, "quick": QUICK}
DESCRIPTIONS = {
    "paper": "The paper's setting: n in [20, 100], later up to 200, m in [5, 10], 8 instances per step, Adam 1e-5.",
    "refine": "Improve weights that were trained by imitation (--init): 8 samples per instance, shared baseline.",
    "quick": "n in [10, 30], m in [2, 5], 128 instances per step: learns within minutes on a CPU.",
}

if TYPE_CHECKING:
    Preset = ReinforceConfig
else:  # the command line offers the presets as subcommands
    Preset = Annotated[
        tyro.extras.subcommand_type_from_defaults(PRESETS, DESCRIPTIONS),
        tyro.conf.arg(name="", help="Preset, whose options may be changed."),
    ]
