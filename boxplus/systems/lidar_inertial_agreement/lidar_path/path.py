"""The path of a LiDAR, as it has been found: poses with what the scans say of them, and the words for poses and motions."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState, P, R

_OF_POSES = ("time_ns", "R_path_lidar", "p_path_lidar", "information", "segment", "weak", "misfit", "cost")


Poses = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]
"""Times (K,) [ns], attitudes (K, 3, 3) and positions (K, 3) [m] of the LiDAR, in any frame."""


@dataclass(frozen=True, slots=True)
class LidarPath:
    """Poses of the LiDAR at the middles of scans. Where a registration failed a new segment begins, without a tie.

    Attributes:
        time_ns: (K,) int64.
        R_path_lidar: (K, 3, 3) float64; p_path_lidar: (K, 3) float64 [m]; the path's frame is the first pose of the segment.
        information: (K, 6, 6) float64 about a pose [θ about the LiDAR's axes, p along the path's]; nothing along what the scene
            does not determine. The first pose of a segment defines its frame and has none.
        segment: (K,) int64.
        weak: (K,) bool, whether the scene left a direction undetermined.
        misfit: (K,) float64, rms distance of the points from their planes [m].
        cost: (K,) float64, mean squared distance, points without a plane counted as far off [m²].
        failed: scans that could not be registered.
        scan_s: how long a scan lasts, over which a pose is the mean of where the LiDAR was; 0 for poses at instants [s].
    """

    time_ns: NDArray[np.int64]
    R_path_lidar: NDArray[np.float64]
    p_path_lidar: NDArray[np.float64]
    information: NDArray[np.float64]
    segment: NDArray[np.int64]
    weak: NDArray[np.bool_]
    misfit: NDArray[np.float64]
    cost: NDArray[np.float64]
    failed: int
    scan_s: float = 0.0

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def poses(self) -> Poses:
        """Times, attitudes and positions."""
        return self.time_ns, self.R_path_lidar, self.p_path_lidar

    def packed(self, k: int) -> NDArray[np.float64]:
        """The packed state (36,) of a LiDAR at the k-th pose."""
        x = NavState.identity().pack()
        x[R : R + 9], x[P : P + 3] = self.R_path_lidar[k].ravel(), self.p_path_lidar[k]
        return x

    def part(self, chosen: NDArray[np.bool_]) -> LidarPath:
        """The poses that are chosen (K,)."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in _OF_POSES})


Twist = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Turn rate (3,) [rad/s] and velocity (3,) [m/s] of the LiDAR, both in its own frame."""
