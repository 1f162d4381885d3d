"""Counts and distributions of a run, gathered scan by scan in compact arrays (about 100 bytes a scan)."""

from __future__ import annotations

import re
from array import array
from collections import Counter

import numpy as np
from numpy.typing import NDArray

from boxplus.runs.run_summary import Distribution, Gap, WarningFacts, WeakInterval
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate

_MOST_ENTRIES = 1000
_GAP_FACTOR = 3.0
_INTERVALS_FOR_TYPICAL = 50
_NUMBER = re.compile(r"[-+]?\d+(\.\d+)?")


class GapWatch:
    """Finds intervals much longer than the usual one in a stream of times.

    Args:
        most: the longest gaps are kept, at most this many.
    """

    def __init__(self, most: int = _MOST_ENTRIES) -> None:
        self._most = most
        self._last_ns: int | None = None
        self._first: list[float] = []
        self._typical_s: float | None = None
        self._gaps: list[tuple[float, int]] = []

    def add(self, time_ns: NDArray[np.int64]) -> None:
        """Take (N,) times [ns]; those that do not move forward are passed over."""
        if not len(time_ns):
            return
        all_times = time_ns if self._last_ns is None else np.concatenate([[self._last_ns], time_ns])
        intervals = np.diff(all_times) * 1e-9
        if self._typical_s is None:
            self._first += [float(interval) for interval in intervals if interval > 0]
            if len(self._first) >= _INTERVALS_FOR_TYPICAL:
                self._typical_s = float(np.median(self._first))
        typical = self._typical_s or (float(np.median(self._first)) if self._first else np.inf)
        for index in np.flatnonzero(intervals > _GAP_FACTOR * typical):
            self._gaps.append((float(intervals[index]), int(all_times[index])))
        if len(self._gaps) > 2 * self._most:
            self._gaps = sorted(self._gaps, reverse=True)[: self._most]
        self._last_ns = int(max(time_ns.max(), self._last_ns if self._last_ns is not None else time_ns[0]))

    def gaps(self, origin_ns: int) -> list[Gap]:
        """The gaps in order of time."""
        kept = sorted(self._gaps, reverse=True)[: self._most]
        return [
            Gap(begin_s=(begin_ns - origin_ns) * 1e-9, duration_s=length)
            for length, begin_ns in sorted(kept, key=lambda gap: gap[1])
        ]


class WarningTally:
    """Counts warnings; texts that differ only in their numbers count as one, shown with the numbers of the first."""

    def __init__(self) -> None:
        self._seen: dict[str, tuple[str, int | None]] = {}
        self._counts: Counter[str] = Counter()

    def add(self, text: str, time_ns: int | None = None, count: int = 1) -> None:
        """Count one warning, at a time or about the whole run."""
        key = _NUMBER.sub("#", text)
        if key not in self._seen and len(self._seen) >= _MOST_ENTRIES:
            return
        self._seen.setdefault(key, (text, time_ns))
        self._counts[key] += count

    def facts(self, origin_ns: int | None) -> list[WarningFacts]:
        """In order of their first appearance."""
        return [
            WarningFacts(
                text=text,
                count=self._counts[key],
                first_s=None if time_ns is None or origin_ns is None else (time_ns - origin_ns) * 1e-9,
            )
            for key, (text, time_ns) in self._seen.items()
        ]


class RunStatistics:
    """What a run counts. Memory grows by about 100 bytes a scan."""

    def __init__(self) -> None:
        self.scans = 0
        self.scans_read = 0
        self.imu_samples_read = 0
        self.status: Counter[str] = Counter()
        self.rejected_points: Counter[str] = Counter()
        self.path_length_m = 0.0
        self.first_time_ns: int | None = None
        self.last_time_ns: int | None = None
        self.warnings = WarningTally()
        self.T_imu_lidar = np.eye(4)
        self._imu_gaps, self._scan_gaps = GapWatch(), GapWatch()
        self._total_ms = array("d")
        self._stages_ms: dict[str, array[float]] = {}
        self._weak: list[WeakInterval] = []
        self._previous_status = "ok"
        self._last_position: NDArray[np.float64] | None = None

    def add_event(self, event: Scan | ImuSamples) -> None:
        """Count what was read."""
        if isinstance(event, Scan):
            self.scans_read += 1
            if len(event):
                self._scan_gaps.add(np.array([event.end_ns]))
        else:
            self.imu_samples_read += len(event)
            self._imu_gaps.add(event.time_ns)

    def add(self, estimate: Estimate) -> None:
        """Count one estimate."""
        position = estimate.state.p_world_imu
        if self._last_position is not None:
            self.path_length_m += float(np.linalg.norm(position - self._last_position))
        self._last_position = position.copy()
        self.first_time_ns = estimate.time_ns if self.first_time_ns is None else self.first_time_ns
        self.last_time_ns = estimate.time_ns
        self.scans += 1
        self.status[estimate.status] += 1
        self.rejected_points.update(estimate.rejected)
        for text in estimate.warnings:
            self.warnings.add(text, estimate.time_ns)
        self.T_imu_lidar[:3, :3], self.T_imu_lidar[:3, 3] = estimate.state.R_imu_lidar, estimate.state.p_imu_lidar
        if estimate.timing_s:
            self._total_ms.append(1e3 * sum(estimate.timing_s.values()))
            for stage, seconds in estimate.timing_s.items():
                self._stages_ms.setdefault(stage, array("d")).append(1e3 * seconds)
        self._track_weakness(estimate)

    def _track_weakness(self, estimate: Estimate) -> None:
        since_s = (estimate.time_ns - (self.first_time_ns or 0)) * 1e-9
        if estimate.status != "ok":
            if estimate.status == self._previous_status and self._weak:
                last = self._weak[-1]
                self._weak[-1] = last.model_copy(update={"end_s": since_s, "scans": last.scans + 1})
            elif len(self._weak) < _MOST_ENTRIES:
                if estimate.status == "lost":
                    text = "had too few points on known planes for an update: the motion is predicted from the IMU alone"
                else:
                    text = "; ".join(
                        f"{d} ({d.information_ratio:.1f} times the information of noise)" for d in estimate.weak_directions
                    )
                    text = f"was not determined by the LiDAR in its {text}"
                self._weak.append(WeakInterval(begin_s=since_s, end_s=since_s, status=estimate.status, scans=1, text=text))
        self._previous_status = estimate.status

    def status_warnings(self) -> list[WarningFacts]:
        """One warning for each status other than ok, with its longest interval."""
        found = []
        for status in ("weak", "lost"):
            intervals = [interval for interval in self._weak if interval.status == status]
            if intervals:
                longest = max(intervals, key=lambda interval: interval.scans)
                count, when = self.status[status], f"{longest.begin_s:.1f} to {longest.end_s:.1f} s"
                text = f"{count} of {self.scans} scans are {status}; the longest stretch, from {when}, {longest.text}"
                found.append(WarningFacts(text=text, count=1, first_s=intervals[0].begin_s))
        return found

    @property
    def duration_s(self) -> float:
        """Between the first and the last estimate [s]."""
        if self.first_time_ns is None or self.last_time_ns is None:
            return 0.0
        return (self.last_time_ns - self.first_time_ns) * 1e-9

    def scan_ms(self) -> Distribution | None:
        """Of the odometry's time per scan."""
        return _distribution(self._total_ms)

    def stages_ms(self) -> dict[str, Distribution]:
        """The same by stage."""
        return {stage: found for stage, values in self._stages_ms.items() if (found := _distribution(values)) is not None}

    def imu_gaps(self) -> list[Gap]:
        """Intervals between IMU samples more than three times the usual one."""
        return self._imu_gaps.gaps(self.first_time_ns or 0) if self.first_time_ns is not None else []

    def scan_gaps(self) -> list[Gap]:
        """The same between the ends of scans."""
        return self._scan_gaps.gaps(self.first_time_ns or 0) if self.first_time_ns is not None else []

    def weak_intervals(self) -> list[WeakInterval]:
        """Successive scans with the same status other than ok."""
        return list(self._weak)


def _distribution(values: array[float]) -> Distribution | None:
    if not values:
        return None
    data = np.frombuffer(values, dtype=np.float64).copy()  # a view would keep the array from growing
    median, p99 = np.percentile(data, [50, 99])
    return Distribution(median=float(median), p99=float(p99), max=float(data.max()))
