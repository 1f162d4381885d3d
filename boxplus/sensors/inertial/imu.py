"""What an IMU delivers: time-stamped angular velocity and specific force."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_array, is_array
from boxplus.errors import InputError


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """A block of IMU samples in SI units, IMU frame, in order of arrival.

    Shapes and types are checked. Values (NaN, order of time) are the sequencer's business: it counts what it rejects.

    Attributes:
        time_ns: (N,) int64, absolute time in nanoseconds.
        gyro: (N, 3) float64, angular velocity [rad/s].
        accel: (N, 3) float64, specific force [m/s²]; +9.81 upwards at rest (docs/conventions.md).

    Raises:
        InputError: wrong shape, values that are not numbers, or times that are not integers.

    Example:
        >>> samples = bp.ImuSamples.from_arrays([1_000_000_000, 1_005_000_000], np.zeros((2, 3)), [[0.0, 0.0, 9.81]] * 2)
        >>> len(samples), samples.accel[0].tolist()
        (2, [0.0, 0.0, 9.81])
    """

    time_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    accel: NDArray[np.float64]

    def __post_init__(self) -> None:
        typed = is_array(self.time_ns, np.int64, 1) and is_array(self.gyro, np.float64, 2) and is_array(self.accel, np.float64, 2)
        if not (typed and self.gyro.shape == self.accel.shape == (self.time_ns.size, 3)):
            for name, values in zip(("time_ns", "gyro", "accel"), _converted(self.time_ns, self.gyro, self.accel), strict=True):
                object.__setattr__(self, name, values)

    @classmethod
    def from_arrays(cls, time_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike) -> ImuSamples:
        """As the constructor, typed for whatever can be made an array.

        Args:
            time_ns: (N,) integers, absolute nanoseconds; a single sample may be given as a scalar.
            gyro: (N, 3) or (3,), rad/s.
            accel: (N, 3) or (3,), m/s².

        Raises:
            InputError: wrong shape, values that are not numbers, or times that are not integers.
        """
        return cls(*_converted(time_ns, gyro, accel))

    @classmethod
    def joined(cls, blocks: Iterable[ImuSamples]) -> ImuSamples:
        """Blocks one after the other, as they are; no block gives no samples."""
        blocks = list(blocks)
        if not blocks:
            return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
        return cls(
            np.concatenate([block.time_ns for block in blocks]),
            np.concatenate([block.gyro for block in blocks]),
            np.concatenate([block.accel for block in blocks]),
        )

    def where(self, which: NDArray[np.bool_] | NDArray[np.int64] | slice) -> ImuSamples:
        """Some of the samples: those of a mask, of indices, or of a slice."""
        return ImuSamples(self.time_ns[which], self.gyro[which], self.accel[which])

    def in_order(self) -> ImuSamples:
        """Those that are later than all before them: what is recorded twice, or comes late, is left out."""
        latest = np.maximum.accumulate(self.time_ns)
        return self.where(np.concatenate([[True], latest[1:] > latest[:-1]])[: len(self)])

    def __len__(self) -> int:
        return int(self.time_ns.size)


def _converted(
    time_ns: ArrayLike, gyro: ArrayLike, accel: ArrayLike
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    time = np.atleast_1d(as_array(time_ns, "time_ns"))
    if time.ndim != 1 or time.dtype.kind not in "iu":
        raise InputError(
            "time_ns as integer nanoseconds of shape (N,)",
            f"{time.dtype} of shape {time.shape}",
            "convert seconds with np.round(seconds * 1e9).astype(np.int64)",
        )
    vectors = []
    for name, values in (("gyro", gyro), ("accel", accel)):
        array = np.atleast_2d(as_array(values, name))
        if array.shape != (time.size, 3) or array.dtype.kind not in "fiu":
            raise InputError(
                f"{name} as numbers of shape ({time.size}, 3), one row per time stamp",
                f"{array.dtype} of shape {np.shape(values)}",
                "give one row (x, y, z) for every entry of time_ns",
            )
        vectors.append(np.ascontiguousarray(array, dtype=np.float64))
    return np.ascontiguousarray(time, dtype=np.int64), vectors[0], vectors[1]
