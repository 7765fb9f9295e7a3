"""Scenarios: which worlds they draw, by name or as functions, beside any distribution of nodes."""

from __future__ import annotations

import numpy as np
import pytest

from mtsp_env import DISTRIBUTIONS, SCENARIOS
from mtsp_env.distributions import expected_makespan, sample
from mtsp_env.instance import WORLD_FIELDS

FIELDS = {
    "plain": (),
    "arrivals": ("appears",),
    "breakdowns": ("breaks",),
    "traffic": ("traffic",),
    "team": ("speeds",),
    "service": ("service",),
    "everything": WORLD_FIELDS,
}


def drawn(scenario: str, batch: int = 4000, n: int = 21, m: int = 5) -> dict[str, np.ndarray]:
    return dict(sample("uniform", np.random.default_rng(0), batch, n, m, scenario).arrays)


def test_scenarios_have_the_fields_that_they_promise() -> None:
    assert FIELDS.keys() == SCENARIOS.keys()
    for name, fields in FIELDS.items():
        for n, m in ((2, 1), (9, 3)):
            assert sample("uniform", np.random.default_rng(1), 3, n, m, name).world == fields


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_a_scenario_changes_no_nodes_and_follows_the_seed(distribution: str, scenario: str) -> None:
    plain, world, again, other = (
        sample(distribution, np.random.default_rng(seed), 3, 9, 4, name)
        for seed, name in ((5, "plain"), (5, scenario), (5, scenario), (6, scenario))
    )
    assert np.array_equal(plain.nodes, world.nodes)
    for name in world.world:
        assert np.array_equal(world.arrays[name], again.arrays[name])
        assert not np.array_equal(world.arrays[name], other.arrays[name]) or name == "breaks"


def test_arrivals() -> None:
    appears = drawn("arrivals")["appears"]
    late = appears > 0
    assert (late.sum(1) == 10).all() and not late[:, 0].any()
    assert late[:, 1:].mean(0) == pytest.approx(0.5, abs=0.04)  # five standard errors
    times = appears[late] / expected_makespan(21, 5)
    assert times.max() < 1.0 and times.mean() == pytest.approx(0.5, abs=0.01)


def test_breakdowns() -> None:
    breaks = drawn("breakdowns")["breaks"]
    fails = np.isfinite(breaks)
    assert (~fails).any(1).all()
    assert fails.mean(0) == pytest.approx(0.3 * 4 / 5, abs=0.035)  # each is spared as often as the others
    assert breaks[fails].max() < expected_makespan(21, 5)


def test_the_others() -> None:
    world = drawn("everything")
    factors = np.log(world["traffic"])
    assert factors.shape == (4000, 5, 21)
    assert factors.mean() == pytest.approx(0.0, abs=0.003) and factors.std() == pytest.approx(0.3, abs=0.003)
    assert 0.5 <= world["speeds"].min() < 0.51 and 1.49 < world["speeds"].max() <= 1.5
    assert not world["service"][:, 0].any() and 0.099 < world["service"].max() <= 0.1


def test_a_scenario_may_be_a_function() -> None:
    def slow(rng: np.random.Generator, batch: int, n_nodes: int, n_agents: int) -> dict[str, np.ndarray]:
        return {"speeds": np.full((batch, n_agents), 0.5)}

    problem = sample("clustered", np.random.default_rng(0), 2, 9, 3, slow)
    assert problem.arrays["speeds"].tolist() == [[0.5] * 3] * 2
    for bad, message in (
        ("rain", r"unknown scenario 'rain'; choose from \['arrivals', .*\] or give a function"),
        (lambda *_: [1.0], "a scenario must return a dict of arrays"),
        (lambda *_: {"nodes": np.zeros((2, 9, 2))}, r"\['nodes'\] must come from the distribution"),
        (lambda *_: {"speeds": np.zeros((2, 3))}, "speeds must be above 0"),
        (lambda *_: {"speeds": np.ones((1, 3))}, "speeds must have shape"),
        (lambda *_: {"weather": np.ones(2)}, "unknown field 'weather'"),
    ):
        with pytest.raises(ValueError, match=message):
            sample("uniform", np.random.default_rng(0), 2, 9, 3, bad)
