"""Read TSPLIB 95 files with coordinates, through vrplib, into instances in the unit square.

Lengths are real numbers in the file's units. TSPLIB rounds every edge to a whole number, so its published optima differ
from lengths here by up to half a unit per edge (EUC_2D) or one unit per edge (the others).
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from mtsp_env.checks import check_count
from mtsp_env.instance import Instance, from_coordinates
from mtsp_env.reading import read_file

EARTH_RADIUS = 6378.388  # km, as in TSPLIB 95
EDGE_WEIGHT_TYPES = ("EUC_2D", "CEIL_2D", "ATT", "GEO")


def read_tsplib(path: str | os.PathLike, n_agents: int) -> Instance:
    """Read a symmetric TSP from a TSPLIB file. The first node becomes the depot; ``scale`` keeps the file's units.

    - EUC_2D, CEIL_2D: straight-line lengths, not rounded.
    - ATT: TSPLIB's pseudo-Euclidean length sqrt((dx^2 + dy^2) / 10), not rounded.
    - GEO: kilometres. Latitude and longitude are read as DDD.MM, degrees and minutes (not decimals), and projected by
      ``project``. Lengths are exact on lines through the centroid of the nodes, and a little too long elsewhere:
      compared with TSPLIB's unrounded great-circle formula, by at most 1.5 % and on average 0.11 % over all pairs of
      cities of ``examples/europe.tsp``.

    Args:
        path: the file. Its node numbers are not used: row k of NODE_COORD_SECTION, from 0, is node k.
        n_agents: m, at least 1; TSPLIB has no field for it.

    Raises:
        ImportError: vrplib is not installed.
        OSError: the file cannot be read.
        ValueError: n_agents is below 1, or the file is not a supported TSPLIB file; the message names the file and
            says what is allowed.
    """
    check_count("n_agents", n_agents, minimum=1)
    path = Path(path)
    fields = _parse(read_file(path).decode("utf-8-sig", errors="replace"), path)  # old files have Latin-1 comments
    try:
        kind = _check_fields(fields)
        name = str(fields.get("name", "")).strip() or path.stem
        return from_coordinates(_planar(kind, _coordinates(fields)), n_agents, name)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _parse(text: str, path: Path) -> dict[str, Any]:
    """The file's specifications and sections as vrplib reads them: keys in lower case, without node numbers."""
    try:
        from vrplib.parse import parse_vrplib
    except ImportError as error:
        raise ImportError('reading TSPLIB files needs vrplib: pip install "mtsp-env[tsplib]"') from error
    try:
        return parse_vrplib(text, compute_edge_weights=False)
    except Exception as error:  # on invalid files vrplib raises many types of error
        raise ValueError(
            f"{path}: not a TSPLIB file with EDGE_WEIGHT_TYPE {_listed()} and a NODE_COORD_SECTION "
            f"({type(error).__name__}: {error})"
        ) from error


def _check_fields(fields: dict[str, Any]) -> str:
    """The EDGE_WEIGHT_TYPE of a supported file.

    Raises:
        ValueError: the file is not a TSP, or it has constraints that are not supported.
    """
    kind = fields.get("edge_weight_type")
    if kind not in EDGE_WEIGHT_TYPES:
        given = "no EDGE_WEIGHT_TYPE" if kind is None else f"EDGE_WEIGHT_TYPE {str(kind)[:40]!r}"
        raise ValueError(f"{given}; allowed are {_listed()}")
    if str(fields.get("type", "TSP")).split()[:1] != ["TSP"]:  # in some files a name follows
        raise ValueError(f"TYPE {str(fields['type'])[:40]!r}; allowed is TSP")
    if "fixed_edges" in fields:
        raise ValueError("FIXED_EDGES_SECTION is not supported: tours may use any edge")
    if "depot" in fields and np.asarray(fields["depot"]).tolist() != [0]:
        raise ValueError("DEPOT_SECTION must name node 1: the first node is the depot")
    return kind


def _coordinates(fields: dict[str, Any]) -> np.ndarray:
    """The coordinates as given in the file, float64 (n, 2)."""
    if "node_coord" not in fields:
        raise ValueError("no NODE_COORD_SECTION: only instances with coordinates are supported")
    try:
        xy = np.array(fields["node_coord"], dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        xy = np.empty(0)
    if xy.ndim != 2 or xy.shape[1] != 2:
        raise ValueError("every row of NODE_COORD_SECTION must be a node number and two coordinates")
    dimension = fields.get("dimension")
    if dimension != len(xy):
        raise ValueError(f"DIMENSION must be the number of nodes, {len(xy)}, got {dimension!r}")
    if not np.isfinite(xy).all():
        node = int(np.argwhere(~np.isfinite(xy))[0, 0])
        raise ValueError(f"coordinates must be finite, got {xy[node].tolist()} in row {node + 1}")
    return xy


def _planar(kind: str, xy: np.ndarray) -> np.ndarray:
    """Points (n, 2) whose straight-line distances are those of the file, in the file's units."""
    if kind == "ATT":
        return xy / math.sqrt(10.0)
    if kind == "GEO":
        return project(degrees(xy))
    return xy


def degrees(ddd_mm: np.ndarray) -> np.ndarray:
    """TSPLIB's DDD.MM (degrees and minutes) as decimal degrees.

    The TSPLIB 95 report rounds DDD.MM to get the degrees. Its published optima are computed with the fraction cut off,
    as it is here. Minutes above 59 are not an error: the file ali535 has some.
    """
    whole = np.trunc(ddd_mm)
    return whole + (ddd_mm - whole) / 0.6


def project(latlon: np.ndarray) -> np.ndarray:
    """Project latitudes and longitudes (n, 2) in degrees to a plane: kilometres (n, 2), x to the east, y to the north.

    The projection is azimuthal equidistant about the centroid c of the nodes, on TSPLIB's sphere. Between nodes within
    an angle r of c, the straight line in the plane is never shorter than the great circle, and longer by at most the
    factor r / sin(r): 1.7 % within 2000 km of c, 11 % within 5000 km, 57 % within 10,000 km.

    Raises:
        ValueError: a latitude is beyond 90 degrees or a longitude beyond 360, or the nodes lie all round the globe, so
            that they have no centroid.
    """
    if np.abs(latlon[:, 0]).max() > 90 or np.abs(latlon[:, 1]).max() > 360:
        raise ValueError("GEO coordinates must be a latitude in [-90, 90] and a longitude in [-360, 360], as DDD.MM")
    latitude, longitude = np.radians(latlon).T
    sphere = np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
    )  # (n, 3)
    centre = sphere.mean(axis=0)
    if np.linalg.norm(centre) < 1e-6:
        raise ValueError("the nodes lie all round the globe and have no centroid to project about")
    centre /= np.linalg.norm(centre)

    turn = math.atan2(centre[1], centre[0])
    east = np.array([-math.sin(turn), math.cos(turn), 0.0])
    north = np.cross(centre, east)
    x, y, up = sphere @ east, sphere @ north, sphere @ centre
    across = np.hypot(x, y)  # sine of the angle to the centre; precise at any angle together with its cosine, up
    angle = np.arctan2(across, up)
    stretch = np.divide(angle, across, out=np.ones_like(across), where=across > 0)
    return EARTH_RADIUS * np.stack([x * stretch, y * stretch], axis=1)


def _listed() -> str:
    return ", ".join(EDGE_WEIGHT_TYPES)
