"""Which stretches of a recording LiDAR and IMU are compared over, and their scans."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from boxplus.recordings.recording import Recording
from boxplus.runs.inspection.imu_checks import liveliest_stretch
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import thinned

_MARGIN_NS = 900_000_000
"""Of IMU samples around a stretch: as far as the clocks may be apart, and a bit."""
_MOST_POINTS = 12_000
"""Of a scan that is kept; a stretch of 8 s at 10 Hz stays below 20 MB."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A part [begin, end) of a recording [ns] with its scans, thinned, and its IMU samples."""

    begin_ns: int
    end_ns: int
    imu: ImuSamples
    scans: list[Scan] = field(default_factory=list)

    @classmethod
    def between(cls, imu: ImuSamples, begin_ns: int, end_ns: int) -> Stretch:
        """Without scans, with the samples around it."""
        inside = (imu.time_ns >= begin_ns - _MARGIN_NS) & (imu.time_ns <= end_ns + _MARGIN_NS)
        return cls(begin_ns, end_ns, imu.where(inside))


def lively_stretches(imu: ImuSamples, seconds: float, most: int) -> list[Stretch]:
    """Up to `most` stretches that do not overlap: the liveliest, then that of the first part, of the last, of those between.

    Args:
        imu: finite samples in order of time, of the whole recording.
        seconds: the length of a stretch.
        most: how many, at least 1.
    """
    chosen = [liveliest_stretch(imu, seconds)]
    parts = max(most, 3)
    order = [0, parts - 1, *range(1, parts - 1)]
    for part in order:
        begin_ns, end_ns = liveliest_stretch(imu, seconds, part / parts, (part + 1) / parts)
        if len(chosen) < most and all(end_ns <= begin or begin_ns >= end for begin, end in chosen):
            chosen.append((begin_ns, end_ns))
    return [Stretch.between(imu, begin_ns, end_ns) for begin_ns, end_ns in chosen]


def gather_scans(recording: Recording, stretches: Sequence[Stretch], report: Callable[[float], None]) -> None:
    """Read the recording once more and fill in the scans of all stretches."""
    last_ns = max(stretch.end_ns for stretch in stretches)
    for event in recording:
        if not isinstance(event, Scan):
            continue
        if event.start_ns > last_ns + _MARGIN_NS:
            return
        for stretch in stretches:
            if event.start_ns >= stretch.begin_ns and event.end_ns <= stretch.end_ns:
                # Of several LiDARs the first alone: what is wrong with another one must not be blamed on its mounting.
                stretch.scans.append(thinned(event if event.lidar is None else event.of_lidar(0), _MOST_POINTS))
        report(recording.progress)
