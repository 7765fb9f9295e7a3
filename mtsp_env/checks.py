"""Checks of arguments that every part of the project shares."""

from __future__ import annotations

import math

import numpy as np


def check_count(name: str, value: int, minimum: int) -> None:
    """Raise ValueError unless ``value`` is a whole number of at least ``minimum``."""
    if isinstance(value, (bool, np.bool_)) or not isinstance(value, (int, np.integer)) or value < minimum:
        raise ValueError(f"{name} must be a whole number of at least {minimum}, got {value!r}")


def check_seconds(name: str, value: float, unit: str = "seconds") -> None:
    """Raise ValueError unless ``value``, in ``unit``, is a finite time above 0."""
    try:
        valid = not isinstance(value, (str, bool)) and math.isfinite(value) and value > 0
    except TypeError:
        valid = False
    if not valid:
        raise ValueError(f"{name} must be a finite number of {unit} above 0, got {value!r}")
