"""Points, corners and bounds as they are given to an ikd-tree: checked, and rounded to float32 without changing an answer."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_array, as_floats, is_finite
from boxplus.errors import InputError


def as_points(points: ArrayLike, name: str) -> NDArray[np.float64]:
    """Points (N, 3) in float64.

    Raises:
        InputError: wrong shape or not numbers.
    """
    array = as_array(points, name)
    if array.size == 0 and array.ndim <= 2 and array.shape[-1:] in ((0,), (3,)):
        return np.empty((0, 3))
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"{name} as numbers of shape (N, 3)", f"{array.dtype} of shape {array.shape}", "give one row x, y, z per point"
        )
    return array.astype(np.float64, copy=False)


def as_corner(corner: ArrayLike, name: str) -> NDArray[np.float64]:
    """One point (3,) in float64.

    Raises:
        InputError: wrong shape or NaN.
    """
    array = as_floats(corner, name)
    if array.shape != (3,) or np.isnan(array).any():
        raise InputError(f"{name} as three numbers x, y, z", f"{array.tolist()}", "give coordinates in metres")
    return array


def round_up(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """The smallest float32 not less than each value."""
    rounded = values.astype(np.float32)
    return np.where(rounded < values, np.nextafter(rounded, np.float32(np.inf)), rounded)


def is_length(value: object) -> bool:
    """Whether it is a positive finite number [m]."""
    return is_finite(value) and float(value) > 0.0  # type: ignore[arg-type]


def round_down(value: float) -> np.float32:
    """The largest float32 not greater than a value."""
    with np.errstate(over="ignore"):
        rounded = np.float32(value)
    return np.nextafter(rounded, np.float32(-np.inf)) if float(rounded) > value else rounded
