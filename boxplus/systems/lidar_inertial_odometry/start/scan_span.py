"""The time that a scan takes against the time between scans: a unit of the point times that is wrong shows here."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boxplus.sensors.lidar.scan import Scan

_SHORTEST, _LONGEST = 0.05, 1.5  # of the time between scans
_LONGEST_PERIOD_S = 1.0  # beyond it scans are missing


def span_problem(span_s: float, period_s: float) -> str | None:
    """A sentence where the points of a scan cannot span this time; None where they can, or nothing is known.

    Args:
        span_s: from the first point of a scan to its last [s]; 0 where points carry no times of their own.
        period_s: from the beginning of the scan before to that of this one [s].

    Example:
        >>> span_problem(0.1, 0.1) is None
        True
        >>> span_problem(0.0001, 0.1)[:34]
        'the points of a scan span 0.1 ms, '
    """
    if not 0.0 < period_s < _LONGEST_PERIOD_S or span_s == 0.0 or _SHORTEST * period_s < span_s < _LONGEST * period_s:
        return None
    return (
        f"the points of a scan span {span_s * 1e3:.3g} ms, but scans come every {period_s * 1e3:.3g} ms: "
        "check the unit of the point times (s, ms, µs or ns)"
    )


def span_problem_of(scans: Sequence[Scan]) -> str | None:
    """The same of successive scans, by the medians of both times, which a scan that is missing does not change."""
    if len(scans) < 2:
        return None
    start_ns, end_ns = (np.array([getattr(scan, name) for scan in scans]) for name in ("start_ns", "end_ns"))
    return span_problem(float(np.median(end_ns - start_ns)) * 1e-9, float(np.median(np.diff(start_ns))) * 1e-9)
