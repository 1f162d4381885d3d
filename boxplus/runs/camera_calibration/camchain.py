"""A calibration as Kalibr's camchain, and how it differs from another one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.cameras import CameraModel, DoubleSphere, Equidistant
from boxplus.manifolds.nearest_rotation import nearest_rotation
from boxplus.recordings.bags.transforms import apart
from boxplus.recordings.cameras.calibration import StatedRig, inverse
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.runs.camera_calibration.summary import CalibrationSummary, mountings
from boxplus.systems.camera_calibration.calibration import CameraCalibration

IMU_MOUNTING_DOUBTS = ("imu_open", "imu_contradicts")
"""Findings after which the mounting on the IMU is not written."""

_DIFFERENT = 4.0


def camchain_text(found: CameraCalibration, summary: CalibrationSummary, noise: ImuNoise | None) -> str:
    """A camchain that `boxplus vio --calibration` reads, with standard deviations as comments.

    Mountings that are not to be trusted are left out.
    """
    doubts = [finding.text for finding in summary.findings if finding.severity == "doubt"]
    lines = [
        f"# boxplus calibrate cameras, from {Path(summary.input).name}; target: {summary.target} (all lengths scale with it)"
    ]
    lines += [f"# NOT TO BE TRUSTED: {text}" for text in doubts]
    imu_open = any(finding.code in IMU_MOUNTING_DOUBTS for finding in summary.findings)
    doubted = {camera for finding in summary.findings for camera in finding.mounting_of}
    for camera, facts in enumerate(summary.cameras):
        adjustment, number = found.of_camera(camera)
        block = _lens_block(adjustment.rig.models[number])
        block["resolution"] = list(facts.resolution)
        if facts.T_cn_cnm1 is not None and not doubted & {camera - 1, camera}:
            block["T_cn_cnm1"] = facts.T_cn_cnm1
        if facts.T_cam_imu is not None and summary.imu is not None and not imu_open and camera not in doubted:
            block["T_cam_imu"] = facts.T_cam_imu
            block["timeshift_cam_imu"] = summary.imu.timeshift_cam_imu_s
        lines.append(_yaml({facts.name: block}))
        sigmas = ", ".join(f"{name} {value:.3g}" for name, value in facts.sigmas.items())
        lines.append(f"# {facts.name}: standard deviations {sigmas}; rms {facts.rms_px:.3f} px in {facts.views} views")
    if noise is not None:
        lines.append(
            _yaml(
                {
                    "imu0": {
                        "gyroscope_noise_density": noise.gyro,
                        "accelerometer_noise_density": noise.accel,
                        "gyroscope_random_walk": noise.gyro_walk,
                        "accelerometer_random_walk": noise.accel_walk,
                    }
                }
            )
        )
    return "\n".join(line.rstrip("\n") for line in lines) + "\n"


def _lens_block(model: CameraModel) -> dict[str, Any]:
    values = [float(value) for value in model.parameters]
    if isinstance(model, DoubleSphere):
        fx, fy, cx, cy, xi, alpha = values
        return {
            "camera_model": "ds",
            "intrinsics": [xi, alpha, fx, fy, cx, cy],
            "distortion_model": "none",
            "distortion_coeffs": [],
        }
    kind = "equidistant" if isinstance(model, Equidistant) else "radtan"
    return {
        "camera_model": "pinhole",
        "intrinsics": values[:4],
        "distortion_model": kind,
        "distortion_coeffs": values[4:],
    }


def _yaml(content: dict[str, Any]) -> str:
    text: str = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=1000)
    return text


def compare(found: CameraCalibration, other: StatedRig, name: str) -> list[str]:
    """How a calibration differs from a camchain, a line each: lenses by what they do to the image, mountings.

    Lenses of different kinds have no numbers in common, so that rays are compared: how far apart both see the same directions,
    over the corners of this calibration, where the other lens may turn freely.

    Args:
        other: the camchain.
        name: of its file.
    """
    lines = []
    distances: dict[tuple[int, int], float] = {}
    stated = list(other.cameras.values())
    for camera in range(len(found.singles)):
        adjustment, number = found.of_camera(camera)
        pixels = adjustment.corners.pixels[adjustment.kept & (adjustment.corners.camera_of == number)]
        for k, there in enumerate(stated):
            if there.model is not None:
                distances[camera, k] = _apart(adjustment.rig.models[number], there.model, pixels)
        if (camera, camera) in distances:
            lines.append(
                f"cam{camera}: the lens of {name} sees the same directions {distances[camera, camera]:.2f} px (rms) apart"
            )
    crossed = [distances.get((a, b), np.nan) for a, b in ((0, 1), (1, 0))]
    straight = [distances.get((a, a), np.nan) for a in (0, 1)]
    if np.isfinite([*crossed, *straight]).all() and max(crossed) * _DIFFERENT < min(straight):
        lines.append(f"the cameras are swapped: cam0 is cam1 of {name}, {crossed[0]:.2f} px apart, and the other way round")
    T = mountings(found)
    first = stated[0].T_body_camera
    for camera in range(1, min(len(T), len(stated))):
        mine, theirs = T[camera], stated[camera].T_body_camera
        if mine is not None and theirs is not None and first is not None:
            stated_pose = inverse(first) @ theirs
            angle, apart_m = apart(stated_pose, mine)
            baselines = [float(np.linalg.norm(pose[:3, 3])) for pose in (mine, stated_pose)]
            lines.append(
                f"cam{camera} to cam0: {np.degrees(angle):.3f} deg and {apart_m * 1e3:.2f} mm from {name}; baselines "
                f"{baselines[0] * 1e3:.2f} and {baselines[1] * 1e3:.2f} mm"
            )
    return lines


def _apart(mine: CameraModel, theirs: CameraModel, pixels: NDArray[np.float64]) -> float:
    """Root mean square distance [px] at which both see the same directions, after the best rotation between them."""
    ours, found = mine.bearings(pixels)
    also, seen = theirs.bearings(pixels)
    both = found & seen
    if both.sum() < 3:
        return float("inf")
    R = nearest_rotation(also[both].T @ ours[both])
    there, visible = theirs.project(ours[both] @ R.T)
    return float(np.sqrt(np.mean(np.sum((there - pixels[both])[visible] ** 2, axis=1)))) if visible.any() else float("inf")
