"""Calibration of cameras and IMU as files state it: Kalibr's camchain, and the numbers other files have in common with it.

Kalibr (Furgale et al., IROS 2013; github.com/ethz-asl/kalibr/wiki/yaml-formats): `T_cam_imu` maps IMU coordinates to camera
coordinates, `T_cn_cnm1` those of the camera before, `timeshift_cam_imu` is t_imu − t_camera. `T_imu_cam`, which other tools write
into the same form, is the inverse of the first. `line_delay` is the time from row to row of a rolling shutter; the middle row is
taken at the stamp.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from boxplus.cameras import CameraModel, DoubleSphere, Equidistant, Pinhole, RadialTangential
from boxplus.errors import InputError, RecordingError
from boxplus.residuals.inertial.imu_noise import ImuNoise

_ROTATION_ERROR = 1e-3
_SAME_TRANSFORM = 1e-4

LONGEST_READOUT_S = 0.2
"""No rolling shutter takes longer from the first row to the last; a line delay that says so has another unit."""

THIS_IS_THE_BODY = "the body is this camera, as there is no IMU"
"""Source of the mounting of the first camera of a recording without IMU."""


@dataclass(frozen=True, slots=True, eq=False)
class StatedCamera:
    """What one source says about one camera; what it does not say is None.

    Attributes:
        source: the file or topic, for evidence.
        model: and `size`, (width, height) of the images it belongs to [px].
        T_body_camera: camera coordinates to those of the IMU (or of the first camera, where there is no IMU), (4, 4).
        time_offset_s: t_imu − t_camera [s].
        topic: the topic the calibration was made on.
        mounting_source: where `T_body_camera` comes from, if not from `source`.
        missing: why something is None.
        line_delay_s: time from row to row of a rolling shutter [s].
        mounting_doubt: what else the source says about `T_body_camera`, a sentence; empty where nothing contradicts.
    """

    source: str
    model: CameraModel | None = None
    size: tuple[int, int] | None = None
    T_body_camera: NDArray[np.float64] | None = None
    time_offset_s: float | None = None
    topic: str = ""
    mounting_source: str = ""
    missing: Mapping[str, str] = field(default_factory=dict)
    line_delay_s: float | None = None
    mounting_doubt: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class StatedRig:
    """What one file says: cameras by name (`cam0` …), whether their mountings refer to an IMU, and the IMU's noise."""

    cameras: Mapping[str, StatedCamera]
    on_imu: bool
    noise: ImuNoise | None = None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML as OpenCV's FileStorage writes it, too."""


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.Node) -> dict[Any, Any]:
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("an opencv-matrix that is no mapping")
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_yaml(file: Path) -> dict[str, Any]:
    """The mapping in a YAML file. Raises RecordingError: no file, no YAML, or no mapping."""
    try:
        lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
        content = yaml.load("\n".join(line for line in lines if not line.startswith("%YAML")), _Loader)
    except (OSError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RecordingError("a YAML file with a calibration", f"{file.name}: {reason}", "check the file") from None
    if not isinstance(content, dict):
        raise RecordingError("a YAML file with a calibration", f"no mapping in {file.name}", "check the file")
    return content


def as_transform(values: object, what: str) -> NDArray[np.float64]:
    """A rigid transform (4, 4) from 16 numbers, in rows or not. Raises RecordingError."""
    if isinstance(values, Mapping):
        values = values.get("data")
    try:
        T = np.array(values, dtype=np.float64).reshape(4, 4)
    except (TypeError, ValueError):
        raise RecordingError(f"{what} as 4x4 numbers", f"{str(values)[:60]}", "check the calibration") from None
    R = T[:3, :3]
    rotates = np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() < _ROTATION_ERROR and np.linalg.det(R) > 0
    if not rotates or not np.allclose(T[3], (0, 0, 0, 1)):
        raise RecordingError(f"{what} as a rotation and a translation", f"{T.tolist()}", "check the calibration")
    U, _, Vt = np.linalg.svd(R)  # files round: the nearest rotation
    T[:3, :3] = U @ Vt
    return T


def inverse(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of a rigid transform (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def numbers(values: object, what: str) -> tuple[float, ...]:
    """Numbers of a list in a file. Raises RecordingError."""
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise RecordingError(f"{what} as a list of numbers", f"{values!r}", "check the calibration")
    try:
        return tuple(float(value) for value in values)
    except (TypeError, ValueError):
        raise RecordingError(f"{what} as a list of numbers", f"{values!r}", "check the calibration") from None


def camera_model(
    projection: str, intrinsics: Sequence[float], distortion: str, coefficients: Sequence[float]
) -> tuple[CameraModel | None, str]:
    """A camera model from the names and numbers of Kalibr, EuRoC or ROS, or None and why there is none.

    Raises:
        RecordingError: numbers that do not fit the model.
    """
    intrinsics, coefficients = [float(value) for value in intrinsics], [float(value) for value in coefficients]
    try:
        if projection == "pinhole" and len(intrinsics) == 4:
            fx, fy, cx, cy = intrinsics
            if distortion in ("radtan", "radial-tangential", "plumb_bob", "rational_polynomial", "none", "None", ""):
                if not any(coefficients):
                    return Pinhole(fx, fy, cx, cy), ""
                if not any(coefficients[5:]):  # k4, k5, k6 of a rational polynomial, and what may follow
                    coefficients = coefficients[:5]
                if distortion not in ("none", "None", "") and len(coefficients) in (4, 5):
                    k1, k2, p1, p2 = coefficients[:4]
                    k3 = coefficients[4] if len(coefficients) == 5 and coefficients[4] else None
                    return Pinhole(fx, fy, cx, cy, RadialTangential(k1, k2, p1, p2, k3)), ""
            if distortion in ("equidistant", "fisheye", "kannala-brandt") and len(coefficients) == 4:
                return Equidistant(fx, fy, cx, cy, *coefficients), ""
        if projection == "ds" and len(intrinsics) == 6 and distortion in ("none", "None", "") and not any(coefficients):
            xi, alpha, fx, fy, cx, cy = intrinsics
            return DoubleSphere(fx, fy, cx, cy, xi, alpha), ""
    except InputError as error:
        raise RecordingError(error.expected, error.got, "check the calibration") from None
    text = f"{len(intrinsics)} intrinsics of {projection!r} with {len(coefficients)} coefficients of {distortion!r}"
    return None, f"no camera model for {text}"


def imu_noise(block: Mapping[str, Any]) -> ImuNoise | None:
    """Noise densities by the names of Kalibr and EuRoC, or None when one is missing or not positive."""
    names = ("gyroscope_noise_density", "accelerometer_noise_density", "gyroscope_random_walk", "accelerometer_random_walk")
    try:
        return ImuNoise(*(float(block[name]) for name in names))
    except (KeyError, TypeError, ValueError):  # InputError is a ValueError
        return None


def read_camchain(file: Path) -> StatedRig:
    """A Kalibr camchain: `cam0`, `cam1` … and, in some files, `imu0`.

    Raises:
        RecordingError: no such file, no camera in it, or numbers that make no sense.
    """
    content = read_yaml(file)
    blocks = {name: block for name, block in content.items() if str(name).startswith("cam") and isinstance(block, Mapping)}
    if not blocks:
        raise RecordingError(
            "a Kalibr camchain with cam0 …", f"{file.name} with {', '.join(map(str, content))}", "check the file"
        )
    on_imu = any("T_cam_imu" in block or "T_imu_cam" in block for block in blocks.values())
    cameras: dict[str, StatedCamera] = {}
    before: NDArray[np.float64] | None = None
    for name in sorted(blocks, key=lambda key: (len(key), key)):
        block = blocks[name]
        T_body_camera = _mounting(block, f"{file.name}, {name}", before)
        if T_body_camera is None and not on_imu and not cameras:
            T_body_camera = np.eye(4)
        before = T_body_camera
        distortion = str(block.get("distortion_model", "none"))
        coefficients = block.get("distortion_coeffs", block.get("distortion_coefficients", []))
        model, why = camera_model(
            str(block.get("camera_model", "")),
            numbers(block.get("intrinsics", []), f"intrinsics in {file.name}"),
            distortion,
            numbers(coefficients, f"distortion_coeffs in {file.name}"),
        )
        size = numbers(block.get("resolution", []), f"resolution in {file.name}")
        offset = block.get("timeshift_cam_imu")
        missing = {"model": why} if model is None else {}
        if T_body_camera is None:
            missing["T_body_camera"] = f"{file.name} has neither T_cam_imu nor T_cn_cnm1 of {name}"
        cameras[name] = StatedCamera(
            source=f"{file.name}, {name}",
            model=model,
            size=(int(size[0]), int(size[1])) if len(size) == 2 else None,
            T_body_camera=T_body_camera,
            time_offset_s=None if offset is None else numbers([offset], f"timeshift_cam_imu in {file.name}")[0],
            line_delay_s=_line_delay(block, size, f"{file.name}, {name}"),
            topic=str(block.get("rostopic", "")),
            missing=missing,
        )
    imu = content.get("imu0")
    return StatedRig(cameras, on_imu, imu_noise(imu) if isinstance(imu, Mapping) else None)


def _line_delay(block: Mapping[str, Any], size: Sequence[float], what: str) -> float | None:
    """Kalibr's `line_delay` [s]. Raises RecordingError: no number, or a shutter that takes longer than any."""
    if block.get("line_delay") is None:
        return None
    (delay,) = numbers([block["line_delay"]], f"line_delay in {what}")
    rows = size[1] if len(size) == 2 else 1.0
    if not abs(delay) * rows <= LONGEST_READOUT_S:
        got = f"{delay:g} s a row, {delay * rows:g} s for {rows:g} rows, in {what}"
        raise RecordingError(f"a line_delay in seconds, {LONGEST_READOUT_S} s for all rows at most", got, "check its unit")
    return delay


def usable_mountings(rig: StatedRig, has_imu: bool, first: StatedCamera | None, source: str) -> dict[str, StatedCamera]:
    """The cameras of a rig, mounted as a recording asks: to its IMU, and where it has none, to its first camera.

    Args:
        first: the entry of the rig for the recording's first camera.
        source: the rig's file.
    """
    if not has_imu:
        return {name: on_first(camera, first) for name, camera in rig.cameras.items()}
    if rig.on_imu:
        return dict(rig.cameras)
    why = f"{source} says how the cameras are mounted to each other, not to the IMU"
    return {
        name: replace(camera, T_body_camera=None, missing={**camera.missing, "T_body_camera": why})
        for name, camera in rig.cameras.items()
    }


def on_first(camera: StatedCamera, first: StatedCamera | None) -> StatedCamera:
    """The camera as mounted to the camera `first` of the same source, which is the body where there is no IMU."""
    if camera is first:
        return replace(camera, T_body_camera=np.eye(4), mounting_source=THIS_IS_THE_BODY)
    if camera.T_body_camera is None:
        return camera
    if first is None or first.T_body_camera is None:
        why = f"{camera.source} says nothing of the first camera, which is the body"
        return replace(camera, T_body_camera=None, missing={**camera.missing, "T_body_camera": why})
    return replace(camera, T_body_camera=inverse(first.T_body_camera) @ camera.T_body_camera)


def _mounting(block: Mapping[str, Any], what: str, before: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
    """T_body_camera of one camera; `before` is that of the camera before."""
    stated: list[tuple[str, NDArray[np.float64]]] = []
    if "T_imu_cam" in block:
        stated.append(("T_imu_cam", as_transform(block["T_imu_cam"], f"T_imu_cam in {what}")))
    if "T_cam_imu" in block:
        stated.append(("T_cam_imu", inverse(as_transform(block["T_cam_imu"], f"T_cam_imu in {what}"))))
    if "T_cn_cnm1" in block and before is not None:
        stated.append(("T_cn_cnm1", before @ inverse(as_transform(block["T_cn_cnm1"], f"T_cn_cnm1 in {what}"))))
    for name, T in stated[1:]:
        difference = float(np.abs(T - stated[0][1]).max())
        if difference > _SAME_TRANSFORM:
            raise RecordingError(
                f"{stated[0][0]} and {name} in {what} that agree",
                f"they differ by {difference:.3g}",
                "one of them may be stored as its inverse: keep the right one",
            )
    return stated[0][1] if stated else None
