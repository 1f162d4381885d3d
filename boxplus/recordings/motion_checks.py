"""Findings about the IMU at rest and in motion, and about how it and the LiDAR agree."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.recordings.imu_units import STANDARD_GRAVITY
from boxplus.recordings.info import Evidence, RecordingInfo, Verdict
from boxplus.sensors.gyro_attitude import GyroAttitude
from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.lidar_rotation import RotationAlignment
from boxplus.sensors.scan_registration import LidarRotations

_WINDOW_S = 0.5
_REST_GYRO_RAD_S = 0.03
_REST_ACCEL = 0.3
_SHORTEST_REST_S = 1.0
_SLOWEST_FOR_REST_HZ = 40.0
"""A slower IMU misses the vibration that tells a smooth drive from a standstill."""
_LARGEST_BIAS_RAD_S = 0.15
_OFFSET_OK_S = 0.015
_ANGLE_OK_DEG = 2.0
_SATURATED_GYRO = 4.0
_SATURATED_ACCEL = 25.0
_WINDOW_BLOCK_S = 0.5


def _windows(imu: ImuSamples, seconds: float) -> list[slice]:
    """Consecutive stretches of about this length with at least five samples; a gap or a jump in time ends one."""
    cell = ((imu.time_ns - imu.time_ns[0]) // round(seconds * 1e9)) if len(imu) else np.empty(0, np.int64)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(cell)) + 1, [len(cell)]))
    return [slice(int(a), int(b)) for a, b in pairwise(edges) if b - a >= 5]


def check_rest(imu: ImuSamples) -> list[Evidence]:
    """The longest standstill: noise, bias, the norm of gravity and which way it points."""
    best: list[slice] = []
    run: list[slice] = []
    rate = 1e9 / max(float(np.median(np.diff(imu.time_ns))), 1.0)
    for window in _windows(imu, _WINDOW_S) if rate > _SLOWEST_FOR_REST_HZ else []:
        gyro_std = float(np.linalg.norm(imu.gyro[window].std(axis=0)))
        accel_std = float(np.linalg.norm(imu.accel[window].std(axis=0)))
        turning = float(np.linalg.norm(imu.gyro[window].mean(axis=0))) > _LARGEST_BIAS_RAD_S
        run = [*run, window] if gyro_std < _REST_GYRO_RAD_S and accel_std < _REST_ACCEL and not turning else []
        best = run if len(run) > len(best) else best
    if len(best) * _WINDOW_S < _SHORTEST_REST_S:
        text = (
            "no standstill of 1 s shows: noise and bias at rest are unknown, and the odometry must start in motion; "
            "stand still at the start if you can"
        )
        return [
            Evidence("standstill", "none", "warning", text),
            _gravity(np.nanmedian(imu.accel, axis=0), "the median of all samples"),
        ]
    rest = slice(best[0].start, best[-1].stop)
    begin = (imu.time_ns[rest.start] - imu.time_ns[0]) * 1e-9
    span = (imu.time_ns[rest.stop - 1] - imu.time_ns[rest.start]) * 1e-9
    gyro_std = np.mean([imu.gyro[window].std(axis=0) for window in best], axis=0)
    accel_std = np.mean([imu.accel[window].std(axis=0) for window in best], axis=0)
    bias = imu.gyro[rest].mean(axis=0)
    norm = float(np.linalg.norm(imu.accel[rest].mean(axis=0)))
    off = abs(norm / STANDARD_GRAVITY - 1.0) > 0.03
    advice = ": more than 3 % off, so the accelerometer's scale or unit is wrong, or its bias is large" if off else ""
    return [
        Evidence("standstill", f"{span:.1f} s", "ok", f"from {begin:.1f} s after the start, at {rate:.0f} Hz"),
        Evidence(
            "gyro_noise",
            f"{gyro_std.mean():.2g} rad/s",
            "ok",
            f"standard deviation at rest ({_numbers(gyro_std)}), density {gyro_std.mean() / np.sqrt(rate):.2g} rad/s/√Hz; "
            f"bias ({_numbers(bias)}) rad/s",
        ),
        Evidence(
            "accel_noise",
            f"{accel_std.mean():.2g} m/s2",
            "ok",
            f"standard deviation at rest ({_numbers(accel_std)}), density {accel_std.mean() / np.sqrt(rate):.2g} m/s2/√Hz",
        ),
        Evidence(
            "gravity_norm", f"{norm:.3f} m/s2", "warning" if off else "ok", f"mean |acceleration| at rest against 9.807{advice}"
        ),
        _gravity(imu.accel[rest].mean(axis=0), "the mean at rest"),
    ]


def _gravity(accel: NDArray[np.float64], source: str) -> Evidence:
    axis = int(np.argmax(np.abs(accel)))
    name = ("-" if accel[axis] < 0 else "+") + "xyz"[axis]
    tilt = float(np.degrees(np.arccos(np.clip(abs(accel[axis]) / max(float(np.linalg.norm(accel)), 1e-9), 0.0, 1.0))))
    # At rest an IMU measures +g along the axis that points up (REP 145).
    text = f"{source} is ({_numbers(accel)}) m/s2, {tilt:.0f} deg from {name}: this axis must point up"
    if name == "-z":
        text += "; with -z up the IMU is mounted upside down, or its driver reports gravity with the wrong sign"
    return Evidence("up_axis", name, "warning" if name == "-z" else "ok", text)


def check_saturation(imu: ImuSamples) -> Evidence:
    """Samples that sit at one and the same extreme value in a row."""
    found = []
    for name, values, floor in (("gyro", imu.gyro, _SATURATED_GYRO), ("accel", imu.accel, _SATURATED_ACCEL)):
        peak = np.nanmax(np.abs(values), axis=0, initial=0.0)
        at_peak = (np.abs(values) >= 0.9999 * peak) & (peak > floor)
        clipped = (at_peak[1:] & at_peak[:-1]).sum(axis=0)
        found += [
            f"{name} {axis}: {count + 1} samples at {top:.2f}"
            for axis, count, top in zip("xyz", clipped, peak, strict=True)
            if count >= 2
        ]
    if found:
        text = f"{'; '.join(found)}: the sensor's range is exceeded and motion is lost there; use a wider range"
        return Evidence("imu_saturation", "saturated", "warning", text)
    largest = [float(np.nanmax(np.linalg.norm(values, axis=1), initial=0.0)) for values in (imu.gyro, imu.accel)]
    return Evidence(
        "imu_saturation", "none", "ok", f"largest |gyro| {largest[0]:.2f} rad/s, largest |acceleration| {largest[1]:.2f} m/s2"
    )


def check_finite(imu: ImuSamples) -> list[Evidence]:
    """IMU samples that are not numbers."""
    bad = int((~(np.isfinite(imu.gyro).all(axis=1) & np.isfinite(imu.accel).all(axis=1))).sum())
    return (
        [Evidence("imu_values", f"{bad} not finite", "warning", f"of {len(imu)} samples: dropped, which leaves gaps")]
        if bad
        else []
    )


def liveliest_stretch(imu: ImuSamples, seconds: float) -> tuple[int, int]:
    """The stretch [begin, end) in ns in which the IMU turns most about its second axis: where a rotation shows best."""
    windows = _windows(imu, _WINDOW_BLOCK_S)
    if not windows:
        return int(imu.time_ns[0]), int(imu.time_ns[-1]) + 1
    rate = np.array([np.nanmean(imu.gyro[window], axis=0) for window in windows])
    length = max(round(seconds / _WINDOW_BLOCK_S), 1)
    starts = range(max(len(rate) - length + 1, 1))
    lively = [np.linalg.eigvalsh(np.atleast_2d(np.cov(rate[k : k + length].T)))[1] if len(rate) > 1 else 0.0 for k in starts]
    best = int(np.argmax(np.nan_to_num(lively)))
    last = min(best + length, len(windows)) - 1
    return int(imu.time_ns[windows[best].start]), int(imu.time_ns[windows[last].stop - 1]) + 1


def check_alignment(info: RecordingInfo, alignment: RotationAlignment) -> list[Evidence]:
    """Gyro unit, time offset and extrinsic rotation, from the comparison of LiDAR and gyroscope."""
    return [_gyro_scale(info, alignment), _time_offset(alignment), _rotation(info.T_imu_lidar, alignment)]


def _gyro_scale(info: RecordingInfo, alignment: RotationAlignment) -> Evidence:
    scale = alignment.gyro_scale
    value = f"{scale:.3g}"
    if alignment.observable_axes < 2:
        return Evidence("gyro_scale", value, "ok", f"too little rotation to check the gyroscope's unit: {alignment.text}")
    if 0.8 < scale < 1.25:
        return Evidence("gyro_scale", value, "ok", f"gyroscope and LiDAR turn alike: {info.gyro_unit} is right")
    if 30.0 < scale < 110.0:
        return Evidence(
            "gyro_scale", value, "error", "the gyroscope turns 57.3 times as far as the LiDAR: give --gyro-unit deg/s"
        )
    if 0.009 < scale < 0.033:
        return Evidence(
            "gyro_scale", value, "error", "the gyroscope turns 57.3 times less than the LiDAR: give --gyro-unit rad/s"
        )
    text = f"gyroscope and LiDAR turn differently: their clocks differ, or scans were registered wrongly; {alignment.text}"
    return Evidence("gyro_scale", value, "warning", text)


def _time_offset(alignment: RotationAlignment) -> Evidence:
    offset, std = alignment.time_offset_s, alignment.time_offset_std_s
    if not np.isfinite(std) or std > 0.02:
        return Evidence("time_offset", "unknown", "ok", f"the motion does not show it: {alignment.text}")
    value = f"{offset * 1e3:+.1f} ms"
    text = f"LiDAR times {value} ± {std * 1e3:.1f} ms are IMU times, over {alignment.intervals} scan pairs"
    if abs(offset) < max(_OFFSET_OK_S, 3.0 * std):
        return Evidence("time_offset", value, "ok", text)
    advice = ": synchronise the clocks, or check --point-time-reference (a whole scan period is the sign of a wrong one)"
    return Evidence("time_offset", value, "warning", text + advice)


def _rotation(T_imu_lidar: NDArray[np.float64] | None, alignment: RotationAlignment) -> Evidence:
    estimate = f"estimate R_imu_lidar = {matrix_text(alignment.R_imu_lidar)}"
    if T_imu_lidar is None:
        known = alignment.observable_axes == 3
        advice = "" if known else "; incomplete, so measure the mounting and give --T-imu-lidar"
        value = f"± {alignment.std_deg[-1]:.1f} deg" if known else f"{alignment.observable_axes} of 3 axes"
        verdict: Verdict = "ok" if known else "warning"
        return Evidence("R_imu_lidar", value, verdict, f"{estimate}; {alignment.text}{advice}")
    error_deg = np.degrees(alignment.axes.T @ so3.log(alignment.R_imu_lidar @ T_imu_lidar[:3, :3].T))
    seen = alignment.std_deg < 5.0
    if not seen.any():
        return Evidence("R_imu_lidar", "unchecked", "ok", f"too little rotation to check the extrinsic: {alignment.text}")
    apart = float(np.linalg.norm(error_deg[seen]))
    value = f"{apart:.1f} deg apart"
    shown = f"about the {int(seen.sum())} axes that show (std {_numbers(alignment.std_deg)})"
    text = f"given and estimated rotation differ by {apart:.2f} deg {shown}"
    if apart < _ANGLE_OK_DEG + 3.0 * float(np.linalg.norm(alignment.std_deg[seen])):
        return Evidence("R_imu_lidar", value, "ok", text)
    inverse_deg = float(np.degrees(np.linalg.norm(alignment.axes.T[seen] @ so3.log(alignment.R_imu_lidar @ T_imu_lidar[:3, :3]))))
    if inverse_deg < 0.3 * apart:
        text += f"; its inverse fits ({inverse_deg:.1f} deg): T_imu_lidar maps LiDAR coordinates to IMU coordinates"
    return Evidence("R_imu_lidar", value, "error" if apart > 10.0 else "warning", f"{text}; {estimate}")


def check_force_sign(lidar: LidarRotations, imu: ImuSamples, alignment: RotationAlignment) -> Evidence:
    """Sign and size of the acceleration, by comparing it with the change of the LiDAR's velocity.

    In a frame that the gyroscope keeps still, acceleration = specific force + gravity, and gravity is constant: the slope of
    one over the other is 1, and -1 when the driver reports the opposite sign.
    """
    key = "gravity_sign"
    joined = np.flatnonzero(lidar.end_ns[:-1] == lidar.begin_ns[1:])
    if len(joined) < 20 or alignment.observable_axes < 3:
        return Evidence(key, "unchecked", "ok", "too little rotation to compare accelerations with the LiDAR's motion")
    shift = round(alignment.time_offset_s * 1e9) if alignment.time_offset_std_s < 0.01 else 0
    attitude = GyroAttitude(imu.time_ns, imu.gyro / _unit_scale(alignment) - alignment.gyro_bias / _unit_scale(alignment))
    force = np.einsum("nij,nj->ni", attitude.at(imu.time_ns), imu.accel)
    steps = (lidar.end_ns - lidar.begin_ns) * 1e-9
    velocity_before = np.einsum("nji,nj->ni", so3.exp(lidar.rotation), lidar.translation) / steps[:, None]
    velocity_after = lidar.translation / steps[:, None]
    middle = lidar.end_ns[joined] + shift
    between = 0.5 * (steps[joined] + steps[joined + 1])[:, None]
    gained = (velocity_after[joined + 1] - velocity_before[joined]) / between
    acceleration = np.einsum("nij,nj->ni", attitude.at(middle) @ alignment.R_imu_lidar, gained)
    total = np.concatenate((np.zeros((1, 3)), np.cumsum(force, axis=0)))
    half = round(float(np.median(between)) * 0.5e9)
    begin = np.searchsorted(imu.time_ns, middle - half)
    end = np.maximum(np.searchsorted(imu.time_ns, middle + half), begin + 1)
    inside = end <= len(imu.time_ns)
    mean_force = (total[end[inside]] - total[begin[inside]]) / (end - begin)[inside, None]
    x, y = mean_force - mean_force.mean(axis=0), acceleration[inside] - acceleration[inside].mean(axis=0)
    power = float((x**2).sum())
    slope = float((x * y).sum()) / max(power, 1e-12)
    std = float(np.sqrt(((y - slope * x) ** 2).sum() / max(x.size - 4, 1) / max(power, 1e-12)))
    text = f"the LiDAR's acceleration follows the accelerometer with a slope of {slope:.2f} ± {std:.2f} (1 is right)"
    if std > 0.2:
        return Evidence(key, "unchecked", "ok", f"too little acceleration to check the sign: {text}")
    if slope < -0.4:
        return Evidence(
            key, "inverted", "error", f"{text}: the driver reports gravity instead of specific force; negate the accelerations"
        )
    if slope > 0.4:
        return Evidence(key, "right", "ok", text)
    return Evidence(key, "unclear", "warning", f"{text}: LiDAR and IMU disagree; check the extrinsic and the clocks")


def _unit_scale(alignment: RotationAlignment) -> float:
    return 180.0 / np.pi if alignment.gyro_scale > 7.6 else 1.0


def matrix_text(R: NDArray[np.float64]) -> str:
    """A (3, 3) matrix on one line."""
    return "[" + "; ".join(", ".join(f"{value:.4f}" for value in row) for row in R) + "]"


def _numbers(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
