"""Counts and distributions of any odometry run, gathered estimate by estimate in compact arrays (about 100 bytes each)."""

from __future__ import annotations

import re
from array import array
from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from boxplus._words import either
from boxplus.runs.run_facts import Distribution, Gap, WarningFacts, WeakInterval
from boxplus.sensors.inertial.imu_values import BEYOND, EMPTY, GLITCH, NOT_FINITE

_MOST_ENTRIES = 1000
_GAP_FACTOR = 3.0
_INTERVALS_FOR_TYPICAL = 50
_NO_MEASUREMENTS = {
    NOT_FINITE: "are no numbers (NaN or infinite)",
    BEYOND: "are beyond what any sensor measures",
    EMPTY: "are zero throughout",
    GLITCH: "stand out from both of their neighbours as no motion does",
}
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


class EstimateStatistics:
    """What any run counts of its estimates. Memory grows by about 100 bytes each.

    Args:
        unit: what one is for (`scans`, `frames`).
    """

    def __init__(self, unit: str) -> None:
        self.unit = unit
        self.count = 0
        self.imu_samples_read = 0
        self.status: Counter[str] = Counter()
        self.path_length_m = 0.0
        self.first_time_ns: int | None = None
        self.last_time_ns: int | None = None
        self.warnings = WarningTally()
        self._imu_gaps = GapWatch()
        self._total_ms = array("d")
        self._stages_ms: dict[str, array[float]] = {}
        self._weak: list[WeakInterval] = []
        self._previous_status = "ok"
        self._last_position: NDArray[np.float64] | None = None

    def add_imu(self, time_ns: NDArray[np.int64]) -> None:
        """Count IMU samples that were read."""
        self.imu_samples_read += len(time_ns)
        self._imu_gaps.add(time_ns)

    def add_estimate(
        self, time_ns: int, position: NDArray[np.float64], status: str, timing_s: Mapping[str, float], trouble: str
    ) -> None:
        """Count one estimate.

        Args:
            trouble: what a status other than ok means here, following "the longest stretch …".
        """
        if self._last_position is not None:
            self.path_length_m += float(np.linalg.norm(position - self._last_position))
        self._last_position = position.copy()
        self.first_time_ns = time_ns if self.first_time_ns is None else self.first_time_ns
        self.last_time_ns = time_ns
        self.count += 1
        self.status[status] += 1
        if timing_s:
            self._total_ms.append(1e3 * sum(timing_s.values()))
            for stage, seconds in timing_s.items():
                self._stages_ms.setdefault(stage, array("d")).append(1e3 * seconds)
        since_s = (time_ns - self.first_time_ns) * 1e-9
        if status != "ok":
            if status == self._previous_status and self._weak:
                last = self._weak[-1]
                self._weak[-1] = last.model_copy(update={"end_s": since_s, "count": last.count + 1})
            elif len(self._weak) < _MOST_ENTRIES:
                self._weak.append(WeakInterval(begin_s=since_s, end_s=since_s, status=status, count=1, text=trouble))
        self._previous_status = status

    def status_warnings(self) -> list[WarningFacts]:
        """One warning for each status other than ok, with its longest interval."""
        found = []
        for status in ("weak", "lost"):
            intervals = [interval for interval in self._weak if interval.status == status]
            if intervals:
                longest = max(intervals, key=lambda interval: interval.count)
                count, when = self.status[status], f"{longest.begin_s:.1f} to {longest.end_s:.1f} s"
                text = f"{count} of {self.count} {self.unit} are {status}; the longest stretch, from {when}, {longest.text}"
                found.append(WarningFacts(text=text, count=1, first_s=intervals[0].begin_s))
        return found

    def told_of_late_start(
        self, unstarted: int, read: int, first_read_ns: int | None, late_s: float, advice: str, refusal: str | None
    ) -> list[WarningFacts]:
        """A warning where the path begins later than what was read, by more than `late_s` [s].

        Args:
            unstarted: scans or frames that were left without a pose, as no start could be found that early.
            read: how many there were; the first one was at first_read_ns.
            advice: what lets a start be found sooner.
            refusal: why the last of them was none, a sentence.
        """
        if not unstarted or self.first_time_ns is None or first_read_ns is None:
            return []
        after_s = (self.first_time_ns - first_read_ns) * 1e-9
        if after_s <= late_s:
            return []
        text = (
            f"{unstarted} of the {read} {self.unit} that were read {either(unstarted, 'has', 'have')} no pose: no start was "
            f"found sooner, path and map begin {after_s:.1f} s after the first {self.unit.removesuffix('s')}; {advice}"
        )
        return [WarningFacts(text=text + (f". Just before: {refusal}" if refusal else ""), count=1)]

    def imu_warnings(self, counters: Mapping[str, int]) -> list[WarningFacts]:
        """A warning for each kind of samples that no sensor in order delivers.

        Args:
            counters: reason → rejected samples.
        """
        return [
            WarningFacts(
                text=f"{counters[reason]} of {self.imu_samples_read} IMU samples {what} and were left out: a sensor in order "
                "and its driver deliver none such",
                count=counters[reason],
            )
            for reason, what in _NO_MEASUREMENTS.items()
            if counters.get(reason)
        ]

    @property
    def duration_s(self) -> float:
        """Between the first and the last estimate [s]."""
        if self.first_time_ns is None or self.last_time_ns is None:
            return 0.0
        return (self.last_time_ns - self.first_time_ns) * 1e-9

    def estimate_ms(self) -> Distribution | None:
        """Of the odometry's time per estimate."""
        return _distribution(self._total_ms)

    def stages_ms(self) -> dict[str, Distribution]:
        """The same by stage."""
        return {stage: found for stage, values in self._stages_ms.items() if (found := _distribution(values)) is not None}

    def imu_gaps(self) -> list[Gap]:
        """Intervals between IMU samples more than three times the usual one."""
        return self._imu_gaps.gaps(self.first_time_ns or 0) if self.first_time_ns is not None else []

    @property
    def longest_imu_gap_s(self) -> float:
        """The longest of them, before the first estimate or without any too [s]; 0 without."""
        return max((gap.duration_s for gap in self._imu_gaps.gaps(0)), default=0.0)

    def weak_intervals(self) -> list[WeakInterval]:
        """Successive estimates with the same status other than ok."""
        return list(self._weak)


def _distribution(values: array[float]) -> Distribution | None:
    if not values:
        return None
    data = np.frombuffer(values, dtype=np.float64).copy()  # a view would keep the array from growing
    median, p99 = np.percentile(data, [50, 99])
    return Distribution(median=float(median), mean=float(data.mean()), p99=float(p99), max=float(data.max()))
