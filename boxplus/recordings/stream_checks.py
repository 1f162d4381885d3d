"""Findings about the streams of a recording: rates, gaps, order, cover, and what became of the points."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.info import Evidence, Verdict
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan

_MANY_NEAR = 0.1
_MANY_NOT_FINITE = 0.5


@dataclass(slots=True)
class StreamLog:
    """What is kept of every scan and IMU sample while a recording streams by: times and counts, no points.

    Attributes:
        scan_start_ns, scan_end_ns, scan_points: one entry per scan.
        dropped: points dropped by reason, over all scans.
        imu: the blocks of IMU samples.
    """

    scan_start_ns: list[int] = field(default_factory=list)
    scan_end_ns: list[int] = field(default_factory=list)
    scan_points: list[int] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)
    imu: list[ImuSamples] = field(default_factory=list)

    def add(self, event: Scan | ImuSamples) -> None:
        """Note one event."""
        if isinstance(event, ImuSamples):
            self.imu.append(event)
            return
        self.scan_start_ns.append(event.start_ns)
        self.scan_end_ns.append(event.end_ns)
        self.scan_points.append(len(event))
        self.dropped.update(event.rejected)

    def all_imu(self) -> ImuSamples:
        """All IMU samples, in order of arrival."""
        return ImuSamples.joined(self.imu)


def check_rate(key: str, time_ns: NDArray[np.int64], gap_factor: float, slow_hz: float = 0.0) -> list[Evidence]:
    """Rate, gaps and order of one stream.

    Args:
        key: `lidar` or `imu`, the beginning of the findings' keys.
        time_ns: (N,) times in order of arrival.
        gap_factor: a step longer than this many usual ones is a gap.
        slow_hz: below this rate a warning is given.
    """
    steps = np.diff(time_ns)
    forward = steps[steps > 0]
    if not len(forward):
        return [
            Evidence(
                f"{key}_rate",
                "unknown",
                "error",
                f"{len(time_ns)} messages without progress in their times: nothing can be estimated",
            )
        ]
    usual = float(np.median(forward)) * 1e-9
    slow = 1.0 / usual < slow_hz
    advice = ": between its samples the motion is guessed, expect less accuracy; record at 100 Hz or more" if slow else ""
    jitter = float(np.median(np.abs(forward * 1e-9 - usual))) * 1e3
    text = f"median step {usual * 1e3:.3f} ms, median deviation {jitter:.3f} ms, {len(time_ns)} messages{advice}"
    found = [Evidence(f"{key}_rate", f"{1.0 / usual:.1f} Hz", "warning" if slow else "ok", text)]
    gaps = np.flatnonzero(steps > gap_factor * usual * 1e9)
    if len(gaps):
        longest = int(np.argmax(steps))
        text = (
            f"longest {steps[longest] * 1e-9:.3f} s, {(time_ns[longest] - time_ns[0]) * 1e-9:.2f} s after the start; "
            f"about {round(float((steps[gaps] * 1e-9 / usual - 1).sum()))} messages are missing: check the recorder's disk"
        )
        found.append(Evidence(f"{key}_gaps", str(len(gaps)), "warning", text))
    else:
        found.append(Evidence(f"{key}_gaps", "0", "ok", f"longest step {steps.max() * 1e-9:.4f} s"))
    backward, repeated = int((steps < 0).sum()), int((steps == 0).sum())
    if backward or repeated:
        largest = -min(int(steps.min()), 0) * 1e-9
        text = f"{backward} steps backwards (largest {largest:.3f} s), {repeated} repeated times: those messages are dropped"
        found.append(Evidence(f"{key}_order", f"{backward + repeated} out of order", "warning", text))
    return found


def check_cover(log: StreamLog, imu: ImuSamples) -> Evidence:
    """Whether the IMU covers the scans."""
    starts, ends = np.array(log.scan_start_ns), np.array(log.scan_end_ns)
    if not len(starts) or not len(imu):
        return Evidence("imu_cover", "none", "error", f"{len(starts)} scans and {len(imu)} IMU samples: both are needed")
    first, last = int(imu.time_ns.min()), int(imu.time_ns.max())
    period = float(np.median(ends - starts)) * 1e-9
    outside = int(((starts < first) | (ends > last)).sum())
    overlap = (min(last, int(ends.max())) - max(first, int(starts.min()))) * 1e-9
    lead = (int(starts.min()) - first) * 1e-9
    text = f"{outside} of {len(starts)} scans lie outside the IMU's samples; the IMU starts {lead:+.3f} s before the first scan"
    if overlap <= 0:
        text = f"LiDAR and IMU do not overlap: {-overlap:.3f} s lie between them; their clocks differ, synchronise them"
        return Evidence("imu_cover", "no overlap", "error", text)
    allowed = 2 + 1.0 / max(period, 0.01)
    verdict: Verdict = "ok" if outside <= allowed else "warning"
    advice = "" if verdict == "ok" else "; those scans cannot be used"
    return Evidence("imu_cover", f"{overlap:.2f} s", verdict, text + advice)


def check_points(log: StreamLog) -> list[Evidence]:
    """How many points a scan has and which were dropped."""
    kept = np.array(log.scan_points)
    if not len(kept):
        return []
    empty = int((kept == 0).sum())
    text = f"median of {len(kept)} scans, from {kept.min()} to {kept.max()}" + (
        f"; {empty} scans have no valid point" if empty else ""
    )
    few = float(np.median(kept)) < 500
    found = [Evidence("points_per_scan", f"{np.median(kept):.0f}", "warning" if empty or few else "ok", text)]
    total = int(kept.sum()) + sum(log.dropped.values())
    limits = {"nearer than min_range": _MANY_NEAR, "not finite": _MANY_NOT_FINITE}
    advice = {
        "nearer than min_range": ": the robot itself, or --min-range is too large for this place",
        "not finite": ": more points are missing than measured; look at the driver's settings",
    }
    keys = {
        "not finite": "points_not_finite",
        "zero (no return)": "points_zero",
        "nearer than min_range": "points_near",
        "farther than max_range": "points_far",
    }
    for reason, key in keys.items():
        share = log.dropped[reason] / max(total, 1)
        many = share > limits.get(reason, 1.0)
        text = f"{log.dropped[reason]} of {total} points are {reason}, dropped{advice[reason] if many else ''}"
        found.append(Evidence(key, f"{100 * share:.2f} %", "warning" if many else "ok", text))
    return found


def check_rejected(rejected: dict[str, int]) -> list[Evidence]:
    """Messages that could not be read."""
    return [
        Evidence("messages", f"{count} rejected", "warning", f"{reason.removeprefix('messages: ')}: not used")
        for reason, count in rejected.items()
        if reason.startswith("messages: ") or reason == "points: time not finite or outside the scan"
    ]
