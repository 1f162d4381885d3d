"""What the LiDAR corrects of the prediction, summed up: single corrections of a wrong accelerometer are small, and all alike.

A Kalman filter's corrections K (z − h) are uncorrelated from update to update, each with the covariance P⁻ − P⁺ by which it
makes the state surer (Kailath, IEEE Trans. Automatic Control 13, 1968: the innovations are white). So the sum of those of
velocity and position over a second has the covariance Σ (P⁻ − P⁺), however little a single scan says against a good IMU. An
accelerometer of the wrong sign or scale, or one that is not of this platform, pushes to the same side scan after scan.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import T_P, T_V

_WINDOWS_S = 1.0, 2.0
_SIGMAS = 8.0  # √(Sᵀ C⁻¹ S) of a sum S: 5.7 at most in 40 sound runs, simulated and real, 8.5 to 200 with a flipped sign
_FLOOR = 0.005, 0.02  # m, m/s of a sum: what no model knows
_SLACK_S = 1e-3


class Corrections:
    """Follows the updates of one run."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin anew, where the IMU did not predict what was corrected."""
        self._time_s: deque[float] = deque()
        self._sums: deque[tuple[NDArray[np.float64], NDArray[np.float64]]] = deque()
        self._vectors, self._covariances = np.zeros((2, 3)), np.zeros((2, 3, 3))

    def update(
        self,
        time_ns: int,
        correction: NDArray[np.float64],
        cov_prior: NDArray[np.float64],
        cov_posterior: NDArray[np.float64],
    ) -> str | None:
        """Take a scan's correction; a sentence where those of the last seconds are more than noise explains.

        Args:
            time_ns: end of the scan.
            correction: (24,) posterior ⊟ prior.
            cov_prior, cov_posterior: (24, 24).
        """
        now = time_ns * 1e-9
        self._time_s.append(now)
        self._sums.append((self._vectors, self._covariances))
        parts = slice(T_P, T_P + 3), slice(T_V, T_V + 3)
        self._vectors = self._vectors + np.stack([correction[part] for part in parts])
        self._covariances = self._covariances + np.stack([cov_prior[part, part] - cov_posterior[part, part] for part in parts])
        while len(self._time_s) > 1 and now - self._time_s[1] > _WINDOWS_S[-1] - _SLACK_S:
            self._time_s.popleft()
            self._sums.popleft()
        found = [self._since(now - seconds) for seconds in _WINDOWS_S]
        sigmas, begin = max(found)
        if sigmas < _SIGMAS:
            return None
        position, velocity = np.linalg.norm(self._vectors - self._sums[begin][0], axis=1)
        return (
            f"within {now - self._time_s[begin]:.1f} s the LiDAR has corrected the velocity by {velocity:.2f} m/s and the "
            f"position by {position * 100:.0f} cm, mostly to one side, {sigmas:.0f} standard deviations of what noise adds up "
            "to: the sign, the scale or the axes of the accelerometer, T_imu_lidar or the clocks are wrong, the IMU is not the "
            "one of this LiDAR (see 'boxplus inspect'), or most of what is seen moves"
        )

    def _since(self, begin_s: float) -> tuple[float, int]:
        """By how many standard deviations the sums since then are off, and at which scan they begin; 0 where it is not kept."""
        times = np.array(self._time_s)
        begin = int(np.searchsorted(times, begin_s + _SLACK_S, side="right")) - 1
        if begin < 0:
            return 0.0, 0
        vectors, covariances = self._vectors - self._sums[begin][0], self._covariances - self._sums[begin][1]
        squared = []
        for vector, covariance, floor in zip(vectors, covariances, _FLOOR, strict=True):
            values, axes = np.linalg.eigh(covariance)
            squared.append(float(((axes.T @ vector) ** 2 / (np.maximum(values, 0.0) + floor**2)).sum()))
        return float(np.sqrt(max(squared))), begin
