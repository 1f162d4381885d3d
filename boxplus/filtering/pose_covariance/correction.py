"""What a scan has done to the pose, as far as its points are believed (docs/lidar_inertial_odometry.md, section 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.degeneracy import PoseDirections, strong_covariance
from boxplus.filtering.nav_state import MEASURED
from boxplus.filtering.propagation import FOLLOWED

_POSE = slice(0, 6)
_NO_SHIFT = np.zeros(6)
_LEAST_SPREAD = 0.05  # rad, of the points about their mean direction


@dataclass(frozen=True, slots=True)
class Correction:
    """What a scan has done to the pose.

    Attributes:
        gain: (n, 6) G, how the state, the pose first, follows a shift of the scan against the map.
        noise: (n, n) covariance of the state from the noise of the points.
        alone: (6, 6) covariance of the pose from the points alone, zero along directions they do not determine.
        alone_by_weights: (6, 6) the same as the filter has it, which goes by the weights of the points, see `plane_scatter`.
        lever_arm: root mean square distance of the points [m].
        facing: (3,) mean of the unit vectors towards the points, along the IMU's axes: short where they are all around.
        deskewed: how much of what the prediction did wrong the points share that were brought to the end of the scan by it: 1, or
            less of what their weight says where their motion was guessed; 0 where none.
        renewed: (6, 6) F, of a shift of the scan before how much this one sees; None where only the share of its points is known.
    """

    gain: NDArray[np.float64]
    noise: NDArray[np.float64]
    alone: NDArray[np.float64]
    alone_by_weights: NDArray[np.float64]
    lever_arm: float
    facing: NDArray[np.float64]
    deskewed: float = 0.0
    renewed: NDArray[np.float64] | None = None

    @classmethod
    def of(
        cls,
        cov: NDArray[np.float64],
        A: NDArray[np.float64],
        directions: PoseDirections,
        facing: NDArray[np.float64],
        *,
        scatter: float = 1.0,
        shared_shift: NDArray[np.float64] = _NO_SHIFT,
        deskewed: float = 0.0,
        renewed: NDArray[np.float64] | None = None,
    ) -> Correction:
        """Of a filter.

        Args:
            cov: (24, 24) after the scan.
            A: (12, 12) information of the scan as the filter took it, with the directions of the pose it determines.
            facing: as the attribute.
            scatter: of the variance that A⁻¹ states, what the residuals of the points bear out.
            shared_shift: (6,) a shift of the pose of one standard deviation that A has in it, and no residual shows.
            deskewed, renewed: as the attributes.
        """
        gain = cov[:FOLLOWED, MEASURED] @ A
        noise = gain @ cov[MEASURED, :FOLLOWED]
        alone = strong_covariance(A, replace(directions, weak=~directions.measured))

        def borne_out(by_weights: NDArray[np.float64], shift: NDArray[np.float64]) -> NDArray[np.float64]:
            return scatter * by_weights + (1.0 - scatter) * np.outer(shift, shift)

        noise, shown = borne_out(noise, gain[:, _POSE] @ shared_shift), borne_out(alone, alone @ A[_POSE, _POSE] @ shared_shift)
        return cls(gain[:, _POSE], noise, shown, alone, directions.lever_arm, facing, deskewed, renewed)

    def share_left(self, moved: NDArray[np.float64], turned: NDArray[np.float64]) -> float:
        """Of the points compared before, the share still compared after a motion of the IMU, 0 to 1.

        Args:
            moved: (3,) [m], along any axes.
            turned: (3,) rotation vector about the IMU's axes [rad].
        """
        (fx, fy, fz), (tx, ty, tz) = self.facing.tolist(), turned.tolist()
        spread = math.sqrt(max(1.0 - (fx * fx + fy * fy + fz * fz), _LEAST_SPREAD**2))
        aside = math.hypot(ty * fz - tz * fy, tz * fx - tx * fz, tx * fy - ty * fx) / spread
        return math.exp(-math.hypot(*moved.tolist()) / self.lever_arm - aside)
