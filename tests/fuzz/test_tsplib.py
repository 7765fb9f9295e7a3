"""TSPLIB files: a broken one is read as an instance with finite lengths, or refused by name."""

import math

import pytest
from helpers.broken import broken
from hypothesis import given, settings
from hypothesis import strategies as st

from mtsp_env import lower_bound, read_tsplib

pytest.importorskip("vrplib", reason="needs the extra tsplib")
pytestmark = pytest.mark.fuzz

WHOLE = b"""NAME : fuzz
TYPE : TSP
COMMENT : four nodes
DIMENSION : 4
EDGE_WEIGHT_TYPE : EUC_2D
NODE_COORD_SECTION
1 0 0
2 3.5e0 4
3 -10 7.25
4 1e2 -1
EOF
"""
PLACES = st.floats(width=64) | st.sampled_from(["1e308", "-1e308", "1e-320", "inf", "nan", "True", "'1'", "0x1", ""])


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Where the tests write their files."""
    return tmp_path_factory.mktemp("fuzz") / "file.tsp"


def read(path, data):
    path.write_bytes(data)
    try:
        instance = read_tsplib(path, 2)
    except ValueError as error:
        assert str(path) in str(error)
        return
    assert instance.n_nodes >= 2 and instance.nodes.min() >= 0 and instance.nodes.max() <= 1
    assert math.isfinite(lower_bound(instance) * instance.scale)


@pytest.mark.slow
@given(data=st.data())
@settings(deadline=None)
def test_broken_bytes(path, data):
    read(path, data.draw(broken(WHOLE)))


@pytest.mark.slow
@given(rows=st.lists(st.tuples(PLACES, PLACES), max_size=5), kind=st.sampled_from(["EUC_2D", "CEIL_2D", "ATT", "GEO"]))
@settings(deadline=None)
def test_any_coordinates(path, rows, kind):
    lines = [f"DIMENSION: {len(rows)}", f"EDGE_WEIGHT_TYPE: {kind}", "NODE_COORD_SECTION"]
    read(path, "\n".join([*lines, *(f"{number} {x} {y}" for number, (x, y) in enumerate(rows, 1)), "EOF"]).encode())
