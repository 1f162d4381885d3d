"""The attitude that follows from a gyroscope alone, at any time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3


class GyroAttitude:
    """The gyroscope's integral: attitude at any time relative to the first sample."""

    def __init__(self, time_ns: NDArray[np.int64], gyro: NDArray[np.float64]) -> None:
        """Integrate (N, 3) rates [rad/s] at ascending times (N,), linear in between."""
        self._time_ns = time_ns
        self._gyro = gyro
        self._rate = 0.5 * (gyro[1:] + gyro[:-1]) if len(gyro) > 1 else gyro
        steps = self._rate * (np.diff(time_ns) * 1e-9)[:, None]
        self._sum = np.concatenate((np.zeros((1, 3)), np.cumsum(steps, axis=0)))
        self._R = np.concatenate((np.eye(3)[None], _running_product(so3.exp(steps)))) if len(steps) else np.eye(3)[None]

    def scaled(self, factor: float) -> GyroAttitude:
        """The integral of the rates times a factor."""
        return self if factor == 1.0 else GyroAttitude(self._time_ns, self._gyro * factor)

    def covers(self, time_ns: NDArray[np.int64], margin_s: float) -> NDArray[np.bool_]:
        """Which times (K,) lie within the samples, this far from their ends."""
        if not len(self._time_ns):
            return np.zeros(len(time_ns), dtype=bool)
        margin = round(margin_s * 1e9)
        covered: NDArray[np.bool_] = (time_ns >= self._time_ns[0] + margin) & (time_ns <= self._time_ns[-1] - margin)
        return covered

    def at(self, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K, 3, 3) R_first_imu: attitudes at the times (K,) in the frame of the first sample."""
        index = np.clip(np.searchsorted(self._time_ns, time_ns, side="right") - 1, 0, len(self._rate) - 1)
        since = (time_ns - self._time_ns[index])[:, None] * 1e-9
        return self._R[index] @ so3.exp(self._rate[index] * since)

    def integral(self, time_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """(K, 3) plain integrals of the rate up to the times (K,): no rotation, but right in whatever unit the rate has."""
        index = np.clip(np.searchsorted(self._time_ns, time_ns, side="right") - 1, 0, len(self._rate) - 1)
        return self._sum[index] + self._rate[index] * (time_ns - self._time_ns[index])[:, None] * 1e-9


def _running_product(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """R[0], R[0] R[1], … for (N, 3, 3), in log2(N) batches."""
    product = R.copy()
    reach = 1
    while reach < len(product):
        product[reach:] = product[:-reach] @ product[reach:]
        reach *= 2
    return product
