"""Which scans are called weak: a direction that one scan misses and the next one shows is none to warn of."""

from __future__ import annotations

from collections import deque

from boxplus.filtering.iterated_update import Posterior
from boxplus.systems.lidar_inertial_odometry.estimate import Status

_WINDOW_NS = 500_000_000  # over which the IMU alone holds a pose to millimetres


class WeakSpell:
    """Follows the scans of one run."""

    def __init__(self) -> None:
        self._scans: deque[tuple[int, bool]] = deque()

    def status(self, time_ns: int, posterior: Posterior, taken: bool) -> Status:
        """Of the scan that ends at `time_ns` [ns]: weak where half of the scans of the last half second left a direction open.

        Args:
            time_ns: end of the scan.
            posterior: its update.
            taken: whether it became the state.
        """
        if not taken:
            return "lost"
        self._scans.append((time_ns, bool(posterior.last.directions.weak.any())))
        while self._scans[0][0] < time_ns - _WINDOW_NS:
            self._scans.popleft()
        weak = sum(open_direction for _, open_direction in self._scans)
        return "weak" if 2 * weak >= len(self._scans) else "ok"
