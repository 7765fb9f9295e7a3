"""The options of a training run that takes a second."""

from dataclasses import replace

from dan_policy import DANConfig
from train.presets import QUICK

TINY = replace(
    QUICK,
    n_nodes=(5, 8),
    n_agents=(1, 3),
    batch_size=6,
    network=DANConfig(embed_dim=16, feedforward_dim=32, n_heads=2, city_layers=1, prune_visited=True),
    challenge_every=2,
    challenge_instances=8,
    validate_every=2,
    validation_instances=8,
    checkpoint_every=2,
    decay=0.5,
    decay_every=2,
    steps=6,
    tensorboard=False,
)
