"""Which scans of a start at rest see from one place what the first one sees."""

from __future__ import annotations

from collections.abc import Sequence

from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.start.start import Start

_SHARE = 0.5  # of the scans of a start: with the last of them the platform may be setting off


def resting_scans(found: Start, waiting: Sequence[Frame]) -> list[Frame]:
    """Of the scans after the first one, those taken from its pose: none of a start in motion, or where rest is not shown.

    The first map of a LiDAR that scans no line twice is made of a single scan otherwise, and what that says of a turn in
    a stairwell, three degrees more or less, stays with the whole run (docs/lidar_inertial_odometry.md, section 9).

    Args:
        found: the start; waiting: what waited for it, in order of time, without its first scan.
    """
    if found.kind != "static" or len(found.unshown_axes) or found.warning:
        return []
    return list(waiting[: int(_SHARE * len(waiting))])
