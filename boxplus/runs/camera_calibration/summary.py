"""What `run.json` holds after `boxplus calibrate cameras`: lenses, mountings, standard deviations, findings."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from boxplus.formats.output import atomic_file
from boxplus.manifolds import quaternion, se3
from boxplus.systems.camera_calibration.calibration import CameraCalibration
from boxplus.systems.camera_calibration.findings import Finding

FILES = ("camchain.yaml", "run.json", "report.html")


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class CameraFacts(_Part):
    """One camera."""

    name: str
    resolution: tuple[int, int]
    parameters: dict[str, float] = Field(description="intrinsics and distortion")
    sigmas: dict[str, float] = Field(description="their standard deviations, from the corners' noise alone")
    covariance: list[list[float]] = Field(description="of the parameters, in their order")
    halves: float | None = Field(
        description="how far even and odd views disagree, in standard deviations; null with too few views"
    )
    rms_px: float = Field(description="root mean square distance of the corners that count")
    views: int
    corners: int
    left_out: int
    coverage: float = Field(description="share of the image's cells that hold corners")
    pattern: float = Field(description="share of the squared residuals that is a pattern over the image")
    T_cn_cnm1: list[list[float]] | None = Field(None, description="camera before to this one, (4, 4)")
    mounting_sigma_deg: list[float] | None = Field(None, description="of T_cam0_cam about the axes of this camera")
    mounting_sigma_m: list[float] | None = Field(None, description="of the same, along the axes of the first camera")
    T_cam_imu: list[list[float]] | None = None


class ImuFacts(_Part):
    """The IMU; the mounting is that of the first camera."""

    timeshift_cam_imu_s: float = Field(description="t_imu − t_camera")
    sigma_deg: list[float] = Field(description="of T_imu_cam0, about the axes of the camera")
    sigma_m: list[float] = Field(description="of the same, along the axes of the IMU")
    sigma_s: float
    covariance: list[list[float]] = Field(description="[θ, p] of T_imu_cam0 and the time shift [rad, m, s]")
    bias_gyro: list[float]
    bias_accel: list[float]
    gravity_target: list[float] = Field(description="direction of free fall in the target's frame")
    target_scale: float | None = Field(description="size of the target as the IMU measures it, by the stated one; null: none")
    target_scale_sigma: float | None
    frames: int
    used_s: tuple[float, float] = Field(description="first and last of these frames, after the first image that could be used")
    session_s: float = Field(description="until the last image that could be used")
    imu_chi2: float
    corner_chi2: float


class FindingFacts(_Part):
    """See `boxplus.systems.camera_calibration.findings`."""

    code: str
    severity: Literal["refused", "doubt", "remark"]
    text: str
    mounting_of: tuple[int, ...] = Field((), description="cameras whose mounting it doubts: not in camchain.yaml")


class CalibrationSummary(_Part):
    """The content of `run.json`."""

    program: Literal["boxplus calibrate cameras"]
    versions: dict[str, str]
    started: datetime
    state: Literal["trusted", "doubtful", "refused"]
    input: str
    target: str = Field(description="every length of the result scales with the size of its tags")
    lens: str
    sigma_by_lens: dict[str, float] = Field(description="what each lens leaves [px], standard deviation of a coordinate")
    sigma_px: float
    cameras: list[CameraFacts]
    imu_input: list[str] = Field([], description="how the table of the IMU was read: units, noise, lines and times not used")
    imu: ImuFacts | None = None
    outliers: list[str] = Field(description="corners left out, the worst first: frame, camera, corner, error")
    compared: list[str] = Field(description="differences to another calibration, where one was given")
    findings: list[FindingFacts]

    def write(self, path: Path) -> None:
        """Replace the file in one step.

        Raises:
            OutputError: it cannot be written.
        """
        with atomic_file(path) as file:
            file.write(self.model_dump_json(indent=2).encode())


def state_of(findings: list[Finding]) -> Literal["trusted", "doubtful", "refused"]:
    """The state that the worst finding makes."""
    worst = {finding.severity for finding in findings}
    return "refused" if "refused" in worst else "doubtful" if "doubt" in worst else "trusted"


def mountings(found: CameraCalibration) -> list[NDArray[np.float64] | None]:
    """T_cam0_cam (4, 4) of every camera, None where the rig does not hold."""
    rig = found.rig
    return [
        np.eye(4) if camera == 0 else as_matrix(rig.rig.T_body_camera[camera]) if rig is not None and found.rig_holds else None
        for camera in range(len(found.singles))
    ]


def as_matrix(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) of a pose (7,)."""
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion.to_matrix(np.ascontiguousarray(T[None, :4]))[0]
    matrix[:3, 3] = T[4:]
    return matrix


def camera_facts(found: CameraCalibration) -> list[CameraFacts]:
    """The cameras of a calibration."""
    facts = []
    T_cam0_cam = mountings(found)
    T_cam0_imu = None if found.imu is None else as_matrix(se3.inverse(found.imu.T_imu_camera))
    for camera, single in enumerate(found.singles):
        adjustment, number = found.of_camera(camera)
        model, own = adjustment.rig.models[number], adjustment.intrinsics(number)
        covariance = adjustment.covariance[own, own]
        rows = adjustment.corners.camera_of == number
        names = model.parameter_names
        T, before = T_cam0_cam[camera], T_cam0_cam[camera - 1]
        sigma = (
            np.sqrt(np.diag(found.rig.covariance)[found.rig.mounting(camera)])
            if found.rig is not None and camera and T is not None
            else None
        )
        halves = found.halves[camera]
        facts.append(
            CameraFacts(
                name=f"cam{camera}",
                resolution=single.corners.sizes[0],
                parameters=dict(zip(names, model.parameters.tolist(), strict=True)),
                sigmas=dict(zip(names, np.sqrt(np.diag(covariance)).tolist(), strict=True)),
                covariance=covariance.tolist(),
                halves=halves if math.isfinite(halves) else None,
                rms_px=adjustment.rms_px(rows),
                views=len(np.unique(adjustment.corners.frame_of[adjustment.kept & rows])),
                corners=int((adjustment.kept & rows).sum()),
                left_out=int((~adjustment.kept & rows).sum()),
                coverage=found.images[camera].coverage,
                pattern=found.images[camera].share,
                T_cn_cnm1=(np.linalg.inv(T) @ before).tolist() if camera and T is not None and before is not None else None,
                mounting_sigma_deg=None if sigma is None else np.degrees(sigma[:3]).tolist(),
                mounting_sigma_m=None if sigma is None else sigma[3:].tolist(),
                T_cam_imu=None if T is None or T_cam0_imu is None else (np.linalg.inv(T) @ T_cam0_imu).tolist(),
            )
        )
    return facts


def imu_facts(found: CameraCalibration) -> ImuFacts | None:
    """The IMU of a calibration."""
    imu = found.imu
    if imu is None:
        return None
    sigma = np.sqrt(np.diag(imu.covariance))
    return ImuFacts(
        timeshift_cam_imu_s=imu.time_offset_s,
        sigma_deg=np.degrees(sigma[:3]).tolist(),
        sigma_m=sigma[3:6].tolist(),
        sigma_s=float(sigma[6]),
        covariance=imu.covariance.tolist(),
        bias_gyro=imu.bias_gyro.tolist(),
        bias_accel=imu.bias_accel.tolist(),
        gravity_target=imu.gravity_target.tolist(),
        target_scale=imu.scale if math.isfinite(imu.scale) else None,
        target_scale_sigma=imu.scale_sigma if math.isfinite(imu.scale_sigma) else None,
        frames=imu.frames,
        used_s=imu.used_s,
        session_s=imu.session_s,
        imu_chi2=imu.imu_chi2,
        corner_chi2=imu.corner_chi2,
    )


def outliers(found: CameraCalibration) -> list[str]:
    """Corners left out, named, the worst first."""
    named: list[tuple[float, str]] = []
    for camera in range(len(found.singles)):
        adjustment, number = found.of_camera(camera)
        rows = np.flatnonzero(~adjustment.kept & (adjustment.corners.camera_of == number))
        for row in rows:
            error = float(np.linalg.norm(adjustment.residuals[row]))
            frame, corner = adjustment.corners.names[adjustment.corners.frame_of[row]], int(adjustment.corners.corner_of[row])
            text = f"frame {frame}, cam{camera}, corner {corner} (tag {corner // 4}): "
            named.append(
                (error if math.isfinite(error) else math.inf, text + (f"{error:.2f} px" if math.isfinite(error) else "–"))
            )
    return [text for _, text in sorted(named, key=lambda pair: -pair[0])]
