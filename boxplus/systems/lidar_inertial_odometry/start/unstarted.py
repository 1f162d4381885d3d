"""What a recording without a start still shows: its last scans against every known mistake (docs/agreement.md)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from boxplus.sensors.sequencer import Frame, joined_imu
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, usable
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import thinned, with_cells_for_all
from boxplus.systems.lidar_inertial_agreement.planes.plane_of_scans import tilted_plane, untilted_plane
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.start.scan_span import span_problem_of

_STRETCH_S = 4.0  # as long as the comparisons of a run: a start is sought in less, and shows less
_ENDS_AGO_S = (0.0, 2.0, 4.0)  # overlapping: a path that breaks, or knows too few attitudes, may do better two seconds on
_MOST_POINTS = 6000  # of a scan


class UnstartedScans:
    """Keeps the last seconds of the scans that no start was found with.

    Args:
        config: of the odometry.
    """

    def __init__(self, config: LioConfig) -> None:
        self._config = config
        self._frames: deque[Frame] = deque()

    def add(self, frames: Sequence[Frame]) -> int:
        """Take scans that no start will begin with, in order of time; returns how many they are."""
        self._frames.extend(replace(frame, scan=thinned(frame.scan, _MOST_POINTS)) for frame in frames)
        while self._frames and self._seconds_ago(self._frames[0]) >= _ENDS_AGO_S[-1] + _STRETCH_S:
            self._frames.popleft()
        return len(frames)

    def named(self, refusal: str | None) -> str | None:
        """Why there was no start, with what the sensors contradict; None where there was one."""
        return None if refusal is None else ". ".join([refusal, *self.contradictions()])

    def contradictions(self) -> list[str]:
        """What the sensors contradict, a sentence each: by the newest stretch that shows anything."""
        found: list[str] = []
        for end_s in _ENDS_AGO_S:
            stretch = [frame for frame in self._frames if 0.0 <= self._seconds_ago(frame) - end_s < _STRETCH_S]
            found = found or self._contradicted(stretch)
        return found

    def _seconds_ago(self, frame: Frame) -> float:
        return (self._frames[-1].scan.end_ns - frame.scan.end_ns) * 1e-9

    def _contradicted(self, frames: Sequence[Frame]) -> list[str]:
        if not frames:
            return []
        scans, imu = [frame.scan for frame in frames], joined_imu(frames)
        unit = span_problem_of(scans)
        if unit is not None:  # points put together at wrong times show no motion that anything could be compared with
            return [unit]
        T_declared = self._config.T_declared
        agreement = compare_sensors(scans, imu, self._config, T_declared=T_declared)
        found = [finding.text for finding in contradictions(agreement, T_declared)]
        if found:
            return found
        # Where no path is found, nothing of the above is decided: what every scan shows for itself is left.
        imu, registration = usable(imu), with_cells_for_all(scans, self._config)
        alone = [untilted_plane(scans, imu, registration)]
        if T_declared is not None:
            alone.append(tilted_plane(scans, imu, T_declared[:3, :3], registration))
        return [text for text in alone if text is not None]
