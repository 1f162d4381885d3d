"""Apply a kernel over the leading axes of an array: the shared shell of all batch-first functions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError

_FLOATS = np.dtype(np.float64)


def as_batch(name: str, values: ArrayLike, tail: tuple[int, ...]) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """View `values` as (N, *tail) float64; return it with the leading shape to restore.

    Raises:
        InputError: the trailing axes are not `tail`.
    """
    array = values if type(values) is np.ndarray and values.dtype is _FLOATS else as_floats(values, name)
    if array.shape[array.ndim - len(tail) :] != tail or array.ndim < len(tail):
        shape = ", ".join(["...", *map(str, tail)])
        raise InputError(f"{name} of shape ({shape})", f"shape {array.shape}", f"put the {'×'.join(map(str, tail))} values last")
    lead = array.shape[: array.ndim - len(tail)]
    if len(lead) == 1 and array.flags.c_contiguous:
        return array, lead
    return np.ascontiguousarray(array).reshape(-1, *tail), lead


def map_batch(
    kernel: Callable[[NDArray[np.float64], NDArray[np.float64]], None],
    name: str,
    values: ArrayLike,
    tail_in: tuple[int, ...],
    tail_out: tuple[int, ...],
) -> NDArray[np.float64]:
    """Run `kernel(in, out)` over the batch (..., *tail_in) and return (..., *tail_out)."""
    batch, lead = as_batch(name, values, tail_in)
    out = np.zeros((len(batch), *tail_out))
    kernel(batch, out)
    return out.reshape(lead + tail_out)


def pair_rows(
    name_a: str, a: ArrayLike, tail_a: int, name_b: str, b: ArrayLike, tail_b: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, ...]]:
    """Both arrays as rows (N, tail) over their common leading shape, and that shape.

    Raises:
        InputError: wrong trailing axes, or leading axes that do not broadcast.
    """
    rows_a, lead_a = as_batch(name_a, a, (tail_a,))
    rows_b, lead_b = as_batch(name_b, b, (tail_b,))
    if lead_a == lead_b:
        return rows_a, rows_b, lead_a
    try:
        lead = np.broadcast_shapes(lead_a, lead_b)
    except ValueError:
        raise InputError(
            f"{name_a} and {name_b} with leading axes that broadcast",
            f"{lead_a} and {lead_b}",
            "give one row of each, or the same number of rows",
        ) from None
    rows_a = np.ascontiguousarray(np.broadcast_to(rows_a.reshape(*lead_a, tail_a), (*lead, tail_a))).reshape(-1, tail_a)
    rows_b = np.ascontiguousarray(np.broadcast_to(rows_b.reshape(*lead_b, tail_b), (*lead, tail_b))).reshape(-1, tail_b)
    return rows_a, rows_b, lead


def map_pairs(
    kernel: Callable[[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], None],
    name_a: str,
    a: ArrayLike,
    size_a: int,
    name_b: str,
    b: ArrayLike,
    size_b: int,
    size_out: int,
) -> NDArray[np.float64]:
    """Run `kernel(a, b, out)` over rows (..., size_a) and (..., size_b), broadcast against each other."""
    rows_a, rows_b, lead = pair_rows(name_a, a, size_a, name_b, b, size_b)
    out = np.empty((len(rows_a), size_out))
    kernel(rows_a, rows_b, out)
    return out.reshape((*lead, size_out))
