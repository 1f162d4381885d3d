"""What a run of `boxplus lio` counts."""

from __future__ import annotations

from collections import Counter

import numpy as np

from boxplus._words import either
from boxplus.filtering.nav_state import T_THETA_L
from boxplus.runs.estimate_statistics import EstimateStatistics, GapWatch
from boxplus.runs.lidar_inertial.first_points import first_points_of
from boxplus.runs.run_facts import Gap, WarningFacts
from boxplus.runs.vague_pose import is_unknown, is_vague, largest_sigmas, length_text
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.start.beginning import WAITING

_VAGUE_DEG = 2.0  # of a rotation

_LATE_S = 1.0  # a start in motion may take as long, and a second without a path is not missed


class RunStatistics(EstimateStatistics):
    """Counts of scans, beside those of any run."""

    def __init__(self) -> None:
        super().__init__("scans")
        self.scans_read = 0
        self._first_scan_ns: int | None = None
        self.first_points: tuple[str | None, ...] | None = None  # digests of those of the first scan that has any
        self.rejected_points: Counter[str] = Counter()
        self.T_imu_lidar = np.eye(4)
        self._mounting_covariance = np.zeros((6, 6))
        self._position_sigma_m = self._rotation_sigma_deg = 0.0
        self._scan_gaps = GapWatch()

    def add_event(self, event: Scan | ImuSamples) -> None:
        """Count what was read."""
        if isinstance(event, Scan):
            self.scans_read += 1
            if len(event):
                if self._first_scan_ns is None:
                    self._first_scan_ns = event.end_ns
                if self.first_points is None:
                    # Of several LiDARs the first: the others may be left out of another run.
                    first = event.p_lidar if event.lidar is None else event.p_lidar[event.lidar == 0]
                    self.first_points = first_points_of(first)
                self._scan_gaps.add(np.array([event.end_ns]))
        else:
            self.add_imu(event.time_ns)

    def add(self, estimate: Estimate) -> None:
        """Count one estimate."""
        self.add_estimate(estimate.time_ns, estimate.state.p_world_imu, estimate.status, estimate.timing_s, _trouble(estimate))
        self.rejected_points.update(estimate.rejected)
        for text in estimate.warnings:
            self.warnings.add(text, estimate.time_ns)
        self.T_imu_lidar[:3, :3], self.T_imu_lidar[:3, 3] = estimate.state.R_imu_lidar, estimate.state.p_imu_lidar
        self._mounting_covariance = estimate.covariance[T_THETA_L:, T_THETA_L:]
        turn, shift = largest_sigmas(estimate.pose_covariance)
        self._rotation_sigma_deg, self._position_sigma_m = float(np.degrees(turn)), shift

    @property
    def mounting_sigma(self) -> tuple[float, float]:
        """How uncertain the last T_imu_lidar is where that is most: rotation [deg] and translation [m]."""
        turn, arm = largest_sigmas(self._mounting_covariance)
        return float(np.degrees(turn)), arm

    def vague_warnings(self, mounting_sigma: tuple[float, float] | None) -> list[WarningFacts]:
        """A warning where the run ends at a pose that it does not claim to know, with what may be behind it.

        Args:
            mounting_sigma: how uncertain T_imu_lidar was at first, rotation [deg] and translation [m]; None where it is taken for
                exact.
        """
        text = self._told_of_pose(mounting_sigma)
        return [] if text is None else [WarningFacts(text=text, count=1)]

    def unknown_position(self, mounting_sigma: tuple[float, float] | None) -> str | None:
        """The same where the position is so little known that the run is not to be trusted."""
        return self._told_of_pose(mounting_sigma) if is_unknown(self._position_sigma_m, self.path_length_m) else None

    def _told_of_pose(self, mounting_sigma: tuple[float, float] | None) -> str | None:
        little = []
        if is_vague(self._position_sigma_m, self.path_length_m):
            little.append(f"position to {length_text(self._position_sigma_m)}")
        if self._rotation_sigma_deg > _VAGUE_DEG:
            little.append(f"rotation to {self._rotation_sigma_deg:.1f} deg")
        if not little:
            return None
        open_scans, why = self.count - self.status["ok"], []
        if mounting_sigma is not None:
            turn, arm = mounting_sigma
            why.append(f"T_imu_lidar was known to {turn:.2g} deg and {arm * 100:.2g} cm at first (better: --T-imu-lidar)")
        if open_scans:
            why.append(f"{open_scans} of {self.count} scans left directions open")
        return (
            f"by its own covariance the run knows its last {' and its last '.join(little)} (1 sigma) only, after a "
            f"way of {length_text(self.path_length_m)}: {', and '.join(why) or 'its start, its IMU and what it saw tell no more'}"
        )

    def late_start_warnings(self, unstarted: int, refusal: str | None) -> list[WarningFacts]:
        """A warning where the path begins more than a second later than what was read.

        Args:
            unstarted: scans that were left without a pose, as no start could be found that early.
            refusal: why the last of them was none, a sentence.
        """
        advice = "let a recording start at rest, or where walls are near"
        refusal = refusal and refusal.removesuffix(WAITING)
        return self.told_of_late_start(unstarted, self.scans_read, self._first_scan_ns, _LATE_S, advice, refusal)

    def repeated_warnings(self, repeated: int) -> list[WarningFacts]:
        """A warning where scans came again with new stamps."""
        if not repeated:
            return []
        text = (
            f"{repeated} of the {self.scans_read} scans that were read {either(repeated, 'has', 'have')} all points of the one "
            f"before, with new stamps, and {either(repeated, 'was', 'were')} left out: a driver delivers it again"
        )
        return [WarningFacts(text=text, count=repeated)]

    def scan_gaps(self) -> list[Gap]:
        """Intervals between the ends of scans more than three times the usual one."""
        return self._scan_gaps.gaps(self.first_time_ns or 0) if self.first_time_ns is not None else []


def _trouble(estimate: Estimate) -> str:
    if estimate.status == "lost":
        return "had too few points on known planes for an update: the motion is only predicted"
    directions = (f"{d} ({d.information_ratio:.1f} times the information of noise)" for d in estimate.weak_directions)
    return f"was not determined by the LiDAR in its {'; '.join(directions)}"
