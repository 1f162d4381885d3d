"""Scans seconds apart, laid upon each other at the estimated poses: what no scan shows against the one before it.

Planes that noise or the pattern of the beams has made move along with the sensor: each scan fits the map, which the last ones
have made, and the estimate is held back or pulled aside, a little with every scan. Scans seconds apart do not share the pattern.
So every few seconds the newest scan is registered to a map of a few scans only, from one baseline ago, beginning at the
estimate; both sets of scans are placed as the filter has placed them. How far the registration moves is the error that
has come up in between, but for

    C = S + D        S: covariance of this registration,   D: of the newest pose against the one a baseline ago,
                     with what an uncertain mounting adds to it (`mounting_drift`)

What it says beyond C is given to the covariance of pose and map (the positive part of δδᵀ − C), and is told where it is beyond
four standard deviations and has come to 5 cm or 0.3 deg, at once or bit by bit: less is in the covariance. Directions of the new
scan that the old ones do not determine stay where the estimate has them.

Source: docs/lidar_inertial_odometry.md, section 10.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.pose_covariance.map_datum import MapDatum
from boxplus.filtering.small_linalg import positive_part
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.registration_config import RegistrationConfig
from boxplus.systems.lidar_inertial_agreement.lidar_path.older_scans import deviations_of, register_to
from boxplus.systems.lidar_inertial_odometry.mounting.mounting_drift import MountingDrift

_BASELINE_NS = 1_250_000_000
_MAP_SCANS = 5
_TOLD = 4.0  # standard deviations of position or rotation: √(δᵀ C⁻¹ δ)
_MINDED_M, _MINDED_RAD = 0.05, math.radians(0.3)


@dataclass(frozen=True, slots=True)
class Drift:
    """What scans a baseline apart say of the motion between them.

    Attributes:
        excess: (6, 6) covariance beyond what was stated: [θ about the IMU's axes, p along the world's].
        deviations: how far the newest scan lies from where the old ones want it, in standard deviations.
        warnings: a sentence where that is beyond four, and enough to mind.
    """

    excess: NDArray[np.float64]
    deviations: float
    warnings: list[str]


class LongBaseline:
    """Follows the scans of one run.

    Args:
        config: of the odometry: noise and cells of the map.
        with_imu: whether a mounting may be at fault.
    """

    MADE_ANEW = ("_map",)  # where a run goes on

    def __init__(self, config: RegistrationConfig, *, with_imu: bool = True) -> None:
        self._config = config.model_copy(update={"threads": 1})
        self._causes = "few rings, a repeating pattern, foliage" + (", or T_imu_lidar" if with_imu else "")
        self._recent: deque[NDArray[np.float64]] = deque(maxlen=_MAP_SCANS)
        self._old: list[NDArray[np.float64]] = []
        self._laid = 0  # of the old scans, that are in the map of them
        self._map: IkdTree | None = None
        self._old_ns = 0
        self._untold = np.zeros(6)  # sum of what was beyond four standard deviations, since it was told last

    def follow(
        self,
        time_ns: int,
        x: NDArray[np.float64],
        p_lidar: NDArray[np.float32],
        p_world: NDArray[np.float64],
        datum: MapDatum,
        mounting: MountingDrift | None = None,
    ) -> Drift | None:
        """Take a scan that the filter has placed; what came out where a baseline has passed.

        Args:
            time_ns: of the state.
            x: (36,) packed state after the scan.
            p_lidar: (n, 3) the points it was measured with, LiDAR frame at `time_ns`.
            p_world: (m, 3) the points it brings to the map.
            datum: at this state; it is widened by what comes out, and marked by the scans that the next ones are compared with.
            mounting: what its uncertainty adds, marked likewise; None where it is taken for exact.
        """
        self._recent.append(p_world)
        if time_ns - self._old_ns < _BASELINE_NS and self._old:
            self._lay_down(1)  # one with each scan: no scan waits for all of them
            return None
        if len(self._recent) < _MAP_SCANS:
            return None
        seconds = (time_ns - self._old_ns) * 1e-9
        between = datum.covariance_since_mark(x)
        if mounting is not None:
            between += mounting.covariance_since_mark(x)
            mounting.mark()
        drift = self._compare(x, between, p_lidar, seconds) if self._old else None
        if drift is not None:
            datum.widen(drift.excess, x)
        self._old, self._laid, self._map, self._old_ns = list(self._recent), 0, None, time_ns
        datum.mark()
        return drift

    def _lay_down(self, scans: int) -> IkdTree:
        """The map of the old scans, with so many more of them."""
        laid = min(self._laid + scans, len(self._old))
        if self._map is None:  # new, or of a run that is gone on with
            self._map, self._laid = IkdTree(cell_size=self._config.map_cell, rebuild="inplace"), 0
        for p_world in self._old[self._laid : laid]:
            self._map.insert(p_world, downsample=True)
        self._laid = laid
        return self._map

    def _compare(
        self, x: NDArray[np.float64], between: NDArray[np.float64], p_lidar: NDArray[np.float32], seconds: float
    ) -> Drift | None:
        found = register_to(self._lay_down(len(self._old)), x, p_lidar, self._config)
        if found is None:
            return None
        delta, registration = found
        C = registration + between
        deviations = deviations_of(delta, C)
        warnings = []
        if deviations > _TOLD and self._comes_to_much(delta):
            warnings.append(
                f"scans {seconds:.3g} s apart do not fit each other as they were placed: by "
                f"{np.linalg.norm(delta[3:]) * 100:.1f} cm and {np.degrees(np.linalg.norm(delta[:3])):.2f} deg, "
                f"{deviations:.0f} standard deviations: the estimate drifts, where single scans do not show it "
                f"({self._causes}); covariance widened"
            )
        return Drift(positive_part(np.outer(delta, delta) - C), deviations, warnings)

    def _comes_to_much(self, delta: NDArray[np.float64]) -> bool:
        """Whether a drift (6,), with what went untold before it, is enough to mind."""
        self._untold += delta
        much = bool(np.linalg.norm(self._untold[:3]) > _MINDED_RAD or np.linalg.norm(self._untold[3:]) > _MINDED_M)
        if much:
            self._untold[:] = 0.0
        return much
