"""Scans and IMU samples that a caller has put together himself, before an estimator takes them in.

`from_arrays` has checked its arrays. The bare constructors take what they are given; arrays of other types than the kernels'
would then be read as something else, and rows that do not belong together as if they did.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from boxplus.errors import InputError
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan


def checked_imu(samples: ImuSamples) -> ImuSamples:
    """The same samples; with arrays converted where that is all that they lack.

    Raises:
        InputError: no `ImuSamples`, or their arrays have not the shapes and types that its docstring says.
    """
    if not isinstance(samples, ImuSamples):
        raise InputError("ImuSamples", _kind(samples), "build them with ImuSamples.from_arrays(time_ns, gyro, accel)")
    time, gyro, accel = samples.time_ns, samples.gyro, samples.accel
    typed = _is(time, np.int64, 1) and _is(gyro, np.float64, 2) and _is(accel, np.float64, 2)
    whole = typed and gyro.shape == accel.shape == (len(time), 3)
    return samples if whole else ImuSamples.from_arrays(time, gyro, accel)


def checked_scan(scan: Scan) -> Scan:
    """The same scan; with arrays converted where that is all that they lack, and without points that are not finite.

    Raises:
        InputError: no `Scan`, its arrays have not the shapes and types that its docstring says, it ends before it starts, or all
            points are from before its start or after its end.
    """
    if not isinstance(scan, Scan):
        raise InputError("a Scan", _kind(scan), "build it with Scan.from_arrays(p_lidar, time_ns)")
    points, time, intensity = scan.p_lidar, scan.time_ns, scan.intensity
    whole = _is(points, np.float32, 2) and _is(time, np.int64, 1) and points.shape == (len(time), 3)
    if scan.lidar is not None and np.shape(scan.lidar) != np.shape(time):
        raise InputError(
            f"lidar of shape {np.shape(time)}, as time_ns", f"shape {np.shape(scan.lidar)}", "give one number a point, or none"
        )
    if not whole or not (intensity is None or (_is(intensity, np.float32, 1) and intensity.shape == time.shape)):
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


def _is(array: object, dtype: type, axes: int) -> bool:
    """Also whether it lies in one piece: kernels would be compiled anew for any other layout."""
    return isinstance(array, np.ndarray) and array.dtype == dtype and array.ndim == axes and array.flags.c_contiguous


def _kind(value: object) -> str:
    shape = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
    return f"{type(value).__name__}{shape}"
