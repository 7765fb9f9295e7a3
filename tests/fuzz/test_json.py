"""JSON files of instances and tours: a broken one is read as it says, or refused by name."""

import json
import math

import pytest
from helpers.broken import broken
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import lower_bound
from mtsp_env.files import read_instance, read_tours

pytestmark = pytest.mark.fuzz

INSTANCE = {"name": "fuzz", "n_agents": 2, "scale": 2.0, "nodes": [[0.0, 0.0], [0.5, 1.0], [1.0, 0.25]]}
TOURS = {"tours": [[0, 1, 0], [0, 2, 0]], "makespan": 2.5}
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=8,
)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Where the tests write their files."""
    return tmp_path_factory.mktemp("fuzz") / "file.json"


def check(path, data, reader):
    """What a reader makes of ``data``; None if it refuses it by name."""
    path.write_bytes(data)
    try:
        return reader(path)
    except ValueError as error:
        assert str(path) in str(error)
        return None


def check_instance(path, data):
    instance = check(path, data, read_instance)
    if instance is not None:
        assert instance.nodes.dtype == float and type(instance.n_agents) is int
        if len(instance.arrays()) == 1:
            assert math.isfinite(lower_bound(instance) * instance.scale)


def check_tours(path, data):
    tours = check(path, data, read_tours)
    assert tours is None or all(type(node) is int for tour in tours for node in tour)


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(path, data):
    check_instance(path, data.draw(broken(json.dumps(INSTANCE).encode())))
    check_tours(path, data.draw(broken(json.dumps(TOURS).encode())))


@pytest.mark.slow
@given(field=st.sampled_from([*INSTANCE, "speeds", "service", "appears", "breaks", "traffic"]), value=VALUES)
@settings(deadline=None)
def test_any_value_of_a_field(path, field, value):
    check_instance(path, json.dumps({**INSTANCE, field: value}).encode())


@pytest.mark.slow
@given(place=st.sampled_from([(0, 0), (2, 1)]), value=VALUES)
@settings(deadline=None)
def test_any_value_of_a_coordinate(path, place, value):
    nodes = [list(node) for node in INSTANCE["nodes"]]
    nodes[place[0]][place[1]] = value
    check_instance(path, json.dumps({**INSTANCE, "nodes": nodes}).encode())


@pytest.mark.slow
@given(value=VALUES)
@settings(deadline=None)
def test_any_value_of_the_tours(path, value):
    check_tours(path, json.dumps({"tours": value}).encode())
    check_tours(path, json.dumps({"tours": [[0, value, 0]]}).encode())
