"""The few array operations in which NumPy and torch differ, so that ``rules.py`` reads the same for both.

Everything else in the rules is the Python array API. What is quick in one library is slow in the other, or missing from
the standard: NumPy with one row (the PettingZoo environment) is fastest with slices, NumPy with many rows with flat
indices, torch (eagerly on a GPU, or compiled) with ``gather`` and ``where``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from array_api_compat import array_namespace, device

from mtsp_env.instance import Array

Place = Any
"""Where row b's entry lies in an array (B, k, ...): an int (NumPy, B = 1), flat indices (B,), or (B, 1) in torch."""

_NUMPY = array_namespace(np.empty(0)), "cpu"
_NAMESPACES: dict[type, Any] = {}  # by type of array; array_namespace takes longer than what is done with the answer


def library(array: Array) -> tuple[Any, Any]:
    """The array's (namespace, device)."""
    if type(array) is np.ndarray:
        return _NUMPY
    if type(array) not in _NAMESPACES:
        _NAMESPACES[type(array)] = array_namespace(array)
    return _NAMESPACES[type(array)], device(array)


def locate(column: Array, width: int) -> Place:
    """Where ``pick`` and ``put`` find row b's entry ``column[b]`` (B,) of arrays (B, width, ...)."""
    if type(column) is not np.ndarray:
        return column[:, None]
    return int(column[0]) if len(column) == 1 else column + _offsets(len(column), width)


def pick(array: Array, place: Place) -> Array:
    """(B, ...) The entries of an array (B, k, ...) at ``place``."""
    if type(array) is not np.ndarray:
        index = place if array.ndim == 2 else place[:, :, None].expand(-1, -1, array.shape[2])
        return array.gather(1, index)[:, 0]
    if type(place) is int:
        return array[:, place]
    return array.take(place) if array.ndim == 2 else array.reshape(-1, array.shape[2]).take(place, axis=0)


def pick_many(array: Array, columns: Array) -> Array:
    """(B, m, ...) Row b's entries ``columns[b]``, with ``columns`` (B, m), of an array (B, k, ...)."""
    if type(array) is not np.ndarray:
        return array.gather(1, columns if array.ndim == 2 else columns[:, :, None].expand(-1, -1, array.shape[2]))
    if len(array) == 1:
        return array.take(columns[0], axis=1)
    places = columns + _offsets(len(array), array.shape[1])[:, None]
    return array.take(places) if array.ndim == 2 else array.reshape(-1, array.shape[2]).take(places, axis=0)


def put(array: Array, place: Place, value: Array) -> Array:
    """A copy of an array (B, k) whose entries at ``place`` are ``value`` (B,)."""
    if type(array) is not np.ndarray:
        return library(array)[0].where(indices(array, axis=1) == place, value[:, None], array)
    array = array.copy()
    if type(place) is int:
        array[:, place] = value
    else:
        array.reshape(-1)[place] = value
    return array


def minus(points: Array, origin: Array) -> Array:
    """(B, k, 2) Points (B, k, 2), float32, as seen from row b's origin (B, 2)."""
    if type(points) is not np.ndarray:
        return points - origin[:, None]
    if len(points) == 1:
        return points - origin
    # As complex numbers: NumPy's loop then runs along k, not along an axis of two
    difference = points.view(np.complex64)[..., 0] - origin.view(np.complex64)
    return difference.view(np.float32).reshape(points.shape)


def append(points: Array, values: Array) -> Array:
    """(B, k, 3) Points (B, k, 2) with ``values`` (B, k) as their third component, in the points' dtype."""
    if type(points) is not np.ndarray:
        xp, _ = library(points)
        return xp.concat([points, xp.astype(values, points.dtype)[:, :, None]], axis=2)
    joined = np.empty((*values.shape, 3), points.dtype)
    joined[..., :2] = points
    joined[..., 2] = values
    return joined


def cast(array: Array, dtype: str) -> Array:
    """The array in the dtype of that name, the same array if it has it already."""
    if type(array) is np.ndarray:
        return array.astype(dtype, copy=False)
    xp, _ = library(array)
    return xp.astype(array, getattr(xp, dtype), copy=False)


def at_least(array: Array, low: float) -> Array:
    """The array with everything below ``low`` raised to it."""
    return np.maximum(array, low) if type(array) is np.ndarray else array.clamp(min=low)


def at_most(array: Array, high: float) -> Array:
    """The array with everything above ``high`` lowered to it."""
    return np.minimum(array, high) if type(array) is np.ndarray else array.clamp(max=high)


def norm(vector: Array) -> Array:
    """(...) Lengths of the vectors (..., 2)."""
    square = vector * vector
    return library(vector)[0].sqrt(square[..., 0] + square[..., 1])


def indices(array: Array, axis: int) -> Array:
    """(array.shape[axis],) int64: 0, 1, 2, ... on the array's device; only to be read."""
    if type(array) is np.ndarray:
        return _offsets(array.shape[axis], 1)
    xp, on = library(array)
    return xp.arange(array.shape[axis], device=on)


@lru_cache(maxsize=64)
def _offsets(count: int, width: int) -> np.ndarray:
    """(count,) int64: 0, width, 2 width, ...; shared by all callers, only to be read."""
    return np.arange(count) * width
