"""Findings about positions by satellite that need no odometry; `boxplus slam` compares them with one (docs/gnss.md)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.info import Evidence
from boxplus.recordings.stream_checks import check_rate
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.satellites.geodesy import EnuFrame, utm_epsg
from boxplus.sensors.satellites.gnss import STATUS_NAMES, GnssFixes

_APART = 10.0  # [m] more than antennas of one vehicle and their noise
_BEYOND = "beyond 90° of latitude or 180° of longitude"
_LEAST_SIGMA = 1e-3  # no receiver knows a position to less than a millimetre
_FASTEST = 100.0  # [m/s] between two fixes; faster is a jump
_WINDOW_NS = 2_000_000_000
_LEAST_SPEED = 1.5  # [m/s] below it the course is noise
_LEAST_TURN = 0.5  # [rad] in all, for the sense of turning to say something


def check_gnss(fixes: GnssFixes, scan_ns: NDArray[np.int64], imu: ImuSamples) -> list[Evidence]:
    """Rate, gaps, status, noise, place and time of fixes, and whether they turn as the IMU does.

    Args:
        fixes: all of the recording. scan_ns: (N,) times of the scans. imu: finite samples.
    """
    found = _check_status(fixes)
    if len(fixes) < 2:
        text = f"{len(fixes)} usable positions: the map cannot be laid onto the Earth"
        return [*found, Evidence("gnss_rate", "none", "warning", text)]
    found += check_rate("gnss", fixes.time_ns, gap_factor=3.0)
    found.append(_check_sigma(fixes))
    frame = EnuFrame(*np.median(fixes.lat_lon_alt, axis=0).tolist())
    p_enu = frame.to_enu(fixes.lat_lon_alt)
    found.append(_check_place(frame, p_enu))
    found.append(_check_time(fixes, scan_ns))
    steps = np.linalg.norm(np.diff(p_enu[:, :2], axis=0), axis=1)
    jumps = int((steps > np.maximum(_FASTEST * np.diff(fixes.time_ns) * 1e-9, 10.0)).sum())
    text = f"{jumps} of {len(steps)} steps are faster than {_FASTEST:g} m/s, the longest goes {steps.max():.1f} m"
    found.append(Evidence("gnss_jumps", str(jumps), "warning" if jumps else "ok", text))
    return found + _check_sense(fixes, p_enu, imu)


def check_receivers(receivers: Mapping[str, GnssFixes]) -> list[Evidence]:
    """Whether several receivers say the same: a datum, or heights of another kind, are off by the same everywhere.

    Args:
        receivers: fixes by topic, two at least.
    """
    (first, reference), *others = receivers.items()
    found = []
    for topic, fixes in others:
        begin, end = (reference.time_ns[0], reference.time_ns[-1]) if len(reference) else (0, 0)
        inside = (fixes.time_ns >= begin) & (fixes.time_ns <= end)
        if inside.sum() < 2:
            text = f"no fixes of {first} and {topic} at the same time: they cannot be compared"
            found.append(Evidence("gnss_receivers", "unchecked", "warning", text))
            continue
        frame = EnuFrame(*np.median(reference.lat_lon_alt, axis=0).tolist())
        p, q = frame.to_enu(reference.lat_lon_alt), frame.to_enu(fixes.lat_lon_alt[inside])
        at = np.column_stack([np.interp(fixes.time_ns[inside], reference.time_ns, p[:, k]) for k in range(3)])
        offset = np.median(q - at, axis=0)
        scatter = 1.4826 * float(np.median(np.linalg.norm(q - at - offset, axis=1)))
        ground, height = float(np.linalg.norm(offset[:2])), abs(float(offset[2]))
        listed = ", ".join(f"{x:+.1f}" for x in offset)
        text = f"{topic} lies {listed} m east, north, up of {first} (median; it scatters by {scatter:.1f} m)"
        if ground > _APART or height > 2.0 * _APART:
            kind = "another datum" if ground > _APART else "heights above the sea and above the ellipsoid"
            text += f": {kind}; which one is right, a map or a survey mark tells"
            found.append(Evidence("gnss_receivers", f"{np.linalg.norm(offset):.1f} m apart", "error", text))
        else:
            found.append(Evidence("gnss_receivers", f"{np.linalg.norm(offset):.1f} m apart", "ok", text))
    return found


def _check_status(fixes: GnssFixes) -> list[Evidence]:
    states = Counter(STATUS_NAMES.get(int(code), f"status {code}") for code in fixes.status)
    listed = ", ".join(f"{count} {name}" for name, count in states.most_common()) or "no usable position"
    left_out = ", ".join(f"{count} {reason}" for reason, count in fixes.rejected.items())
    text = f"{listed}{f'; left out: {left_out}' if left_out else ''}"
    beyond = fixes.rejected[_BEYOND]
    if beyond > len(fixes):
        text += ": latitude and longitude are swapped, or these are metres"
        return [Evidence("gnss_status", f"{len(fixes)} fixes", "error", text)]
    total = len(fixes) + sum(fixes.rejected.values())
    return [Evidence("gnss_status", f"{len(fixes)} fixes", "ok" if len(fixes) > 0.5 * total else "warning", text)]


def _check_sigma(fixes: GnssFixes) -> Evidence:
    known = fixes.has_covariance
    if not known.any():
        text = "the receiver does not say how good its positions are: gnss.sigma is taken"
        return Evidence("gnss_sigma", "unknown", "warning", text)
    variance = np.diagonal(fixes.covariance[known], axis1=1, axis2=2)
    horizontal, vertical = np.sqrt(np.median(variance[:, :2].mean(axis=1))), np.sqrt(np.median(variance[:, 2]))
    text = f"standard deviations stated, median: {horizontal:.3g} m east and north, {vertical:.3g} m up"
    if horizontal < _LEAST_SIGMA:
        return Evidence("gnss_sigma", f"{horizontal:.2g} m", "warning", f"{text}: no receiver is as good as that")
    return Evidence("gnss_sigma", f"{horizontal:.2g} m", "ok", text)


def _check_place(frame: EnuFrame, p_enu: NDArray[np.float64]) -> Evidence:
    extent = np.ptp(p_enu, axis=0)
    where = f"{abs(frame.latitude):.5f}° {'N' if frame.latitude >= 0 else 'S'}, {abs(frame.longitude):.5f}° " + (
        "E" if frame.longitude >= 0 else "W"
    )
    zone = f", EPSG {utm_epsg(frame.latitude, frame.longitude)}" if -80.0 <= frame.latitude <= 84.0 else ""
    text = (
        f"median, {frame.altitude:.0f} m above the ellipsoid{zone}; they span {extent[0]:.0f} m east, {extent[1]:.0f} m north "
        f"and {extent[2]:.0f} m up: look at the place on a map, an offset of the datum is seen nowhere else"
    )
    return Evidence("gnss_place", where, "ok", text)


def _check_time(fixes: GnssFixes, scan_ns: NDArray[np.int64]) -> Evidence:
    if not len(scan_ns):
        return Evidence("gnss_time", "unknown", "warning", "no scans to compare with")
    inside = int(((fixes.time_ns >= scan_ns.min()) & (fixes.time_ns <= scan_ns.max())).sum())
    lead = (int(fixes.time_ns[0]) - int(scan_ns.min())) * 1e-9
    text = f"{inside} of {len(fixes)} fixes were made while scans were; the first one {lead:+.1f} s after the first scan"
    if not inside:
        return Evidence("gnss_time", "no overlap", "error", f"{text}: the receiver's clock is another one, GPS time for example")
    return Evidence("gnss_time", f"{inside} inside", "ok", text)


def _check_sense(fixes: GnssFixes, p_enu: NDArray[np.float64], imu: ImuSamples) -> list[Evidence]:
    """Whether the course of the fixes turns as the IMU does about the vertical; a mirrored path turns the other way."""
    if len(imu) < 10:
        return []
    up = imu.accel.mean(axis=0)
    rate = imu.gyro @ (up / np.linalg.norm(up))
    seconds = (imu.time_ns - imu.time_ns[0]) * 1e-9
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(seconds))])
    grid = np.arange(fixes.time_ns[0], fixes.time_ns[-1], _WINDOW_NS)
    if len(grid) < 4:
        return []
    path = np.column_stack([np.interp(grid, fixes.time_ns, p_enu[:, k]) for k in range(2)])
    steps = np.diff(path, axis=0)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    by_fixes = (np.diff(course) + np.pi) % (2.0 * np.pi) - np.pi
    middle = 0.5 * (grid[1:] + grid[:-1])
    by_imu = np.diff(np.interp(middle, imu.time_ns, turned))
    speed = np.linalg.norm(steps, axis=1) / (_WINDOW_NS * 1e-9)
    moving = np.minimum(speed[1:], speed[:-1]) > _LEAST_SPEED
    by_fixes, by_imu = by_fixes[moving], by_imu[moving]
    total = float(np.abs(by_imu).sum())
    key = "gnss_turns"
    if total < _LEAST_TURN or not moving.any():
        return [Evidence(key, "unchecked", "ok", "no turns at speed: whether latitude and longitude are swapped is not seen")]
    agree = float(by_imu @ by_fixes / (np.linalg.norm(by_imu) * max(float(np.linalg.norm(by_fixes)), 1e-12)))
    slope = float(by_imu @ by_fixes / (by_imu @ by_imu))
    text = f"the course of the fixes turns {slope:+.2f} times as the IMU, correlation {agree:+.2f}"
    if agree < -0.5:
        text += ": the path is mirrored, latitude and longitude are swapped or one has the wrong sign"
        return [Evidence(key, "mirrored", "error", text)]
    if agree < 0.5:
        return [Evidence(key, "unclear", "warning", f"{text}: slow, noisy, or of another vehicle")]
    return [Evidence(key, f"{slope:+.2f}", "ok", text)]
