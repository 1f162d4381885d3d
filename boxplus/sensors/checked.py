"""Scans and IMU samples that a caller has put together himself, before an estimator takes them in.

`Scan.from_arrays` has checked its arrays. The bare constructor takes what it is given; arrays of other types than the kernels'
would then be read as something else, and rows that do not belong together as if they did.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from boxplus._numbers import is_array
from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan


def checked_imu(samples: ImuSamples) -> ImuSamples:
    """The same samples, whose constructor has looked at their arrays.

    Raises:
        InputError: no `ImuSamples`.
    """
    if not isinstance(samples, ImuSamples):
        raise InputError("ImuSamples", _kind(samples), "build them with ImuSamples.from_arrays(time_ns, gyro, accel)")
    return samples


def checked_scan(scan: Scan) -> Scan:
    """The same scan; with arrays converted where that is all that they lack, and without points that are not finite.

    Raises:
        InputError: no `Scan`, its arrays have not the shapes and types that its docstring says, it ends before it starts, or all
            points are from before its start or after its end.
    """
    if not isinstance(scan, Scan):
        raise InputError("a Scan", _kind(scan), "build it with Scan.from_arrays(p_lidar, time_ns)")
    points, time, intensity = scan.p_lidar, scan.time_ns, scan.intensity
    whole = is_array(points, np.float32, 2) and is_array(time, np.int64, 1) and points.shape == (len(time), 3)
    if scan.lidar is not None and np.shape(scan.lidar) != np.shape(time):
        raise InputError(
            f"lidar of shape {np.shape(time)}, as time_ns", f"shape {np.shape(scan.lidar)}", "give one number a point, or none"
        )
    if not whole or not (intensity is None or (is_array(intensity, np.float32, 1) and intensity.shape == time.shape)):
        made = Scan.from_arrays(points, time, intensity, lidar=scan.lidar)
        rejected = dict(Counter(scan.rejected) + Counter(made.rejected))
        scan = replace(made, start_ns=scan.start_ns, end_ns=scan.end_ns, rejected=rejected)
    if not np.isfinite(scan.p_lidar).all():
        finite = np.asarray(np.isfinite(scan.p_lidar).all(axis=1))
        dropped = int((~finite).sum()) + scan.rejected.get("not finite", 0)
        scan = replace(scan.where(finite), rejected={**scan.rejected, "not finite": dropped})
    first, last = (int(scan.time_ns.min()), int(scan.time_ns.max())) if len(scan) else (scan.start_ns, scan.end_ns)
    if not (scan.start_ns <= scan.end_ns and first <= scan.end_ns and scan.start_ns <= last):
        raise InputError(
            f"points from between start_ns, {scan.start_ns}, and end_ns, {scan.end_ns}",
            f"points from {first} to {last}",
            "give all of them as absolute nanoseconds; Scan.from_arrays takes start and end from the points",
        )
    return scan


def _kind(value: object) -> str:
    shape = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
    return f"{type(value).__name__}{shape}"
