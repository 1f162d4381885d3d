"""How hard a LiDAR is moved: the densities of its accelerations, told by the run itself."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_odometry.motion import DOF, RATE, VELOCITY, MotionBetween

_FIRST = np.array([0.3, 3.0])  # rad²/s³, m²/s³: anything from a car to a hand
# Beyond: where the rate at the end of a scan is little tied to the turning, an error of it bends the map and comes back.
_LEAST, _MOST = np.array([0.05, 0.5]), np.array([1.0, 10.0])
_MEMORY_S = 0.5


class ObservedDensity:
    """Follows the densities from scan to scan.

    The expected square of how a velocity has changed, its estimate's covariance included (the maximisation of EM: Shumway and
    Stoffer, Journal of Time Series Analysis, 1982): without the covariance an estimate that follows too little would seem to
    show that there is little to follow.
    """

    def __init__(self) -> None:
        self._seen = _FIRST.copy()

    @property
    def value(self) -> NDArray[np.float64]:
        """(2,) of the turning [rad²/s³] and of the position [m²/s³]."""
        density: NDArray[np.float64] = np.clip(self._seen, _LEAST, _MOST)
        return density

    def update(self, motion: MotionBetween, cov: NDArray[np.float64]) -> None:
        """Look at a motion and the covariance (24, 24) of its ends."""
        change = cov[:DOF, :DOF] + cov[DOF:, DOF:] - cov[:DOF, DOF:] - cov[DOF:, :DOF]
        variances = change.diagonal()
        turning, moving = motion.last.rate - motion.first.rate, motion.last.velocity - motion.first.velocity
        squares = np.array([turning @ turning + variances[RATE].sum(), moving @ moving + variances[VELOCITY].sum()])
        now = squares / (3.0 * motion.seconds)
        self._seen = self._seen + min(motion.seconds / _MEMORY_S, 1.0) * (now - self._seen)
