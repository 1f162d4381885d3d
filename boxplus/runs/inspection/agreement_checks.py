"""Findings about LiDAR and IMU together: the comparison of both sensors (docs/agreement.md) as evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.recordings.info import Evidence, RecordingInfo
from boxplus.systems.lidar_inertial_agreement.agreement import ROTATION_KNOWN_RAD, Agreement, apart
from boxplus.systems.lidar_inertial_agreement.finding import Cause, Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import (
    contradictions,
    judges_clocks,
    judges_lengths,
    judges_rotation,
    matrix_text,
)
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit
from boxplus.systems.lidar_inertial_agreement.translation import ARM, TranslationFit
from boxplus.systems.lidar_inertial_agreement.watch import clock_drift

_KEYS: dict[Cause, tuple[str, str]] = {
    "gyro_unit": ("gyro_scale", "wrong unit"),
    "gyro_sign": ("gyro_scale", "wrong sign"),
    "gyro_scale": ("gyro_scale", "wrong"),
    "not_together": ("same_platform", "no"),
    "extrinsic": ("R_imu_lidar", "contradicted"),
    "mirrored": ("points_mirrored", "yes"),
    "time_offset": ("time_offset", "wrong"),
    "clock_drift": ("clock_drift", "drifting"),
    "force_sign": ("gravity_sign", "inverted"),
    "length_scale": ("length_scale", "wrong"),
    "corrected_points": ("point_times", "points corrected before"),
    "reversed_times": ("point_times", "backwards"),
}
"""Key and value of the evidence that a contradiction becomes."""
_DECISIVE = {"gyro_scale", "same_platform", "points_mirrored", "point_times"}  # with these nothing else can be judged


@dataclass(frozen=True, slots=True)
class Compared:
    """A stretch of the recording, from `begin_s` after its start, and what comparing the sensors over it showed."""

    begin_s: float
    agreement: Agreement
    findings: Sequence[Finding]

    @classmethod
    def judged(cls, begin_s: float, agreement: Agreement, T_declared: NDArray[np.float64] | None) -> Compared:
        return cls(begin_s, agreement, contradictions(agreement, T_declared))


def check_agreement(
    compared: Sequence[Compared], info: RecordingInfo, T_declared: NDArray[np.float64] | None, lidar_time_offset_s: float = 0.0
) -> list[Evidence]:
    """What the comparisons say about units, signs, clocks, mounting and scales.

    A contradiction is an error: `boxplus lio` calls its result not to be trusted for the same reason.

    Args:
        compared: the stretches, that with the liveliest motion first.
        info: how the recording is read.
        T_declared: (4, 4) T_imu_lidar as given or recorded, or None.
        lidar_time_offset_s: what has been added to the LiDAR's times already [s].
    """
    found: dict[str, Evidence] = {}
    for stretch in compared:
        for finding in stretch.findings:
            key, value = _KEYS[finding.cause]
            text = f"{finding.text} (over {len(stretch.agreement.path)} scans from {stretch.begin_s:.1f} s after the start)"
            if finding.cause == "time_offset" and lidar_time_offset_s and stretch.agreement.rotation is not None:
                text += f"; with the {lidar_time_offset_s:+.3f} s given that makes {_sum(stretch, lidar_time_offset_s):+.3f} s"
            found.setdefault(key, Evidence(key, value, "error", text))
    in_time = sorted(compared, key=lambda stretch: stretch.begin_s)
    with_clocks = [stretch.agreement for stretch in in_time if _clocks_show(stretch)]
    drift = clock_drift(with_clocks[0], with_clocks[-1]) if len(with_clocks) > 1 else None
    if drift is not None:
        found["clock_drift"] = Evidence(*_KEYS["clock_drift"], "error", drift.text)
    # Where nothing is wrong it is said what was checked, in the stretch that shows it best, and what could not be.
    checks: list[tuple[str, Callable[[], Evidence]]] = [
        ("gyro_scale", lambda: _gyro_scale(compared, info)),
        ("time_offset", lambda: _time_offset(compared)),
        ("clock_drift", lambda: _clock_drift(with_clocks)),
        ("R_imu_lidar", lambda: _mounting(compared, T_declared)),
        ("gravity_sign", lambda: _force_sign(compared)),
        ("length_scale", lambda: _lengths(compared)),
    ]
    if not _DECISIVE & set(found):
        for key, check in checks:
            if key not in found:
                found[key] = check()
    return list(found.values())


def _sum(stretch: Compared, given_s: float) -> float:
    rotation = stretch.agreement.rotation
    return given_s + (0.0 if rotation is None else rotation.offset_s)


def _rotations(compared: Sequence[Compared]) -> list[RotationFit]:
    """Of the stretches that show unit, sign and mounting."""
    fits = [stretch.agreement.rotation for stretch in compared if judges_rotation(stretch.agreement)]
    return [fit for fit in fits if fit is not None]


def _translations(compared: Sequence[Compared]) -> list[TranslationFit]:
    """Of the stretches that show sign and scale of the accelerations."""
    fits = [stretch.agreement.translation for stretch in compared if judges_lengths(stretch.agreement)]
    return [fit for fit in fits if fit is not None]


def _clocks_show(stretch: Compared) -> bool:
    rotation = stretch.agreement.rotation
    return judges_rotation(stretch.agreement) and rotation is not None and judges_clocks(rotation)


def _why_not(compared: Sequence[Compared]) -> str:
    """Why a comparison does not decide."""
    agreement = compared[0].agreement
    if agreement.rotation is None:
        return f"{len(agreement.path)} scans could be registered within the IMU's samples, too few to compare"
    if float(np.median(agreement.path.misfit)) > 0.1 or float(agreement.path.weak.mean()) > 0.5:
        return "the scenery does not determine how the LiDAR moves"
    turning = np.degrees(np.linalg.norm(agreement.rotation.excitation))
    return (
        f"the motion does not show it: the LiDAR turns with {turning:.1f} deg/s (rms), of which the gyroscope explains "
        f"{agreement.rotation.explained:.0%}"
    )


def _gyro_scale(compared: Sequence[Compared], info: RecordingInfo) -> Evidence:
    fits = _rotations(compared)
    if not fits:
        return Evidence("gyro_scale", "unchecked", "ok", _why_not(compared))
    best = min(fits, key=lambda fit: fit.scale_std)
    return Evidence(
        "gyro_scale",
        f"{best.scale:.3f}",
        "ok",
        f"the gyroscope turns {best.scale:.3f} ± {best.scale_std:.3f} times as far as the LiDAR and explains "
        f"{best.explained:.1%} of its rotation: {info.gyro_unit} is right, and both are on one platform",
    )


def _time_offset(compared: Sequence[Compared]) -> Evidence:
    fits = [stretch.agreement.rotation for stretch in compared if _clocks_show(stretch)]
    known = [fit for fit in fits if fit is not None]
    if not known:
        return Evidence("time_offset", "unknown", "ok", _why_not(compared))
    best = min(known, key=lambda fit: fit.offset_std_s)
    value = f"{best.offset_s * 1e3:+.1f}"
    text = f"LiDAR times {value} ± {best.offset_std_s * 1e3:.1f} ms are IMU times, over {best.intervals} scan pairs"
    return Evidence("time_offset", f"{value} ms", "ok", text)


def _clock_drift(with_clocks: Sequence[Agreement]) -> Evidence:
    offsets = [agreement.rotation.offset_s for agreement in with_clocks if agreement.rotation is not None]
    if len(offsets) < 2:
        return Evidence("clock_drift", "unchecked", "ok", "fewer than two stretches show the offset of the clocks")
    seconds = float(with_clocks[-1].path.time_ns[-1] - with_clocks[0].path.time_ns[-1]) * 1e-9
    change = (offsets[-1] - offsets[0]) * 1e3
    return Evidence("clock_drift", f"{change:+.1f} ms", "ok", f"change of the clocks' offset within {seconds:.0f} s")


def _mounting(compared: Sequence[Compared], T_declared: NDArray[np.float64] | None) -> Evidence:
    fits = _rotations(compared)
    key = "R_imu_lidar"
    if not fits:
        advice = "" if T_declared is not None else "; measure the mounting and give --T-imu-lidar"
        return Evidence(key, "unchecked", "ok" if T_declared is not None else "warning", _why_not(compared) + advice)
    best = min(fits, key=lambda fit: float(fit.rotation_std[0][-1]))
    std, _ = best.rotation_std
    shown = f"std {_numbers(np.degrees(std))} deg about its principal axes"
    if T_declared is not None:
        angle, seen = apart(best, T_declared[:3, :3])
        text = (
            f"given and found rotation differ by {np.degrees(angle):.2f} deg about the {int(seen.sum())} axes that show ({shown})"
        )
        return Evidence(key, f"{np.degrees(angle):.1f} deg apart", "ok", text)
    count = int((std < ROTATION_KNOWN_RAD).sum())
    text = f"estimate R_imu_lidar = {matrix_text(best.R_imu_lidar)}; {shown}"
    arms = [fit for fit in _translations(compared) if np.sqrt(np.diag(fit.covariance)[ARM]).max() < 0.1]
    if arms:
        text += f"; p_imu_lidar = ({_numbers(arms[0].p_imu_lidar)}) m"
    text += "; 'boxplus calibrate lidar-imu' estimates it over the whole recording"
    if count == 3:
        return Evidence(key, f"± {np.degrees(std[-1]):.1f} deg", "ok", text)
    text += "; incomplete, so turn about more axes, or measure the mounting and give --T-imu-lidar"
    return Evidence(key, f"{count} of 3 axes", "warning", text)


def _force_sign(compared: Sequence[Compared]) -> Evidence:
    fits = _translations(compared)
    if not fits:
        return Evidence(
            "gravity_sign", "unchecked", "ok", "the motion does not accelerate enough to compare with the LiDAR's path"
        )
    ratio = f"{fits[0].slope:.2f} ± {fits[0].slope_std:.2f}"
    text = f"the LiDAR's accelerations are {ratio} times those of the accelerometer (1 is right)"
    return Evidence("gravity_sign", "right", "ok", text)


def _lengths(compared: Sequence[Compared]) -> Evidence:
    fits = _translations(compared)
    if not fits:
        return Evidence(
            "length_scale", "unchecked", "ok", "the motion does not accelerate enough to compare with the LiDAR's path"
        )
    best = min(fits, key=lambda fit: fit.slope_std)
    text = (
        f"lengths of the LiDAR over those of the accelerometer, which explains {best.explained:.1%} of what it could of the "
        f"LiDAR's path: {best.slope:.3f} ± {best.slope_std:.3f}"
    )
    return Evidence("length_scale", f"{best.slope:.3f}", "ok", text)


def _numbers(values: NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.2g}" for value in values)
