"""Apply a kernel over the leading axes of an array: the shared shell of all batch-first functions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError


def as_batch(name: str, values: ArrayLike, tail: tuple[int, ...]) -> tuple[NDArray[np.float64], tuple[int, ...]]:
    """View `values` as (N, *tail) float64; return it with the leading shape to restore.

    Raises:
        InputError: the trailing axes are not `tail`.
    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape[array.ndim - len(tail) :] != tail or array.ndim < len(tail):
        shape = ", ".join(["...", *map(str, tail)])
        raise InputError(f"{name} of shape ({shape})", f"shape {array.shape}", f"put the {'×'.join(map(str, tail))} values last")
    lead = array.shape[: array.ndim - len(tail)]
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
