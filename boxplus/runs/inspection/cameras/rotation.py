"""Do camera and IMU turn alike? Their mounting's rotation and the offset of their clocks, from how both turn.

The rotation of the camera between two images, seen from the IMU, is the integral of the angular velocity over the same time,
up to the bias: R_imu_camera Log(R_begin_end) = ∫ (ω − b) dt. For every offset of the clocks the rotation is that which aligns
both in the least squares sense (Kabsch, 1976), their means taken off, so that a constant bias cancels; the offset is where the
misfit is least. With the camera's rates c_k, mean taken off, and the variance σ² of what is left of one number, the covariance
of the rotation is σ² (Σ −[c_k]ₓ²)⁻¹.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.manifolds.nearest_rotation import nearest_rotation
from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence, Verdict
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_saturation import limits_of

_SEARCH_S = 0.15
_STEP_S = 0.001
_FEWEST = 40
_LIVELY_RAD_S = 0.05  # spread of the second axis that turns most
_OUTLIERS = 3.0
_OFFSET_S = 0.005
_ANGLE_DEG = 1.5
_CLOSER = 0.1  # by which the inverse of what is stated has to be closer than that itself, however little is known
_UNLIKE, _FAR_OFF = 0.5, 3.0
_HALF_TURN_DEG = 170.0
_HALF_TURN_OFF_DEG = 5.0  # that a principal point beside the centre, turned with the image, puts one off
_IMAGES = {
    "images turned upside down": (-1.0, -1.0, 1.0),
    "images mirrored left to right": (1.0, -1.0, -1.0),
    "images mirrored top to bottom": (-1.0, 1.0, -1.0),
}
"""What looks like a half turn of the camera: a mirrored world turns backwards about the axes that lie in the mirror."""
_COARSE = 5  # of the offsets looked at for another reading of the gyroscope
_READINGS = {
    "the gyroscope's rates have the opposite sign, or it counts in a left-handed frame": -1.0,
    "the gyroscope reports another unit: deg/s, not rad/s": float(np.pi / 180.0),
    "the gyroscope reports another unit: rad/s that was taken for deg/s": float(180.0 / np.pi),
}
"""Factors on the gyroscope's readings that would explain the camera's rotation where the readings do not, and what they say."""
_OVERLAP = 3  # rotations share images with so many others
_NO_CORNERS = np.zeros((0, 2))


@dataclass(slots=True)
class Turns:
    """Rotations of a camera between images.

    Attributes:
        begin_ns, end_ns: of each.
        rotation: Log(R_begin_end), camera frame [rad].
        images: the latest images and their times, oldest first.
        tried: pairs of images looked at.
        before, after: for each rotation the pixels (N, 2) of its corners in both images.
        followed: corners followed, for each pair of images looked at.
    """

    begin_ns: list[int] = field(default_factory=list)
    end_ns: list[int] = field(default_factory=list)
    rotation: list[NDArray[np.float64]] = field(default_factory=list)
    images: deque[tuple[int, NDArray[np.uint8]]] = field(default_factory=deque)
    tried: int = 0
    before: list[NDArray[np.float64]] = field(default_factory=list)
    after: list[NDArray[np.float64]] = field(default_factory=list)
    followed: list[int] = field(default_factory=list)

    def add(
        self,
        begin_ns: int,
        end_ns: int,
        R_end_begin: NDArray[np.float64],
        before: NDArray[np.float64] = _NO_CORNERS,
        after: NDArray[np.float64] = _NO_CORNERS,
    ) -> None:
        """Note one."""
        self.before.append(before)
        self.after.append(after)
        self.begin_ns.append(begin_ns)
        self.end_ns.append(end_ns)
        self.rotation.append(Rotation.from_matrix(R_end_begin.T).as_rotvec())


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How camera and gyroscope turn alike.

    Attributes:
        R_imu_camera: (3, 3).
        bias: of the gyroscope (3,) [rad/s].
        offset_s: to add to the camera's times [s].
        offset_std_s: standard deviation, infinite at the end of the search [s].
        unlike: share of the camera's rotation that the gyroscope does not explain.
        rotation_std: standard deviation of the rotation, largest axis [rad].
        instead: where much is unlike, another reading of the gyroscope that explains the camera's rotation; empty: none does.
    """

    R_imu_camera: NDArray[np.float64]
    bias: NDArray[np.float64]
    offset_s: float
    offset_std_s: float
    unlike: float
    rotation_std: float
    instead: str = ""


def measured_turns(turns: Turns, imu: ImuSamples) -> Turns:
    """Those that the gyroscope measured: without a sample at its limit meanwhile, whatever the offset of the clocks."""
    imu = imu.in_order()
    limits = [limit for limit in limits_of(imu) if limit.of_gyro]
    if not limits:
        return turns
    missed_ns = imu.time_ns[np.any([limit.reached(imu) for limit in limits], axis=0)]
    spare_ns = round(1e9 * _SEARCH_S)
    first = np.searchsorted(missed_ns, np.array(turns.begin_ns) - spare_ns)
    last = np.searchsorted(missed_ns, np.array(turns.end_ns) + spare_ns)
    kept = np.flatnonzero(first == last)
    return replace(
        turns,
        begin_ns=[turns.begin_ns[k] for k in kept],
        end_ns=[turns.end_ns[k] for k in kept],
        rotation=[turns.rotation[k] for k in kept],
        before=[turns.before[k] for k in kept],
        after=[turns.after[k] for k in kept],
    )


def align(turns: Turns, imu: ImuSamples) -> Alignment | str:
    """The alignment, or why there is none."""
    imu = imu.in_order()
    time_s, gyro = (imu.time_ns - imu.time_ns[0]) * 1e-9, imu.gyro
    if len(turns.rotation) < _FEWEST or len(time_s) < _FEWEST:
        return f"{len(turns.rotation)} rotations of the camera and {len(time_s)} IMU samples: too few"
    between = np.vstack([np.zeros((1, 3)), np.cumsum(0.5 * (gyro[1:] + gyro[:-1]) * np.diff(time_s)[:, None], axis=0)])
    begin, end = ((np.array(t) - imu.time_ns[0]) * 1e-9 for t in (turns.begin_ns, turns.end_ns))
    inside = (begin - _SEARCH_S > time_s[0]) & (end + _SEARCH_S < time_s[-1])
    if inside.sum() < _FEWEST:
        return f"{int(inside.sum())} rotations of the camera within the IMU's samples: too few"
    begin, end = begin[inside], end[inside]
    duration = (end - begin)[:, None]
    camera = np.array(turns.rotation)[inside] / duration
    if np.sort(np.linalg.svd(camera - camera.mean(axis=0), compute_uv=False))[1] / np.sqrt(len(camera)) < _LIVELY_RAD_S:
        return "the camera turns too little, or about one axis only"

    def gyro_over(offset: float) -> NDArray[np.float64]:
        at = [np.column_stack([np.interp(t + offset, time_s, between[:, k]) for k in range(3)]) for t in (begin, end)]
        rates: NDArray[np.float64] = (at[1] - at[0]) / duration
        return rates

    kept = np.ones(len(camera), dtype=bool)
    offsets = np.arange(-_SEARCH_S, _SEARCH_S + 0.5 * _STEP_S, _STEP_S)
    for _ in range(3):
        misfit = np.array([_misfit(gyro_over(offset)[kept], camera[kept])[1] for offset in offsets])
        best = int(np.argmin(misfit))
        R, bias, errors = _fit(gyro_over(offsets[best]), camera, kept)
        scale = 1.4826 * float(np.median(errors))
        kept = errors < max(_OUTLIERS * scale, 1e-6)
    offset, at, curvature = offsets[best], misfit[best], 0.0
    if 0 < best < len(offsets) - 1:
        low, high = misfit[best - 1], misfit[best + 1]
        curvature = max(low - 2.0 * at + high, 1e-30)
        offset += 0.5 * _STEP_S * (low - high) / curvature
    # Misfit is a sum of squares: its second derivative is twice the information times the variance of one number.
    variance = at / max(3 * kept.sum() - 7, 1)
    variance *= _OVERLAP
    centred = camera[kept] - camera[kept].mean(axis=0)
    spread = float((centred**2).sum())
    information = spread * np.eye(3) - centred.T @ centred
    unlike, instead = float(np.sqrt(at / spread)), ""
    if unlike > _UNLIKE:
        coarse = [gyro_over(offset) for offset in offsets[::_COARSE]]
        shares = {text: min(_typical_misfit(factor * gyro, camera) for gyro in coarse) for text, factor in _READINGS.items()}
        best_reading = min(shares, key=lambda text: shares[text])
        instead = best_reading if shares[best_reading] < _UNLIKE else ""
    return Alignment(
        R_imu_camera=R,
        bias=bias,
        offset_s=float(offset),
        offset_std_s=float(np.sqrt(2.0 * variance / curvature) * _STEP_S) if curvature > 0.0 else float("inf"),
        unlike=unlike,
        rotation_std=float(np.sqrt(variance / np.linalg.eigvalsh(information)[0])),
        instead=instead,
    )


def _typical_misfit(gyro: NDArray[np.float64], camera: NDArray[np.float64]) -> float:
    """The median error of the best mounting over the median rate of the camera."""
    _, _, errors = _fit(gyro, camera, np.ones(len(camera), dtype=bool))
    rates = np.linalg.norm(camera - np.median(camera, axis=0), axis=1)
    return float(np.median(errors) / max(float(np.median(rates)), 1e-9))


def _misfit(gyro: NDArray[np.float64], camera: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """R_imu_camera, and the sum of squares that it leaves."""
    a, b = gyro - gyro.mean(axis=0), camera - camera.mean(axis=0)
    R = nearest_rotation(a.T @ b)
    return R, float(((a - b @ R.T) ** 2).sum())


def _fit(
    gyro: NDArray[np.float64], camera: NDArray[np.float64], kept: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """R_imu_camera and the bias from those kept, and the error of each of all [rad/s]."""
    R, _ = _misfit(gyro[kept], camera[kept])
    bias = (gyro[kept] - camera[kept] @ R.T).mean(axis=0)
    return R, bias, np.linalg.norm(gyro - camera @ R.T - bias, axis=1)


def check_rotation(camera: CameraStream, found: Alignment | str) -> list[Evidence]:
    """Findings about the clocks and the mounting of this camera."""
    offset_key, rotation_key = f"{camera.name}_imu_time_offset", f"R_imu_{camera.name}"
    if camera.model is None:
        text = f"the intrinsics of {camera.name} are not known, so its rotation cannot be compared with the gyroscope"
        return [Evidence(rotation_key, "unchecked", "warning", text)]
    if isinstance(found, str):
        return [Evidence(rotation_key, "unchecked", "ok", f"{found}; clocks and mounting are not checked")]
    if found.unlike > _UNLIKE:
        text = (
            f"what the gyroscope does not explain is {100 * found.unlike:.0f} % of the camera's rotation, whatever the mounting"
        )
        if found.instead:
            return [Evidence(rotation_key, "unlike", "error", f"{text}: {found.instead}")]
        if found.unlike > _FAR_OFF:
            text += ": the gyroscope has another unit, or another platform, or too few corners were followed"
            return [Evidence(rotation_key, "unlike", "error", text)]
        text += ": sensors of different platforms (a mounting that is not rigid), wrong intrinsics, or too few corners"
        return [Evidence(rotation_key, "unlike", "warning", text)]
    if not np.isfinite(found.offset_std_s):
        text = f"no offset up to {_SEARCH_S * 1e3:.0f} ms fits: the clocks are further apart; synchronise them"
        return [Evidence(offset_key, "beyond the search", "error", text)]
    evidence = []
    wrong = abs(found.offset_s) > max(_OFFSET_S, 4.0 * found.offset_std_s)
    text = "camera and gyroscope turn alike when this is added to the images' times; "
    text += f"standard deviation {found.offset_std_s * 1e3:.1f} ms"
    if wrong:
        text += ": calibrate the offset of the clocks (timeshift_cam_imu), or estimate it"
    evidence.append(Evidence(offset_key, f"{found.offset_s * 1e3:+.1f} ms", "warning" if wrong else "ok", text))
    stated = camera.T_body_camera
    rotvec = np.array2string(found.R_imu_camera, precision=3, suppress_small=True, separator=", ").replace("\n", "")
    if stated is None:
        text = f"the mounting is not known; the rotations suggest {rotvec}"
        return [*evidence, Evidence(rotation_key, "estimated", "ok", text)]
    apart, inverted = (_degrees(R, found.R_imu_camera) for R in (stated[:3, :3], stated[:3, :3].T))
    verdict: Verdict = "ok"
    std = float(np.degrees(found.rotation_std))
    text = (
        f"between the mounting that is stated and the one that aligns both rotations, {rotvec}, standard deviation {std:.2f} deg"
    )
    if apart > max(_ANGLE_DEG, 4.0 * std):
        verdict = "error" if apart > 4.0 * max(_ANGLE_DEG, std) else "warning"
        fits = inverted < max(_ANGLE_DEG, min(4.0 * std, _CLOSER * apart))
        text += ": the inverse of what is stated fits" if fits else ": the stated mounting does not fit this recording"
        if apart > _HALF_TURN_DEG:
            for what, axes in _IMAGES.items():
                if _degrees(stated[:3, :3] @ np.diag(axes), found.R_imu_camera) < max(_HALF_TURN_OFF_DEG, 4.0 * std):
                    text += f"; with {what} it would"
            text += ", or the gyroscope's rates have the opposite sign: with hardly a turn about one axis both look alike"
    return [*evidence, Evidence(rotation_key, f"{apart:.2f} deg apart", verdict, text)]


def _degrees(R_a: NDArray[np.float64], R_b: NDArray[np.float64]) -> float:
    """The angle between two rotations."""
    return float(np.degrees(Rotation.from_matrix(R_a.T @ R_b).magnitude()))
