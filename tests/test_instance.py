"""Instances: validation, equality, distributions, files."""

import dataclasses
import json
import math
import os
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mtsp_env import (
    DISTRIBUTIONS,
    Instance,
    clustered,
    from_coordinates,
    lower_bound,
    makespan,
    read_instance,
    read_tours,
    uniform,
    write_instance,
    write_tours,
)
from mtsp_env.distributions import sample
from mtsp_env.instance import FIELDS, WORLD_FIELDS, batch

PAIR = [[0.0, 0.0], [1.0, 1.0]]
HUGE = 10**400  # too large for a float

instances = st.builds(
    Instance,
    nodes=st.integers(2, 6).flatmap(lambda n: arrays(np.float64, (n, 2), elements=st.floats(0, 1))),
    n_agents=st.integers(1, 9),
    name=st.text(),
    scale=st.floats(min_value=0, exclude_min=True, max_value=1e300),
)


# Validation and equality


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"nodes": [[0.0, 0.0]]}, "n_nodes must be a whole number of at least 2, got 1"),
        ({"nodes": [0.0, 1.0]}, r"shape \(n, 2\), got \(2,\)"),
        ({"nodes": [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]}, r"shape \(n, 2\), got \(2, 3\)"),
        ({"nodes": [[PAIR, PAIR]]}, r"shape \(n, 2\)"),
        ({"nodes": [[0.0, 0.0], [1.0]]}, "nodes must be an array of numbers"),
        ({"nodes": "nodes"}, "nodes must be an array of numbers, got str"),
        ({"nodes": [[0, 0], [HUGE, 1]]}, "nodes must be"),
        ({"nodes": [[0.0, 0.0], [1.0, math.nan]]}, r"finite, got nan at \(1, 1\)"),
        ({"nodes": [[0.0, -math.inf], [1.0, 1.0]]}, r"finite, got -inf at \(0, 1\)"),
        ({"nodes": [[0.0, 0.0], [1.0, 1.5]]}, r"\[0, 1\], got a range of \[0, 1.5\]; from_coordinates"),
        ({"nodes": [[-1e-9, 0.0], [1.0, 1.0]]}, r"\[0, 1\], got a range of \[-1e-09, 1\]"),
        ({"n_agents": 0}, "n_agents must be a whole number of at least 1, got 0"),
        ({"n_agents": 2.0}, r"n_agents must be .*, got 2\.0"),
        ({"n_agents": True}, "n_agents must be .*, got True"),
        ({"n_agents": None}, "n_agents must be .*, got None"),
        ({"scale": 0.0}, r"scale must be a finite number above 0, got 0\.0"),
        ({"scale": -1.0}, r"scale must be .*, got -1\.0"),
        ({"scale": math.nan}, "scale must be .*, got nan"),
        ({"scale": math.inf}, "scale must be .*, got inf"),
        ({"scale": "km"}, "scale must be .*, got 'km'"),
        ({"scale": None}, "scale must be .*, got None"),
        ({"scale": HUGE}, "scale must be"),
    ],
)
def test_bad_instance_is_refused_with_value_and_range(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instance(**{"nodes": PAIR, "n_agents": 1, **change})


def test_an_instance_does_not_change() -> None:
    source = np.array(PAIR)
    instance = Instance(source, 3)
    source[0, 0] = 0.5
    assert instance.nodes.tolist() == PAIR
    with pytest.raises(ValueError, match="read-only"):
        instance.nodes[0, 0] = 0.5
    with pytest.raises(dataclasses.FrozenInstanceError):
        instance.n_agents = 4
    assert source.flags.writeable  # the caller's array stays the caller's
    copy = pickle.loads(pickle.dumps(instance))
    assert copy == instance and not copy.nodes.flags.writeable


def test_more_agents_than_cities_and_coincident_nodes_are_fine() -> None:
    instance = Instance([[0.5, 0.5]] * 3, n_agents=9)
    assert (instance.n_nodes, instance.n_agents) == (3, 9)


def test_equality_is_by_value_and_hash_agrees() -> None:
    instance = Instance(PAIR, 2, "pair", 3.0)
    assert instance == Instance(np.array(PAIR), np.int64(2), "pair", 3.0)
    assert len({instance, Instance(np.array(PAIR), np.int64(2), "pair", 3.0)}) == 1
    others = [
        Instance([[0.0, 0.0], [1.0, 0.5]], 2, "pair", 3.0),
        Instance(PAIR, 3, "pair", 3.0),
        Instance(PAIR, 2, "other", 3.0),
        Instance(PAIR, 2, "pair", 4.0),
        "pair",
    ]
    assert all(instance != other for other in others)


def test_equal_instances_have_equal_hashes_even_with_negative_zero() -> None:
    plus, minus = Instance([[0.0, 0.0], [1.0, 1.0]], 1), Instance([[-0.0, 0.0], [1.0, 1.0]], 1)
    assert plus == minus
    assert hash(plus) == hash(minus)


# Any coordinates


@pytest.mark.slow
@given(
    xy=st.integers(2, 8).flatmap(lambda n: arrays(np.float64, (n, 2), elements=st.floats(-1e6, 1e6))),
    n_agents=st.integers(1, 5),
)
def test_from_coordinates_keeps_lengths(xy: np.ndarray, n_agents: int) -> None:
    instance = from_coordinates(xy, n_agents, "any")
    assert (instance.n_agents, instance.name) == (n_agents, "any")
    assert instance.nodes.min() == 0.0
    assert np.ptp(xy) == 0 or instance.nodes.max() in (0.0, 1.0)
    lengths = np.linalg.norm(instance.nodes[:, None] - instance.nodes, axis=2) * instance.scale
    np.testing.assert_allclose(lengths, np.linalg.norm(xy[:, None] - xy, axis=2), rtol=1e-9, atol=1e-9)


def test_from_coordinates_with_all_nodes_in_one_place() -> None:
    instance = from_coordinates([[7.0, -3.0]] * 4, 2)
    assert instance.scale == 1.0
    assert not instance.nodes.any()


@pytest.mark.parametrize(
    ("xy", "message"),
    [
        ([[1.0, 2.0]], "at least 2, got 1"),
        ([[1.0, 2.0, 3.0]] * 2, r"shape \(n, 2\), got \(2, 3\)"),
        ([1.0, 2.0], r"shape \(n, 2\), got \(2,\)"),
        ([[1.0, 2.0], [math.nan, 0.0]], "finite"),
        ([[1.0, 2.0], [math.inf, 0.0]], "finite"),
    ],
)
def test_from_coordinates_refuses(xy: list, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        from_coordinates(xy, 1)


# Distributions


@pytest.mark.slow
@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
@given(seed=st.integers(0, 2**32), batch=st.integers(0, 4), n_nodes=st.integers(2, 30))
def test_samples_lie_in_the_unit_square_and_follow_the_seed(
    distribution: str, seed: int, batch: int, n_nodes: int
) -> None:
    nodes, again, other = (
        sample(distribution, np.random.default_rng(s), batch, n_nodes, 2).nodes for s in (seed, seed, seed + 1)
    )
    assert nodes.shape == (batch, n_nodes, 2)
    assert nodes.dtype == np.float64
    assert ((nodes >= 0) & (nodes <= 1)).all()
    assert np.array_equal(nodes, again)
    assert batch == 0 or not np.array_equal(nodes, other)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_every_node_is_uniform_on_its_own(distribution: str) -> None:
    """Clusters too: a uniform centre, shifted by the same noise either way and folded at the border, stays uniform."""
    nodes = sample(distribution, np.random.default_rng(0), 40_000, 3, 2).nodes
    np.testing.assert_allclose(nodes.mean(axis=0), 1 / 2, atol=0.006)  # four standard errors
    np.testing.assert_allclose(nodes.var(axis=0), 1 / 12, atol=0.002)
    corner = (nodes < 0.1).all(axis=2).mean(axis=0)
    np.testing.assert_allclose(corner, 0.01, atol=0.002)


def test_uniform_nodes_are_independent_and_clustered_cities_are_not() -> None:
    """Two clustered cities share one of k centres, k uniform in 3 to 8, with probability mean(1/k) = 0.203; then their
    coordinates correlate as a centre plus noise of standard deviation 0.07 does, 1 / (1 + 12 * 0.07^2) = 0.944."""
    for distribution, expected in (("uniform", 0.0), ("clustered", 0.203 * 0.944)):
        nodes = sample(distribution, np.random.default_rng(1), 40_000, 3, 2).nodes
        for axis in (0, 1):
            depot, one, other = nodes[:, :, axis].T
            assert np.corrcoef(one, other)[0, 1] == pytest.approx(expected, abs=0.02), distribution
            assert np.corrcoef(depot, one)[0, 1] == pytest.approx(0.0, abs=0.02), distribution
        assert np.corrcoef(nodes[:, 1, 0], nodes[:, 1, 1])[0, 1] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("make", "distribution"), [(uniform, "uniform"), (clustered, "clustered")])
def test_one_instance_is_a_batch_of_one(make, distribution: str) -> None:
    instance = make(np.random.default_rng(3), n_nodes=20, n_agents=4)
    assert instance.nodes.tolist() == sample(distribution, np.random.default_rng(3), 1, 20, 4).nodes[0].tolist()
    assert (instance.n_nodes, instance.n_agents, instance.scale) == (20, 4, 1.0)


def test_bad_samples_are_refused() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"unknown distribution 'ring'; choose from \['clustered', 'uniform'\]"):
        sample("ring", rng, 1, 5, 2)
    with pytest.raises(ValueError, match=r"n_nodes must be .* at least 2, got 1"):
        uniform(rng, 1, 2)
    with pytest.raises(ValueError, match=r"n_agents must be .* at least 1, got 0"):
        clustered(rng, 5, 0)


# Files


@pytest.mark.slow
@given(instance=instances, n_agents=st.none() | st.integers(1, 5))
def test_instance_file_round_trip(tmp_path_factory, instance: Instance, n_agents: int | None) -> None:
    path = tmp_path_factory.mktemp("instance") / "a.json"
    write_instance(path, instance)
    m = instance.n_agents if n_agents is None else n_agents
    assert read_instance(path, n_agents) == Instance(instance.nodes, m, instance.name, instance.scale)


def test_numpy_scalars_can_be_written(tmp_path) -> None:
    instance = Instance(PAIR, np.int32(2), "pair", np.float32(2.5))
    write_instance(tmp_path / "a.json", instance)
    assert read_instance(tmp_path / "a.json") == instance


@pytest.mark.slow
@given(tours=st.lists(st.lists(st.integers(0, 99))), seconds=st.floats(0, 9))
def test_tours_file_round_trip(tmp_path_factory, tours: list, seconds: float) -> None:
    path = tmp_path_factory.mktemp("tours") / "a.json"
    write_tours(path, [np.array(tour, dtype=np.int64) for tour in tours], seconds=seconds)
    assert read_tours(path) == tours
    assert json.loads(path.read_text())["seconds"] == seconds


GOOD = {"nodes": PAIR, "n_agents": 2, "name": "pair", "scale": 2.0}


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe\x00",
        b"[" * 100_000,
        b"[1, 2]",
        b"{}",
        json.dumps(GOOD).encode()[:-1],
        json.dumps({**GOOD, "nodes": None}).encode(),
        json.dumps({**GOOD, "nodes": [[0, "x"], [1, 1]]}).encode(),
        json.dumps({**GOOD, "nodes": [[0, 0], [1, 2]]}).encode(),
        json.dumps({**GOOD, "nodes": [[0, 0], [1, math.nan]]}).encode(),
        json.dumps({**GOOD, "nodes": [[0, 0], [1, HUGE]]}).encode(),
        json.dumps({**GOOD, "n_agents": 0}).encode(),
        json.dumps({**GOOD, "n_agents": "2"}).encode(),
        json.dumps({**GOOD, "name": ["pair"]}).encode(),
        json.dumps({**GOOD, "scale": "km"}).encode(),
        json.dumps({**GOOD, "scale": None}).encode(),
        json.dumps({**GOOD, "scale": -2}).encode(),
    ],
)
def test_damaged_instance_file_is_refused_by_name(tmp_path, content: bytes) -> None:
    path = tmp_path / "damaged.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"damaged\.json"):
        read_instance(path)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"tours": 3}', '{"tours": [3]}', '{"tours": [[0, 1.0, 0]]}'])
def test_damaged_tours_file_is_refused_by_name(tmp_path, content: str) -> None:
    path = tmp_path / "damaged.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=r"damaged\.json"):
        read_tours(path)


@pytest.mark.parametrize("read", [read_instance, read_tours])
def test_a_missing_file_is_named(tmp_path, read) -> None:
    with pytest.raises(OSError, match="nowhere"):
        read(tmp_path / "nowhere.json")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch) -> None:
    path = tmp_path / "a.json"
    old = Instance(PAIR, 1)
    write_instance(path, old)

    def full(*_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="no space"):
        write_instance(path, Instance(PAIR, 2))
    with pytest.raises(OSError, match="no space"):
        write_tours(path, [[0, 1, 0]])
    monkeypatch.undo()
    with pytest.raises(TypeError):
        write_tours(path, [[0, 1, 0]], what=object())
    assert read_instance(path) == old
    assert list(tmp_path.iterdir()) == [path]


# Worlds


def a_world(n_nodes: int = 4, n_agents: int = 2) -> dict[str, np.ndarray]:
    """A value for every world field."""
    return {
        "speeds": np.linspace(0.5, 1.5, n_agents),
        "service": np.arange(n_nodes) / 10,
        "appears": np.arange(n_nodes) / 5,
        "breaks": np.array([math.inf, *range(1, n_agents)]),
        "traffic": np.ones((n_agents, 3)),
    }


def test_the_fields_table_describes_every_array_of_an_instance() -> None:
    others = {"n_agents", "name", "scale"}
    assert {each.name for each in dataclasses.fields(Instance)} == others | set(FIELDS)
    assert set(a_world()) == set(WORLD_FIELDS)
    assert all(field.meaning and field.dtype == "float64" for field in FIELDS.values())


@pytest.mark.parametrize("field", WORLD_FIELDS)
def test_worlds_are_compared_hashed_pickled_written_and_batched(field: str, tmp_path) -> None:
    nodes, value = np.random.default_rng(0).random((4, 2)), a_world()[field]
    plain, world = Instance(nodes, 2), Instance(nodes, 2, **{field: value})
    assert plain != world and plain == Instance(nodes, 2) and len({plain, world, Instance(nodes, 2)}) == 2
    copy = pickle.loads(pickle.dumps(world))
    assert copy == world and not getattr(copy, field).flags.writeable
    write_instance(tmp_path / "world.json", world)
    assert read_instance(tmp_path / "world.json") == world
    problem = batch([world, world])
    assert problem.arrays[field].shape == (2, *value.shape) and problem.instance(1) == world
    with pytest.raises(ValueError, match="instance 1 has"):
        batch([world, plain])
    if field in ("speeds", "service"):
        assert 0.0 < lower_bound(world) <= makespan(world, [[0, *range(1, len(nodes)), 0], [0, 0]])
        return
    with pytest.raises(ValueError, match=rf"cannot be planned in advance in a world with \['{field}'\]"):
        lower_bound(world)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"speeds": [1.0, 0.0]}, r"speeds must be above 0, got a range of \[0, 1\]"),
        ({"speeds": [1.0]}, r"speeds must have shape \(m\) with n=4, m=2, got \(1,\)"),
        ({"speeds": [1.0, math.inf]}, r"speeds must be finite, got inf at \(1,\)"),
        ({"service": [0.0, 1.0, -1.0, 0.0]}, r"service must be at least 0, got a range of \[-1, 1\]"),
        ({"service": [0.5, 1.0, 1.0, 0.0]}, "service must be 0 at the depot, got 0.5"),
        ({"appears": [0.5, 1.0, 1.0, 0.0]}, "appears must be 0 at the depot, got 0.5"),
        ({"breaks": [1.0, 2.0]}, "breaks: at least one agent must never break down"),
        ({"breaks": [0.0, math.inf]}, r"breaks must be above 0, got a range of \[0, inf\]"),
        ({"breaks": [math.nan, math.inf]}, r"breaks must be numbers, got nan at \(0,\)"),
        ({"traffic": np.ones((2, 0))}, r"traffic must have shape \(m, K\) with n=4, m=2, got \(2, 0\)"),
        ({"traffic": -np.ones((2, 1))}, "traffic must be above 0"),
        ({"service": ["soon"] * 4}, "service must be an array of numbers"),
    ],
)
def test_bad_worlds_are_refused_with_value_and_range(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Instance(np.zeros((4, 2)), 2, **change)
