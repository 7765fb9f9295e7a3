"""The models that come with the package load, plan, and beat the nearest-city rule."""

import numpy as np
import pytest

from benchmarks.policies.nearest import nearest
from dan_policy import load, registry, solve
from mtsp_env import uniform


def runs_of(extra: dict) -> list[dict]:
    """The runs behind the weights: those whose weights were averaged, and what a run started from."""
    parts = extra.get("averaged", [])
    parts += [extra["started_from"]] if "started_from" in extra else []
    return [run for part in parts for run in runs_of(part)] + ([extra] if "step" in extra else [])


@pytest.mark.parametrize("name", ["default", "dan"])
def test_the_card_names_every_run_behind_the_weights(name):
    card = (registry.SHIPPED / "README.md").read_text().split(f"## `{name}`")[1].split("\n## ")[0]
    runs = runs_of(registry.load_extra(name))
    assert len(runs) > 2
    for run in runs:
        assert f"{run['instances']:,}" in card and f"{run['step']:,} steps" in card, (run["instances"], run["step"])


@pytest.mark.parametrize("name", registry.shipped())
@pytest.mark.slow
def test_shipped_models_beat_nearest(name):
    network = load(name)
    instances = [uniform(np.random.default_rng([11, k]), 25, 4) for k in range(40)]
    ours = np.array([solve(instance, network).makespan for instance in instances])
    rule = np.array([solve(instance, nearest).makespan for instance in instances])
    assert ours.mean() < 0.95 * rule.mean()
    assert (ours < rule).mean() > 0.6
