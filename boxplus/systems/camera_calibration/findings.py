"""What a calibration can be believed of: refusals, doubts and remarks, each with its numbers and what to do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion
from boxplus.systems.camera_calibration.calibration import CameraCalibration
from boxplus.systems.camera_calibration.lens import LensKind
from boxplus.systems.camera_calibration.one_camera import tilts_deg

Severity = Literal["refused", "doubt", "remark"]
Floats = NDArray[np.float64]

_FOCAL_SHARE = 0.01
_CENTRE_PX = 10.0
_MOUNTING_DEG, _MOUNTING_SHARE = 0.3, 0.05
_FEW_VIEWS = 10
_FLAT_DEG = 12.0
_PATTERN, _PATTERN_PX = 0.2, 0.5
_BETTER_LENS = 0.9
_COVERAGE = 0.6
_HALVES = 2.5
_TARGET_SHARE, _TARGET_SHIFT = 0.3, 0.01
_LEFT_OUT = 0.05
_IMU_DEG, _IMU_M, _IMU_S = 0.3, 0.01, 2e-3
_SCALE, _SIGMAS = 0.005, 4.0
_SCALE_OPEN = 0.05
_CHI2 = 2.0
_MOST_OF_SESSION = 0.95
_TWIN_CHI2 = 25.0


_VIEWS_RATIO = 4.0
_VIEWS_FOCAL, _VIEWS_CENTRE = 0.012, 0.014
"""By the focal length. EuRoC's target bends by 0.2 mm: its views differ by 0.6 % and 1.1 %."""
_QUARTER, _CENTRE_OF_QUARTER = 0.6, 0.35


@dataclass(frozen=True, slots=True)
class Finding:
    """One of them.

    Attributes:
        code: a word for programs.
        severity: `refused`: the calibration is not written; `doubt`: it is not to be trusted; `remark`: good to know.
        text: a sentence with numbers, and what to do.
        mounting_of: cameras whose mounting to the first one it doubts.
    """

    code: str
    severity: Severity
    text: str
    mounting_of: tuple[int, ...] = ()


def axis_focal(kind: LensKind, parameters: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """(2,) pixels per radian on the axis, along u and v, and their standard deviations [px].

    It is what the focal lengths of different lenses have in common: fx, and of a double sphere fx/(1 + ξ).
    """
    gradient = np.zeros((2, len(parameters)))
    stretch = 1.0 + float(parameters[4]) if kind == "ds-none" else 1.0
    focal = parameters[:2] / stretch
    gradient[0, 0] = gradient[1, 1] = 1.0 / stretch
    if kind == "ds-none":
        gradient[:, 4] = -focal / stretch
    return focal, np.asarray(np.sqrt(np.einsum("ij,jk,ik->i", gradient, covariance, gradient)))


def judge(found: CameraCalibration) -> list[Finding]:
    """All there is to say, the worst first."""
    findings = _converged(found)
    for camera in range(len(found.singles)):
        findings += _lens_determined(found, camera) + _side(found, camera)
        findings += _views(found, camera) + _pattern(found, camera)
    findings += _target(found) + _left_out(found) + _together(found) + _inertial(found)
    order = {"refused": 0, "doubt": 1, "remark": 2}
    return sorted(findings, key=lambda finding: order[finding.severity])


def _converged(found: CameraCalibration) -> list[Finding]:
    """Once for each search: that of a rig is of all its cameras."""
    cameras: dict[int, list[int]] = {}
    for camera in range(len(found.singles)):
        cameras.setdefault(id(found.of_camera(camera)[0]), []).append(camera)
    result = []
    for together in cameras.values():
        told = found.of_camera(together[0])[0].unconverged
        if told is not None:
            names = ", ".join(f"cam{camera}" for camera in together)
            result.append(Finding("unconverged", "doubt", f"{names}: {told}"))
    return result


def _lens_determined(found: CameraCalibration, camera: int) -> list[Finding]:
    adjustment, number = found.of_camera(camera)
    model, own = adjustment.rig.models[number], adjustment.intrinsics(number)
    covariance = adjustment.covariance[own, own]
    sigma = np.sqrt(np.diag(covariance))
    focal, of = axis_focal(found.lens, model.parameters, covariance)
    advice = "tilt the target by 20 to 45 deg to all sides, and show it near and far"
    result = []
    open_focal = [
        f"{name} {f:.1f} ± {s:.1f} px" for name, f, s in zip(("fx", "fy"), focal, of, strict=True) if s > _FOCAL_SHARE * f
    ]
    if open_focal:
        text = f"cam{camera}: the views do not determine the focal length: {', '.join(open_focal)} on the axis; {advice}"
        result.append(Finding("focal_open", "refused", text))
    open_centre = [
        f"{name} {model.parameters[k]:.1f} ± {sigma[k]:.1f} px" for k, name in ((2, "cx"), (3, "cy")) if sigma[k] > _CENTRE_PX
    ]
    if open_centre:
        text = f"cam{camera}: the views do not determine the centre: {', '.join(open_centre)}; {advice}"
        result.append(Finding("centre_open", "refused" if open_focal else "doubt", text))
    if not open_focal and sigma[0] > _FOCAL_SHARE * model.parameters[0]:
        names = ", ".join(model.parameter_names)
        text = (
            f"cam{camera}: {names} trade off against each other (fx ± {sigma[0]:.3g} px), although the image is determined "
            f"({focal[0]:.2f} ± {of[0]:.2f} px on the axis): do not compare single ones"
        )
        result.append(Finding("parameters_trade", "remark", text))
    if found.singles[camera].other_minimum < _TWIN_CHI2:
        text = (
            f"cam{camera}: another {found.lens} with other parameters fits as well (χ² {found.singles[camera].other_minimum:.1f} "
            "larger): the images are the same, the parameters are not to be compared with those of other calibrations"
        )
        result.append(Finding("twin", "remark", text))
    return result


def _side(found: CameraCalibration, camera: int) -> list[Finding]:
    """A mirrored image of a plane is that of its back, which no camera saw."""
    heights = found.singles[camera].rig.T_target_body[:, 6]
    heights = heights[np.isfinite(heights)]
    behind = int(np.count_nonzero(heights < 0.0))
    if 2 * behind <= len(heights):
        return []
    text = (
        f"cam{camera}: in {behind} of {len(heights)} views it stands behind the target, printed on its front: the images "
        "are mirrored, an axis of the pixels is flipped, or corners count clockwise; the centre is that of the mirror image"
    )
    return [Finding("mirrored", "doubt", text)]


def _views(found: CameraCalibration, camera: int) -> list[Finding]:
    single, image = found.singles[camera], found.images[camera]
    tilts = tilts_deg(single.rig)
    tilts = tilts[np.isfinite(tilts)]
    result = []
    if len(tilts) < _FEW_VIEWS:
        text = f"cam{camera}: {len(tilts)} views are few: single bad corners matter, and nothing can be tested; use 20 to 60"
        result.append(Finding("few_views", "remark", text))
    if float(np.percentile(tilts, 80)) < _FLAT_DEG:
        text = (
            f"cam{camera}: four of five views face the target within {_FLAT_DEG:g} deg (median {np.median(tilts):.1f}), from "
            "which focal length and distance cannot be told apart; tilt it by 20 to 45 deg"
        )
        result.append(Finding("frontal", "doubt", text))
    if image.coverage < _COVERAGE:
        text = (
            f"cam{camera}: corners cover {image.coverage:.0%} of the image; the lens is extrapolated over the rest: show the "
            "target in the corners of the image, too"
        )
        result.append(Finding("coverage", "remark", text))
    result += _views_differ(found, camera)
    result += _resolution(found, camera)
    if found.halves[camera] > _HALVES:
        text = (
            f"cam{camera}: even and odd views disagree by {found.halves[camera]:.1f} times the standard deviations: multiply "
            "these by it; blur, a target that bends or a lens of another kind make errors that are no noise"
        )
        result.append(Finding("halves", "remark", text))
    return result


def _views_differ(found: CameraCalibration, camera: int) -> list[Finding]:
    scatter, f = found.views[camera], float(found.singles[camera].rig.models[0].parameters[0])
    if scatter is None or scatter.ratio < _VIEWS_RATIO:
        return []
    if scatter.focal < _VIEWS_FOCAL and scatter.centre_px < _VIEWS_CENTRE * f:
        return []
    text = (
        f"cam{camera}: views differ by {scatter.focal:.1%} in focal length and {scatter.centre_px:.1f} px in the centre "
        f"(standard deviations between views, beyond noise; χ² is {scatter.ratio:.0f} times what one lens gives): images of "
        "several cameras in one, a zoom or focus that changes, sheared images, or a target that bends; what is found is a mean "
        "of them, and its standard deviations do not hold"
    )
    return [Finding("views_differ", "doubt", text)]


def _resolution(found: CameraCalibration, camera: int) -> list[Finding]:
    """Corners of images of half the size all lie in one quarter of those that were stated, and the centre in the middle of it."""
    corners = found.singles[camera].corners
    size = np.array(corners.sizes[0], dtype=np.float64)
    centre = found.singles[camera].rig.models[0].parameters[2:4] / size
    reach = corners.pixels.max(axis=0) / size
    if not ((reach < _QUARTER).all() and (np.abs(centre) < _CENTRE_OF_QUARTER).all()):
        return []
    text = (
        f"cam{camera}: all corners lie in the first {reach[0]:.0%} of the width and {reach[1]:.0%} of the height, and the centre "
        f"at {centre[0]:.0%} and {centre[1]:.0%}: the images are smaller than {size[0]:.0f}x{size[1]:.0f}; give --resolution of "
        "those in which the corners were found"
    )
    return [Finding("resolution", "doubt", text)]


def _pattern(found: CameraCalibration, camera: int) -> list[Finding]:
    image = found.images[camera]
    if image.share < _PATTERN:
        return []
    amplitude = math.sqrt(2.0 * image.share) * found.singles[camera].sigma_px
    least = min(found.sigma_by_lens, key=lambda kind: found.sigma_by_lens[kind])
    mine = found.sigma_by_lens[found.lens]
    other = ""
    if found.sigma_by_lens[least] < _BETTER_LENS * mine:
        other = f"; {least} leaves {found.sigma_by_lens[least]:.3f} px instead of {mine:.3f}: take --lens {least}"
    text = (
        f"cam{camera}: {image.share:.0%} of the squared residuals are a pattern over the image (rms {amplitude:.2f} px), not "
        f"noise: the lens is not quite a {found.lens}{other}"
    )
    return [Finding("lens_pattern", "doubt" if amplitude > _PATTERN_PX else "remark", text)]


def _target(found: CameraCalibration) -> list[Finding]:
    pattern = found.on_target
    if pattern.share < _TARGET_SHARE:
        return []
    share = pattern.rms_m / found.target.tag_size
    text = (
        f"the corners of the target are {pattern.rms_m * 1e3:.2f} mm (rms) from where {found.target.describe()} has them "
        f"({share:.1%} of a tag), which makes {pattern.share:.0%} of the squared residuals: it bends, or its spacing is another"
    )
    return [Finding("target_shape", "doubt" if share > _TARGET_SHIFT else "remark", text)]


def _left_out(found: CameraCalibration) -> list[Finding]:
    result = []
    for camera, single in enumerate(found.singles):
        share = float((~single.kept).mean())
        if share > _LEFT_OUT:
            text = f"cam{camera}: {share:.1%} of the corners do not fit and were left out; look at them in the report"
            result.append(Finding("left_out", "remark", text))
    of = [found.rig] if found.rig is not None and found.rig_holds else found.singles
    lost = [(adjustment.corners.names[frame], camera) for adjustment in of for frame, camera in adjustment.lost_views]
    if lost:
        named = ", ".join(f"frame {name} of cam{camera}" for name, camera in lost[:6])
        more = f" and {len(lost) - 6} more" if len(lost) > 6 else ""
        result.append(Finding("lost_views", "remark", f"images that do not fit as a whole and were left out: {named}{more}"))
    return result


def _together(found: CameraCalibration) -> list[Finding]:
    result = []
    for pair in found.pairs:
        names = f"cam{pair.first} and cam{pair.second}"
        if pair.swapped:
            frames = ", ".join(found.singles[0].corners.names[frame] for frame in pair.swapped[:6])
            text = f"{names} are swapped in {len(pair.swapped)} frames ({frames}): name their images anew"
            result.append(Finding("swapped", "doubt", text, _mounted_by(found, pair.second)))
        if pair.late_frames:
            count = abs(pair.late_frames)
            where = f"{count} frame{'s' * (count > 1)} {'behind' if pair.late_frames > 0 else 'ahead of'}"
            text = (
                f"cam{pair.second} is {where} cam{pair.first}: their mounting scatters by {pair.scatter_m * 1e3:.1f} mm, and "
                "least with that shift"
            )
            result.append(Finding("late", "doubt", text, _mounted_by(found, pair.second)))
    if len(found.singles) == 1:
        return result
    if not found.rig_holds:
        alone = math.sqrt(float(np.mean([single.sigma_px**2 for single in found.singles])))
        together = "fit nowhere" if found.rig is None else f"leave {found.rig.sigma_px:.3f} px"
        lost = 0 if found.rig is None else len(found.rig.lost_views)
        text = (
            f"the cameras together {together}, alone {alone:.3f} px, and {lost} images do not fit as a whole: they are not taken "
            "together, or the cameras moved against each other; no mounting is written. Trigger them together, or hold the "
            "target still for every image"
        )
        return [*result, Finding("not_rigid", "doubt", text, tuple(range(1, len(found.singles))))]
    for camera in range(1, len(found.singles)):
        result += _mounting(found, camera)
    return result


def _mounted_by(found: CameraCalibration, camera: int) -> tuple[int, ...]:
    """A camera, and those that are mounted to the first one through it."""
    cameras = [camera]
    for pair in found.pairs:
        if pair.first in cameras and pair.second not in cameras:
            cameras.append(pair.second)
    return tuple(cameras)


def _mounting(found: CameraCalibration, camera: int) -> list[Finding]:
    adjustment = found.rig
    if adjustment is None:
        return []
    T, own = adjustment.rig.T_body_camera[camera], adjustment.mounting(camera)
    sigma = np.sqrt(np.diag(adjustment.covariance)[own])
    baseline = float(np.linalg.norm(T[4:]))
    result = []
    if np.degrees(sigma[:3].max()) > _MOUNTING_DEG or sigma[3:].max() > max(_MOUNTING_SHARE * baseline, 1e-3):
        text = (
            f"the mounting of cam{camera} is open: ± {np.degrees(sigma[:3].max()):.2f} deg, ± {sigma[3:].max() * 1e3:.1f} mm; "
            "show the target to both cameras at once, in more places"
        )
        result.append(Finding("mounting_open", "doubt", text, _mounted_by(found, camera)))
    across = float(T[4])
    if across < -0.5 * baseline and quaternion.to_matrix(np.ascontiguousarray(T[None, :4]))[0, 2, 2] > 0.9:
        text = (
            f"cam{camera} is {-across * 1e3:.0f} mm to the left of cam0: if cam0 is meant to be the left one, the cameras are "
            "named the other way round"
        )
        result.append(Finding("left_of_first", "remark", text))
    return result


def _inertial(found: CameraCalibration) -> list[Finding]:
    imu = found.imu
    if imu is None:
        return []
    result = []
    sigma = np.sqrt(np.diag(imu.covariance))
    open_parts = [
        text
        for text, wide in (
            (f"rotation ± {np.degrees(sigma[:3].max()):.2f} deg", np.degrees(sigma[:3].max()) > _IMU_DEG),
            (f"position ± {sigma[3:6].max() * 1e3:.1f} mm", sigma[3:6].max() > _IMU_M),
            (f"clock offset ± {sigma[6] * 1e3:.2f} ms", sigma[6] > _IMU_S),
        )
        if wide
    ]
    if imu.unconverged is not None:
        result.append(Finding("imu_unconverged", "doubt", f"cameras and IMU: {imu.unconverged}"))
    if open_parts:
        text = (
            f"the motion does not determine how cam0 is mounted on the IMU: {', '.join(open_parts)}; turn and shake "
            "faster, about all axes"
        )
        result.append(Finding("imu_open", "doubt", text))
    if imu.imu_chi2 > _CHI2 or imu.corner_chi2 > _CHI2:
        text = (
            f"cameras and IMU contradict each other: the mean squares of their residuals are {imu.corner_chi2:.1f} and "
            f"{imu.imu_chi2:.1f} times what their noise allows; check units and noise of the IMU, its clock, the target's size"
        )
        result.append(Finding("imu_contradicts", "doubt", text))
    if imu.used_s[1] - imu.used_s[0] < _MOST_OF_SESSION * imu.session_s:
        text = (
            f"cameras and IMU are compared from {imu.used_s[0]:.0f} to {imu.used_s[1]:.0f} s of {imu.session_s:.0f} s of images: "
            f"{imu.frames} frames are the most that are used; nothing is known of the rest"
        )
        result.append(Finding("imu_part", "remark", text))
    if not imu.scale_sigma <= _SCALE_OPEN:
        how_far = f"± {imu.scale_sigma:.0%}" if math.isfinite(imu.scale) else "no size near the stated one fits best"
        text = (
            f"the IMU does not say how large the target is ({how_far}), and cameras alone cannot: measure the target, and shake "
            "faster, with the target in view all the time"
        )
        result.append(Finding("size_open", "remark" if math.isfinite(imu.scale) else "doubt", text))
    elif abs(imu.scale - 1.0) > max(_SIGMAS * imu.scale_sigma, _SCALE):
        size = imu.scale * found.target.tag_size
        text = (
            f"the IMU measures the target as {imu.scale:.4f} ± {imu.scale_sigma:.4f} of its stated size: a tag would have "
            f"{size:.4f} m instead of {found.target.tag_size:g}; measure it, or check the accelerometer's scale"
        )
        result.append(Finding("target_size", "doubt", text))
    return result
