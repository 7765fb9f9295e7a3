"""Instances and tours as JSON files."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Sequence
from typing import Any

from mtsp_env.instance import FIELDS, Instance, Tours
from mtsp_env.reading import read_file
from mtsp_env.writing import atomic_write


def write_json(path: str | os.PathLike, data: dict) -> None:
    """Write a JSON object, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(data), encoding="utf-8")


def read_json(path: str | os.PathLike, keys: Sequence[str]) -> dict:
    """Read a JSON object that has at least ``keys``.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file is no JSON object with these keys, or not a regular file.
    """
    content = read_file(path)
    try:
        data = json.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # not JSON, not text, or nested deeper than Python can read
        raise ValueError(f"{path}: not a JSON file ({error})") from error
    if not isinstance(data, dict) or not set(keys) <= data.keys():
        raise ValueError(f"{path}: expected a JSON object with the keys {list(keys)}")
    return data


def write_instance(path: str | os.PathLike, instance: Instance) -> None:
    """Write an instance as a JSON object with the keys name, n_agents, scale, nodes and those of its world fields.

    ``null`` in an array stands for infinity, which JSON does not have.
    """
    arrays = {name: _replace(array.tolist(), math.inf, None) for name, array in instance.arrays().items()}
    write_json(path, {"name": instance.name, "n_agents": instance.n_agents, "scale": instance.scale, **arrays})


def read_instance(path: str | os.PathLike, n_agents: int | None = None) -> Instance:
    """Read a file of ``write_instance``; ``n_agents``, if given, replaces the file's number of agents.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file holds no valid instance.
    """
    data = read_json(path, keys=("nodes", "n_agents"))
    arrays = {}
    for name in FIELDS:
        if data.get(name) is not None:
            may_be_infinite = FIELDS[name].high == math.inf
            arrays[name] = _replace(data[name], None, math.inf) if may_be_infinite else data[name]
    try:
        return Instance(
            n_agents=data["n_agents"] if n_agents is None else n_agents,
            name=data.get("name", ""),
            scale=data.get("scale", 1.0),
            **arrays,
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error


def _replace(values: Any, old: Any, new: Any) -> Any:
    """A copy of nested lists in which ``new`` replaces every ``old``."""
    if isinstance(values, list):
        return [_replace(value, old, new) for value in values]
    return new if values == old else values


def write_tours(path: str | os.PathLike, tours: Tours, **extra: object) -> None:
    """Write tours as a JSON object: {"tours": [[0, ..., 0], ...]}, and ``extra`` as further keys."""
    write_json(path, {"tours": [[int(node) for node in tour] for tour in tours], **extra})


def read_tours(path: str | os.PathLike) -> Tours:
    """Read the tours in a file of ``write_tours``; ``tours.check_tours`` checks whether they solve an instance.

    Raises:
        OSError: the file cannot be read.
        ValueError: the file holds no tours.
    """
    tours = read_json(path, keys=("tours",))["tours"]
    if not isinstance(tours, list) or not all(
        isinstance(tour, list) and all(type(node) is int for node in tour) for tour in tours
    ):
        raise ValueError(f"{path}: 'tours' must be a list of lists of node numbers")
    return tours
