"""Gaps in the images of a camera, whose rate may change: with the light, with its exposure."""

from __future__ import annotations

from array import array

import numpy as np

from boxplus.runs.run_facts import Gap

_FACTOR, _LEAST_S = 3.0, 0.25  # a shorter gap does no harm, at whatever rate
_AROUND = 10  # intervals before and after


class ImageGaps:
    """Finds intervals much longer than those around them. Memory grows by 8 bytes an image.

    Where a rate changes, intervals before or after are as long, and nothing is missing.
    """

    def __init__(self) -> None:
        self._times_ns = array("q")

    def add(self, time_ns: int) -> None:
        """Take the time of an image [ns]; one that does not move forward is passed over."""
        if not self._times_ns or time_ns > self._times_ns[-1]:
            self._times_ns.append(time_ns)

    @property
    def first_ns(self) -> int | None:
        """The time of the first image [ns]; None before there was one."""
        return self._times_ns[0] if self._times_ns else None

    def gaps(self, origin_ns: int) -> list[Gap]:
        """In order of time: a quarter of a second and three times the usual interval on both sides, or longer."""
        times_ns = np.array(self._times_ns, np.int64)
        intervals = np.diff(times_ns) * 1e-9
        found = []
        for k in np.flatnonzero(intervals > _LEAST_S).tolist():
            sides = intervals[max(k - _AROUND, 0) : k], intervals[k + 1 : k + 1 + _AROUND]
            usual = max((float(np.median(side)) for side in sides if len(side)), default=np.inf)
            if intervals[k] > _FACTOR * usual:
                found.append(Gap(begin_s=(int(times_ns[k]) - origin_ns) * 1e-9, duration_s=float(intervals[k])))
        return found
