"""Arrays as they are given by a user: real numbers in a rectangle, or an error that says what came instead."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError

_KINDS = {
    "c": "complex numbers",
    "O": "Python objects",
    "U": "text",
    "S": "bytes",
    "M": "dates",
    "m": "durations",
    "V": "records",
}


def as_numbers(values: ArrayLike, what: str) -> NDArray[Any]:
    """`values` as an array of integers, floats or booleans, of whatever shape.

    Raises:
        InputError: rows of different lengths, complex numbers, text, dates, objects.
    """
    array = as_array(values, what)
    if array.dtype.kind not in "fiub":
        got = _KINDS.get(array.dtype.kind, "something else")
        raise InputError(f"{what} as real numbers", f"{got} ({array.dtype})", "convert them to floats first")
    return array


def as_floats(values: ArrayLike, what: str) -> NDArray[np.float64]:
    """`values` in float64, of whatever shape; Python objects where each of them is a number.

    Raises:
        InputError: as `as_numbers`.
    """
    array = as_array(values, what)
    if array.dtype.kind == "O":
        try:
            return array.astype(np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"{what} as real numbers", f"Python objects: {error}", "convert them to floats first") from None
    return as_numbers(array, what).astype(np.float64, copy=False)


def is_finite(value: object) -> bool:
    """Whether it is one real number, neither NaN nor infinite; text, arrays with axes and None are none."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    try:
        return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)
    except OverflowError:  # an integer beyond all floats
        return False


def is_array(values: object, dtype: type, axes: int) -> bool:
    """Whether it is what kernels are compiled for: of this type and number of axes, in one piece."""
    return isinstance(values, np.ndarray) and values.dtype == dtype and values.ndim == axes and values.flags.c_contiguous


def as_array(values: ArrayLike, what: str) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except (TypeError, ValueError) as error:  # NumPy says where the shape breaks
        raise InputError(f"{what} as an array of numbers", f"something else: {error}", "give rows of equal length") from None
