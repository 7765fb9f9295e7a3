"""TSPLIB files with coordinates, read through vrplib and brought to the unit square."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mtsp_env.instance import Instance, from_coordinates

EARTH_RADIUS = 6378.388  # km, TSPLIB 95's


def read_tsplib(path: str | os.PathLike, n_agents: int) -> Instance:
    raise NotImplementedError
