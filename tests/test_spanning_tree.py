"""The spanning tree's length: by Prim's algorithm and by way of the triangulation, which must agree."""

import sys

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mtsp_env import spanning_tree
from mtsp_env.spanning_tree import TRIANGULATE_FROM, spanning_tree_length

N_LARGE = TRIANGULATE_FROM + 500


def many(shape: str) -> np.ndarray:
    """``N_LARGE`` nodes."""
    rng = np.random.default_rng(0)
    nodes = rng.random((N_LARGE, 2))
    along = np.linspace(0, 1, N_LARGE)
    return {
        "uniform": nodes,
        "lattice": rng.integers(0, 20, (N_LARGE, 2)) / 20,
        "clusters": rng.random((5, 2))[rng.integers(0, 5, N_LARGE)] * 0.9 + nodes * 0.01,
        "line": rng.permutation(np.stack([along, 0.3 * along + 0.2], axis=1)),
        "upright line": rng.permutation(np.stack([0 * along, along], axis=1)),
        "one place": np.full((N_LARGE, 2), 0.25),
        "two places": np.repeat([[0.0, 0.5], [0.5, 0.5]], N_LARGE // 2 + 1, axis=0)[:N_LARGE],
    }[shape]


@pytest.mark.parametrize("shape", ["uniform", "lattice", "clusters", "line", "upright line", "one place", "two places"])
def test_both_ways_agree(monkeypatch, shape: str) -> None:
    pytest.importorskip("scipy", reason="needs the extra reference")
    nodes = many(shape)
    with monkeypatch.context() as patch:
        patch.setattr(spanning_tree, "_prim", lambda nodes: pytest.fail("took O(n^2) time"))
        length = spanning_tree_length(nodes)
    for module in ("scipy.sparse", "scipy.sparse.csgraph", "scipy.spatial"):
        monkeypatch.setitem(sys.modules, module, None)  # not installed
    assert length == pytest.approx(spanning_tree_length(nodes), rel=1e-12)


@pytest.mark.slow
@given(st.lists(st.tuples(*[st.integers(0, 8).map(lambda k: k / 8) | st.floats(0, 1)] * 2), min_size=2, max_size=30))
@example([(0.0, 0.0), (0.0, 1e-135), (0.125, 0.0)])  # all but on a line, along which sorting by y does not lead
@settings(max_examples=200, deadline=None)
def test_the_triangulation_is_never_longer_than_the_tree(points: list) -> None:
    """It may be shorter by the lengths that its rounding cannot tell from 0."""
    pytest.importorskip("scipy", reason="needs the extra reference")
    nodes = np.array(points)
    within, tree = spanning_tree._within_triangulation(nodes), spanning_tree._prim(nodes)
    assert tree - 1e-6 <= within <= tree + 1e-12


def test_a_square_by_hand() -> None:
    assert spanning_tree_length(np.array([[0.0, 0.0], [0.0, 1.0], [1.0, 1.0], [1.0, 0.0]])) == 3.0
