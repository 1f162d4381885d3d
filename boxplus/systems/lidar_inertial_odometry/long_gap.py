"""After seconds without a scan nothing says where the platform is: a new start, at a place that is not known.

Integrated over ten hours, noise of an IMU is a position 13 km off; over ten seconds, at an unknown bias, already metres.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.sequencer import Frame

LONGEST_GAP_S = 5.0  # between the ends of two scans
_HELD_S = 1.0  # an older IMU sample says nothing of the scan
_UNKNOWN = np.diag([np.pi] * 3 + [1e4] * 3) ** 2  # of the pose against the first one: any turn, kilometres


def after_gap(frame: Frame) -> Frame:
    """A frame that begins with its own scan, with the IMU samples around that: the first one of a new start."""
    time, begin, end = frame.imu.time_ns, frame.scan.start_ns, frame.scan.end_ns
    first = max(int(np.searchsorted(time, begin, side="right")) - 1, 0)
    if (begin - int(time[first])) * 1e-9 > _HELD_S:
        first = min(first + 1, len(time) - 1)
    imu = ImuSamples(time[first:], frame.imu.gyro[first:], frame.imu.accel[first:])
    spans = [int(imu.time_ns[0]) - begin, end - int(imu.time_ns[-1]), int(np.diff(imu.time_ns).max(initial=0))]
    return replace(frame, imu=imu, begin_ns=begin, largest_gap_s=max(spans) * 1e-9)


def with_unknown_pose(cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """The covariance (24, 24) of a state whose pose against the first one is not known."""
    unknown = cov.copy()
    unknown[:6, :6] += _UNKNOWN
    return unknown


def gap_text(seconds: float, why: str) -> str:
    """What is said of the gap; `why` a shorter one is none to go on after, a clause."""
    what = why or f"no scan for {seconds:.1f} s, longer than {LONGEST_GAP_S:g} s"
    return (
        f"{what}: where the platform went meanwhile is not known; a new start and a new map begin at the last position, and the "
        "poses before and after do not belong together: run the parts of the recording separately"
    )
