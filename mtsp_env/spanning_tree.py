"""Length of the minimum spanning tree, part of the lower bound on the makespan."""

from __future__ import annotations

import numpy as np

TRIANGULATE_FROM = 1001  # nodes from which a triangulation is faster than Prim's algorithm


def spanning_tree_length(nodes: np.ndarray) -> float:
    """Length of the minimum spanning tree of nodes (n, 2).

    From ``TRIANGULATE_FROM`` nodes on in O(n log n) time if SciPy is installed, otherwise in O(n^2); O(n) memory. The
    triangulation counts nodes that are closer than its rounding errors, about 1e-8 of the extent, as one, so the tree
    may then be a little too short.
    """
    if len(nodes) >= TRIANGULATE_FROM:
        try:
            return _within_triangulation(nodes)
        except ImportError:
            pass
    return _prim(nodes)


def _prim(nodes: np.ndarray) -> float:
    distance = np.linalg.norm(nodes - nodes[0], axis=1)  # (n,) from each node to the tree grown so far
    outside = np.ones(len(nodes), dtype=bool)
    outside[0] = False
    length = 0.0
    for _ in range(len(nodes) - 1):
        nearest = int(np.argmin(np.where(outside, distance, np.inf)))
        length += float(distance[nearest])
        outside[nearest] = False
        distance = np.minimum(distance, np.linalg.norm(nodes - nodes[nearest], axis=1))
    return length


def _within_triangulation(nodes: np.ndarray) -> float:
    """The same by way of the Delaunay triangulation, which contains the tree (Shamos & Hoey 1975)."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial import Delaunay, QhullError

    try:
        triangles = Delaunay(nodes).simplices.astype(np.int64)  # (t, 3)
    except QhullError:  # all nodes lie on a line, as far as its rounding can tell: the tree joins the line's ends
        along = nodes[:, np.ptp(nodes, axis=0).argmax()]
        return float(np.linalg.norm(nodes[along.argmax()] - nodes[along.argmin()]))
    sides = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    a, b = np.divmod(np.unique(sides[:, 0] * len(nodes) + sides[:, 1]), len(nodes))  # each side once
    length = np.linalg.norm(nodes[a] - nodes[b], axis=1)
    graph = csr_array((length, (a, b)), shape=(len(nodes), len(nodes)))
    return float(minimum_spanning_tree(graph).sum())
