"""A pause in which neither sensor told how the platform moved: what is contradicted after it is contradicted because of it.

A recording that stops for a second goes on elsewhere. The motion across it is guessed, and a registration that begins beside its
basin comes to rest beside the place. Soon after, units, clocks or a mounting seem to be wrong, and are not.
"""

from __future__ import annotations

from boxplus.sensors.sequencer import Frame

LEAST_S = 0.25  # nobody's sensors stutter for as long
_SETTLING_S = 1.0
_SOON_S = 10.0  # after it; later, what is contradicted has other causes


def without_scan_s(frame: Frame) -> float:
    """From the end of the scan before to the beginning of this one [s]."""
    return (frame.scan.start_ns - frame.begin_ns) * 1e-9


def is_pause(frame: Frame) -> bool:
    """Whether nothing told for a while how the platform moved; the IMU may come back later than the LiDAR."""
    return min(frame.largest_gap_s, without_scan_s(frame)) > LEAST_S


class Pause:
    """Follows the scans of one run.

    Attributes:
        preface: what to say before a contradiction, a clause with a colon; empty where it came after no pause.

    Example:
        >>> from boxplus.systems.lidar_inertial_odometry.watches.pause import Pause
        >>> Pause().preface
        ''
    """

    def __init__(self) -> None:
        self.preface = ""
        self._ended_ns: int | None = None
        self._lasted_s = 0.0
        self._was_contradicted = False

    def begin(self, frame: Frame) -> None:
        """A scan comes after a pause."""
        self._ended_ns, self._lasted_s = frame.scan.start_ns, without_scan_s(frame)

    def settles(self, now_ns: int) -> bool:
        """Whether the speed, which was guessed after it, may still be coming right."""
        return self._ended_ns is not None and (now_ns - self._ended_ns) * 1e-9 < _SETTLING_S

    def update(self, now_ns: int, contradicted: bool) -> None:
        """Whether the run is contradicted at the end of a scan."""
        is_new, self._was_contradicted = contradicted and not self._was_contradicted, contradicted
        if is_new:
            self.preface = self._preface(now_ns)

    def _preface(self, now_ns: int) -> str:
        if self._ended_ns is None or (since_s := (now_ns - self._ended_ns) * 1e-9) > _SOON_S:
            return ""
        return (
            f"{since_s:.1f} s after a pause of {self._lasted_s:.1f} s in which neither sensor told how the platform moved, and "
            "which may be all that is wrong (run what comes before and after it by themselves): "
        )
