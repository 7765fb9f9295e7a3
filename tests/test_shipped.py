"""The models that come with the package load, plan, and beat the nearest-city rule."""

import numpy as np
import pytest

from benchmarks.policies.nearest import nearest
from dan_policy import load, registry, solve
from mtsp_env import uniform


def test_there_is_a_default_with_a_card():
    assert "default" in registry.shipped()
    card = (registry.SHIPPED / "README.md").read_text()
    for part in registry.load_extra("default")["averaged"]:
        assert f"{part['instances']:,}" in card and f"{part['step']} steps" in card


@pytest.mark.parametrize("name", registry.shipped())
@pytest.mark.slow
def test_shipped_models_beat_nearest(name):
    network = load(name)
    instances = [uniform(np.random.default_rng([11, k]), 25, 4) for k in range(40)]
    ours = np.array([solve(instance, network).makespan for instance in instances])
    rule = np.array([solve(instance, nearest).makespan for instance in instances])
    assert ours.mean() < 0.95 * rule.mean()
    assert (ours < rule).mean() > 0.6
