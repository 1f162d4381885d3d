"""What the LiDAR corrects of the velocity, summed up: single corrections of a wrong accelerometer are small, and all alike.

A Kalman filter's corrections K (z − h) are uncorrelated from update to update, each with the covariance P⁻ − P⁺ by which it
makes the state surer (Kailath, IEEE Trans. Automatic Control 13, 1968: the innovations are white). So the sum of those of the
velocity over a second has the covariance Σ (P⁻ − P⁺), however little a single scan says against a good IMU. An accelerometer
of the wrong sign or scale, or one that is not of this platform, pushes to the same side scan after scan.

So does a lever that is not known yet, and no scan more than another: a mounting that is off by δ moves the velocity by B δ, and
what the corrections take off it adds up to D δ, D = Σ (B⁻ − B⁺), which has the covariance D Σ_T Dᵀ beside (`unknown_mounting`).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import T_V
from boxplus.filtering.small_linalg import symmetric_eigen_into
from boxplus.systems.lidar_inertial_odometry.mounted_update import MountedUpdate
from boxplus.systems.lidar_inertial_odometry.mounting.unknown_mounting import MOUNTING

_WINDOWS_S = 1.0, 2.0
_SIGMAS = 7.0  # √(Sᵀ C⁻¹ S) of a sum S: 4.4 at most in 40 sound runs, simulated and real, 8 to 77 with a flipped sign
_FLOOR = 0.02  # m/s of a sum: what no model knows
_SLACK_S = 1e-3


@dataclass(frozen=True, slots=True)
class _Sums:
    """What had come together before the scan that ends at `at_s`, of corrections, covariances and D; and Σ_T then."""

    at_s: float
    corrections: NDArray[np.float64]
    covariance: NDArray[np.float64]
    moved: NDArray[np.float64]
    mounting: NDArray[np.float64]


class Corrections:
    """Follows the updates of one run."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin anew, where the IMU did not predict what was corrected."""
        self._before: deque[_Sums] = deque()
        self._sum, self._covariance, self._moved = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 6))

    def update(self, time_ns: int, correction: NDArray[np.float64], update: MountedUpdate) -> str | None:
        """Take a scan's correction; a sentence where those of the last seconds are more than noise explains.

        Args:
            time_ns: end of the scan.
            correction: (24,) posterior ⊟ prior.
            update: by which it came.
        """
        now, v = time_ns * 1e-9, slice(T_V, T_V + 3)
        self._before.append(_Sums(now, self._sum, self._covariance, self._moved, update.cov_prior[MOUNTING, MOUNTING].copy()))
        self._sum = self._sum + correction[v]
        self._covariance = self._covariance + (update.cov_prior[v, v] - update.cov[v, v])
        self._moved = self._moved + (update.B_prior[v] - update.B[v])
        while len(self._before) > 1 and now - self._before[1].at_s > _WINDOWS_S[-1] - _SLACK_S:
            self._before.popleft()
        sigmas, seconds, size = max(self._over(now, window) for window in _WINDOWS_S)
        if sigmas < _SIGMAS:
            return None
        return (
            f"within {seconds:.1f} s the LiDAR has corrected the velocity by {size:.2f} m/s, mostly to one side, "
            f"{sigmas:.0f} standard deviations of what noise adds up to: the sign, the scale or the axes of the accelerometer, "
            "the unit of the points, T_imu_lidar or the clocks are wrong, the IMU is not the one of this LiDAR (see 'boxplus "
            "inspect'), or most of what is seen moves"
        )

    def _over(self, now: float, window: float) -> tuple[float, float, float]:
        """The sum of the last seconds: by how many standard deviations it is off, over which time [s], and its length [m/s]."""
        begin = next((sums for sums in reversed(self._before) if now - sums.at_s > window - _SLACK_S), None)
        if begin is None:
            return 0.0, 0.0, 0.0
        total = self._sum - begin.corrections
        sigmas = _deviations(total, self._covariance - begin.covariance, self._moved - begin.moved, begin.mounting)
        return sigmas, now - begin.at_s, math.hypot(*total.tolist())


@kernel
def _deviations(
    total: NDArray[np.float64], covariance: NDArray[np.float64], moved: NDArray[np.float64], mounting: NDArray[np.float64]
) -> float:
    """√(sᵀ C⁻¹ s) of a sum s (3,), C = `covariance` (3, 3) + D Σ_T Dᵀ with D (3, 6) and Σ_T (6, 6), and the floor."""
    C, values, axes = covariance.copy(), np.empty(3), np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(6):
                for m in range(6):
                    C[i, j] += moved[i, k] * mounting[k, m] * moved[j, m]
    symmetric_eigen_into(C, values, axes)
    squared = 0.0
    for axis in range(3):
        along = axes[0, axis] * total[0] + axes[1, axis] * total[1] + axes[2, axis] * total[2]
        squared += along * along / (max(values[axis], 0.0) + _FLOOR**2)
    return math.sqrt(squared)
