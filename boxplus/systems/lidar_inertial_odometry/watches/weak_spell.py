"""Which scans are called weak: a direction that one scan misses and the next one shows is none to warn of."""

from __future__ import annotations

from collections import deque

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.systems.lidar_inertial_odometry.estimate import Status

_WINDOW_NS = 500_000_000  # over which the IMU alone holds a pose to millimetres
_CLEARLY = 2.0  # times the threshold: such a scan has measured every direction, whatever the ones before it left open


class WeakSpell:
    """Follows the scans of one run.

    Args:
        weak_threshold: least ratio of a measured direction (`filtering.degeneracy`).
        known_ns: time [ns] at which the pose and its velocity were known, the start of a run; None where no time is.
    """

    def __init__(self, weak_threshold: float, known_ns: int | None = None) -> None:
        self._clear_ratio = _CLEARLY * weak_threshold
        self._known_ns = known_ns
        self._scans: deque[tuple[int, bool]] = deque()

    def status(self, time_ns: int, directions: PoseDirections, taken: bool, *, stands: bool = False) -> Status:
        """Of the scan that ends at `time_ns` [ns]: weak where half of the scans of the last half second left a direction open.

        The part of that half second before a pose that was known counts as seen, and a scan that measures every direction
        clearly is not weak itself, though it may be the first after many that were. While the platform is known to stand, its
        pose is known whatever a scan leaves open: rings that meet the same spots again and again say nothing new.

        Args:
            time_ns: end of the scan.
            directions: what it determines.
            taken: whether it was taken in.
            stands: whether the platform stands, as the surroundings have shown.
        """
        if not taken:
            return "lost"
        if stands:
            self._known_ns = time_ns
            self._scans.clear()
            return "ok"
        self._scans.append((time_ns, bool(directions.weak.any())))
        while self._scans[0][0] < time_ns - _WINDOW_NS:
            self._scans.popleft()
        if not directions.weak.any() and directions.ratios.min() >= self._clear_ratio:
            return "ok"
        weak = sum(open_direction for _, open_direction in self._scans)
        return "weak" if 2 * weak >= len(self._scans) * self._share_unseen(time_ns) else "ok"

    def _share_unseen(self, time_ns: int) -> float:
        """The half second over what of it has passed since the pose was known; 1 where that is longer ago."""
        if self._known_ns is None:
            return 1.0
        return max(1.0, _WINDOW_NS / max(time_ns - self._known_ns, 1))
