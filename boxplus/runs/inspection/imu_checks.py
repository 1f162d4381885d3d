"""Findings about the IMU by itself: values, saturation, noise and gravity at rest; and where it moves most."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.imu_units import STANDARD_GRAVITY
from boxplus.recordings.info import Evidence
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_saturation import limits_of
from boxplus.sensors.inertial.imu_values import beyond, empty, finite, glitches
from boxplus.systems.lidar_inertial_agreement.rest import Rest

_WINDOW_S = 0.5
_REST_GYRO_RAD_S = 0.03
_REST_ACCEL = 0.3
_SHORTEST_REST_S = 1.0
_SLOWEST_FOR_REST_HZ = 40.0
"""A slower IMU misses the vibration that tells a smooth drive from a standstill."""
_LARGEST_BIAS_RAD_S = 0.15
_GRAVITY_OFF = 0.03
_REPEATED, _REPEATED_S = 20, 0.2  # samples and their time


def _windows(imu: ImuSamples, seconds: float) -> list[slice]:
    """Consecutive stretches of about this length with at least five samples; a gap or a jump in time ends one."""
    cell = ((imu.time_ns - imu.time_ns[0]) // round(seconds * 1e9)) if len(imu) else np.empty(0, np.int64)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(cell)) + 1, [len(cell)]))
    return [slice(int(a), int(b)) for a, b in pairwise(edges) if b - a >= 5]


def quiet_stretch(imu: ImuSamples) -> slice | None:
    """The longest stretch of a second or more in which the IMU is quiet, None without one; it may still move steadily."""
    best: list[slice] = []
    run: list[slice] = []
    for window in _windows(imu, _WINDOW_S) if _rate_hz(imu) > _SLOWEST_FOR_REST_HZ else []:
        gyro_std = float(np.linalg.norm(imu.gyro[window].std(axis=0)))
        accel_std = float(np.linalg.norm(imu.accel[window].std(axis=0)))
        turning = float(np.linalg.norm(imu.gyro[window].mean(axis=0))) > _LARGEST_BIAS_RAD_S
        run = [*run, window] if gyro_std < _REST_GYRO_RAD_S and accel_std < _REST_ACCEL and not turning else []
        best = run if len(run) > len(best) else best
    return slice(best[0].start, best[-1].stop) if len(best) * _WINDOW_S >= _SHORTEST_REST_S else None


def check_rest(imu: ImuSamples, stretch: slice, *, quiet: bool, rest: Rest | None) -> list[Evidence]:
    """Standstill, noise and gravity over a stretch that may be one.

    Args:
        imu: finite samples in order of time.
        stretch: the quietest stretch, or the first second.
        quiet: whether the IMU is quiet over it.
        rest: what the LiDAR says of it, decided as the odometry decides its start; None where it has no scans to tell.
    """
    begin = (imu.time_ns[stretch.start] - imu.time_ns[0]) * 1e-9
    span = (imu.time_ns[stretch.stop - 1] - imu.time_ns[stretch.start]) * 1e-9
    where = f"from {begin:.1f} s after the start, for {span:.1f} s"
    seen = "by the IMU alone" if rest is None else f"the LiDAR moves with {rest.speed * 100:.1f} cm/s"
    if not (quiet if rest is None else rest.at_rest and (quiet or rest.determined)):
        text = f"the IMU is quiet {where}, but {seen}: a steady motion" if quiet else "no quiet second shows"
        text += "; noise and bias at rest are unknown, and the odometry starts in motion"
        return [Evidence("standstill", "none", "ok", text), _gravity(np.median(imu.accel, axis=0), "the median of all samples")]
    rate = _rate_hz(imu)
    windows = [part for part in _windows(imu, _WINDOW_S) if part.start >= stretch.start and part.stop <= stretch.stop] or [
        stretch
    ]
    gyro_std = np.mean([imu.gyro[window].std(axis=0) for window in windows], axis=0)
    accel_std = np.mean([imu.accel[window].std(axis=0) for window in windows], axis=0)
    bias = imu.gyro[stretch].mean(axis=0)
    norm = float(np.linalg.norm(imu.accel[stretch].mean(axis=0)))
    advice = doubt_of_gravity(norm)
    off = bool(advice)
    shaken = "" if quiet else ", shaken"
    return [
        Evidence("standstill", f"{span:.1f} s", "ok", f"{where}{shaken}, at {rate:.0f} Hz; {seen}"),
        Evidence(
            "gyro_noise",
            f"{gyro_std.mean():.2g} rad/s",
            "ok",
            f"standard deviation at rest{shaken} ({_numbers(gyro_std)}), "
            f"density {gyro_std.mean() / np.sqrt(rate):.2g} rad/s/√Hz; bias ({_numbers(bias)}) rad/s",
        ),
        Evidence(
            "accel_noise",
            f"{accel_std.mean():.2g} m/s2",
            "ok",
            f"standard deviation at rest{shaken} ({_numbers(accel_std)}), "
            f"density {accel_std.mean() / np.sqrt(rate):.2g} m/s2/√Hz",
        ),
        Evidence(
            "gravity_norm", f"{norm:.3f} m/s2", "warning" if off else "ok", f"mean |acceleration| at rest against 9.807{advice}"
        ),
        _gravity(imu.accel[stretch].mean(axis=0), "the mean at rest"),
    ]


def doubt_of_gravity(norm: float) -> str:
    """What the mean |acceleration| at rest [m/s²] says against an accelerometer; empty where it may be in order.

    Example:
        >>> doubt_of_gravity(9.7), doubt_of_gravity(10.3)
        ('', ": more than 3 % off, so the accelerometer's scale or unit is wrong, or its bias is large")
    """
    if abs(norm / STANDARD_GRAVITY - 1.0) <= _GRAVITY_OFF:
        return ""
    return ": more than 3 % off, so the accelerometer's scale or unit is wrong, or its bias is large"


def first_second(imu: ImuSamples) -> slice:
    """The samples of the first second."""
    return slice(0, max(int(np.searchsorted(imu.time_ns, imu.time_ns[0] + round(_SHORTEST_REST_S * 1e9))), 2))


def _rate_hz(imu: ImuSamples) -> float:
    return 1e9 / max(float(np.median(np.diff(imu.time_ns))), 1.0)


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
    """Samples that sit at a limit of their sensor, see `Saturation`."""
    imu = imu.in_order()
    samples: dict[str, int] = {}
    for limit in limits_of(imu):  # either way along an axis has one
        samples[limit.text] = samples.get(limit.text, 0) + int(limit.reached(imu).sum())
    found = [f"{text} in {count} samples" for text, count in samples.items()]
    if found:
        text = f"{'; '.join(found)}: the sensor's range is exceeded and motion is lost there; use a wider range"
        return Evidence("imu_saturation", "saturated", "warning", text)
    largest = [float(np.nanmax(np.linalg.norm(values, axis=1), initial=0.0)) for values in (imu.gyro, imu.accel)]
    return Evidence(
        "imu_saturation", "none", "ok", f"largest |gyro| {largest[0]:.2f} rad/s, largest |acceleration| {largest[1]:.2f} m/s2"
    )


def check_values(imu: ImuSamples) -> list[Evidence]:
    """IMU samples that no sensor in order delivers."""
    numbers, too_large, zero = finite(imu), beyond(imu), empty(imu)
    rest = imu.where(numbers & ~too_large & ~zero)
    kinds = (
        (~numbers, "not finite"),
        (too_large & numbers, "beyond any sensor"),
        (zero, "zero throughout"),
        (glitches(rest), "unlike both of their neighbours"),
    )
    bad = [f"{np.count_nonzero(mask)} {kind}" for mask, kind in kinds if mask.any()]
    if not bad:
        return []
    return [Evidence("imu_values", ", ".join(bad), "warning", f"of {len(imu)} samples: dropped, which leaves gaps")]


def check_repeats(imu: ImuSamples) -> list[Evidence]:
    """Stretches in which a sensor repeats one value on all axes; as a coarse one may at rest, it is asked for causes only."""
    found = []
    for name, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        same = np.concatenate([[False], (np.diff(values, axis=0) == 0.0).all(axis=1), [False]])
        edges = np.flatnonzero(np.diff(same.astype(np.int8)))
        if not len(edges):
            continue
        begin, end = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: imu.time_ns[run[1]] - imu.time_ns[run[0]])
        lasting_s = (imu.time_ns[end] - imu.time_ns[begin]) * 1e-9
        if end - begin >= _REPEATED and lasting_s >= _REPEATED_S:
            found.append(f"the {name} for {lasting_s:.2f} s")
    if not found:
        return []
    text = f"{' and '.join(found)} to the bit on all axes: its driver stalls, or fills gaps with what came last"
    return [Evidence("imu_repeats", "one value", "warning", text)]


def liveliest_stretch(imu: ImuSamples, seconds: float, first: float = 0.0, last: float = 1.0) -> tuple[int, int]:
    """The stretch [begin, end) in ns in which the IMU turns most about its second axis: where a rotation shows best.

    Args:
        imu: finite samples in order of time.
        seconds: its length.
        first, last: the part of the recording to look in, from 0 to 1.
    """
    windows = _windows(imu, _WINDOW_S)
    if not windows:
        return int(imu.time_ns[0]), int(imu.time_ns[-1]) + 1
    windows = windows[int(first * len(windows)) : max(int(last * len(windows)), int(first * len(windows)) + 1)]
    rate = np.array([imu.gyro[window].mean(axis=0) for window in windows])
    length = max(round(seconds / _WINDOW_S), 1)
    starts = range(max(len(rate) - length + 1, 1))
    lively = [np.linalg.eigvalsh(np.atleast_2d(np.cov(rate[k : k + length].T)))[1] if len(rate) > 1 else 0.0 for k in starts]
    best = int(np.argmax(np.nan_to_num(lively)))
    end = min(best + length, len(windows)) - 1
    return int(imu.time_ns[windows[best].start]), int(imu.time_ns[windows[end].stop - 1]) + 1


def _numbers(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
