"""What comes in as IMU samples, intervals and biases, or is refused."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats, as_numbers
from boxplus.errors import InputError


def rows_of(name: str, values: ArrayLike, count: int, size: int) -> NDArray[np.float64]:
    """`values` (size,) or (count, size) as (count, size).

    Raises:
        InputError: another shape.
    """
    array = as_floats(values, name)
    if array.shape not in ((size,), (count, size)):
        raise InputError(
            f"{name} of shape ({size},) or ({count}, {size})", f"shape {array.shape}", "give one row for each interval"
        )
    return np.broadcast_to(array, (count, size))


def checked_samples(
    time_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    time = as_numbers(time_ns, "time_ns (S,)")
    if time.ndim != 1 or time.dtype.kind not in "iu":
        raise InputError(
            "time_ns as integer nanoseconds of shape (S,)",
            f"{time.dtype} of shape {time.shape}",
            "convert seconds with np.round(seconds * 1e9).astype(np.int64)",
        )
    if time.size < 2:
        raise InputError("at least two IMU samples", f"{time.size}", "an interval without motion data gives no factor")
    time = np.ascontiguousarray(time, dtype=np.int64)
    ordered = time[1:] > time[:-1]
    if not ordered.all():
        k = int(np.argmin(ordered)) + 1
        raise InputError(
            "time_ns strictly increasing", f"{time[k]} after {time[k - 1]} at sample {k}", "sort the samples, drop doubles"
        )
    vectors = []
    for name, values in (("gyro", gyro), ("accel", accel)):
        array = np.ascontiguousarray(as_floats(values, f"{name} (S, 3)"))
        if array.shape != (time.size, 3):
            raise InputError(f"{name} of shape ({time.size}, 3)", f"shape {array.shape}", "give one row for every time stamp")
        if not np.isfinite(array).all():
            k = int(np.argmin(np.isfinite(array).all(axis=1)))
            raise InputError(f"{name} finite", f"{array[k]} at sample {k}", "drop that sample")
        vectors.append(array)
    return time, vectors[0], vectors[1]


def checked_intervals(intervals_ns: ArrayLike, time: NDArray[np.int64]) -> NDArray[np.int64]:
    intervals = np.atleast_2d(as_numbers(intervals_ns, "intervals_ns"))
    if intervals.ndim != 2 or intervals.shape[1] != 2 or intervals.dtype.kind not in "iu":
        raise InputError(
            "intervals_ns as integer nanoseconds of shape (N, 2)",
            f"{intervals.dtype} of shape {np.shape(intervals)}",
            "give begin and end of every interval",
        )
    intervals = np.ascontiguousarray(intervals, dtype=np.int64)
    lasts = intervals[:, 1] > intervals[:, 0]
    if not lasts.all():
        n = int(np.argmin(lasts))
        raise InputError("intervals that end after they begin", f"{intervals[n]} in interval {n}", "order the keyframes by time")
    covered = (intervals[:, 0] >= time[0]) & (intervals[:, 1] <= time[-1])
    if not covered.all():
        n = int(np.argmin(covered))
        raise InputError(
            f"intervals within the samples, {time[0]} to {time[-1]} ns",
            f"{intervals[n]} in interval {n}",
            "leave out keyframes without IMU samples on both sides",
        )
    return intervals


def checked_bias(name: str, bias: ArrayLike, count: int) -> NDArray[np.float64]:
    array = as_floats(bias, name)
    if array.shape not in ((3,), (count, 3)) or not np.isfinite(array).all():
        raise InputError(
            f"{name} finite, of shape (3,) or ({count}, 3)",
            f"{array.shape} {array.ravel()[:3]}",
            "give one bias for each interval",
        )
    return np.array(np.broadcast_to(array, (count, 3)), order="C")  # the layout that the kernels are compiled for
