"""What a run of `boxplus lio` counts."""

from __future__ import annotations

from collections import Counter

import numpy as np

from boxplus.runs.estimate_statistics import EstimateStatistics, GapWatch
from boxplus.runs.run_facts import Gap
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate


class RunStatistics(EstimateStatistics):
    """Counts of scans, beside those of any run."""

    def __init__(self) -> None:
        super().__init__("scans")
        self.scans_read = 0
        self.rejected_points: Counter[str] = Counter()
        self.T_imu_lidar = np.eye(4)
        self._scan_gaps = GapWatch()

    def add_event(self, event: Scan | ImuSamples) -> None:
        """Count what was read."""
        if isinstance(event, Scan):
            self.scans_read += 1
            if len(event):
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

    def scan_gaps(self) -> list[Gap]:
        """Intervals between the ends of scans more than three times the usual one."""
        return self._scan_gaps.gaps(self.first_time_ns or 0) if self.first_time_ns is not None else []


def _trouble(estimate: Estimate) -> str:
    if estimate.status == "lost":
        return "had too few points on known planes for an update: the motion is only predicted"
    directions = (f"{d} ({d.information_ratio:.1f} times the information of noise)" for d in estimate.weak_directions)
    return f"was not determined by the LiDAR in its {'; '.join(directions)}"
