"""Several LiDARs compared along the path of the first one by itself, which no error of another one has bent."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from boxplus.recordings.recording import Event
from boxplus.sensors.lidar.scan import Scan
from boxplus.systems.lidar_odometry.odometry import LidarOdometry
from boxplus.systems.several_lidars.watch import LidarWatch

LONGEST_S = 120.0
"""Of a recording, to look for stretches in which the LiDARs can be compared."""
_WINDOWS = 3


def compare_by_first_alone(
    events: Iterable[Event], watch: LidarWatch, report: Callable[[float], None] = lambda _: None, *, determined: bool = False
) -> list[str]:
    """Let a watch judge three stretches of the first two minutes; IMUs take no part.

    Args:
        events: of a merged recording, from its beginning.
        watch: that has seen nothing yet.
        report: called with the seconds of the recording that were looked at.
        determined: leave out stretches in which a scan of the first one leaves a direction open.

    Returns:
        What it found, one sentence each; see also its `judgements` and its `contradiction`.
    """
    watch.every_s = 0.0
    odometry = LidarOdometry()
    told: list[str] = []
    first_ns: int | None = None
    for event in events:
        if not isinstance(event, Scan):
            continue
        first_ns = event.start_ns if first_ns is None else first_ns
        seconds = (event.end_ns - first_ns) * 1e-9
        report(seconds)
        watch.add_scan(event)
        for estimate in odometry.push_scan(event.of_lidar(0)):
            # Where it does not see its way by itself, it may have slid along it: that is no error of another one.
            is_open = determined and estimate.status == "weak"
            told += watch.add_estimate(replace(estimate, status="lost") if is_open else estimate)
        if seconds > LONGEST_S or min(windows for _, windows, _ in watch.judgements().values()) >= _WINDOWS:
            break
    return told + watch.finish()
