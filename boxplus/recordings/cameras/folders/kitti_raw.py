"""KITTI raw drives as recordings of cameras (Geiger et al., IJRR 2013; layout of the raw data development kit).

image_00/, image_01/ (grey), image_02/, image_03/ (colour), each with data/0000000000.png … and timestamps.txt; oxts/ as for the
LiDAR. The calibration of the date lies above the drive:

calib_cam_to_cam.txt: for camera i S_0i (width, height), K_0i, D_0i (k1 k2 p1 p2 k3) and R_0i, T_0i (p_i = R p_0 + T) of the
images as taken, in `extract` drives; S_rect_0i, R_rect_00 and P_rect_0i (3x4, of points in the rectified frame of camera 0) of
the rectified images in `sync` drives. Which of both the images are shows in their size.
calib_velo_to_cam.txt: p_camera0 = R p_velodyne + T (not rectified); calib_imu_to_velo.txt: p_velodyne = R p_imu + T.

The body is the IMU; without oxts it is the first camera.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.calibration import StatedCamera, camera_model, inverse, on_first
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.folders.layout import ImageFiles, Layout, first_size, open_layout
from boxplus.recordings.cameras.imu_table import ImuTable
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.info import Evidence
from boxplus.recordings.kitti import calibration_file, calibration_lines, rigid_transform, sensor_files
from boxplus.recordings.kitti_oxts import read_oxts

Values = dict[str, NDArray[np.float64]]

_FOLDER = re.compile(r"image_0[0-3]")
_CAMERAS, _VELODYNE, _IMU = "calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"
_SLOW_IMU_HZ = 50.0


def is_kitti_raw(path: Path) -> bool:
    """Whether this folder is a KITTI raw drive with images."""
    return any((folder / "timestamps.txt").is_file() and (folder / "data").is_dir() for folder in _folders(path))


def _folders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir() and _FOLDER.fullmatch(folder.name))


def open_kitti_raw(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open a drive: the folder that holds `image_00` …

    Raises:
        RecordingError: images or times are missing, or a calibration that makes no sense.
    """
    evidence: list[Evidence] = []
    imu = _imu(path, evidence)
    file = calibration_file(path, _CAMERAS)
    values = {} if file is None else calibration_lines(file)
    T_cam0_imu, why = _camera_on_imu(path) if imu is not None else (None, "")
    images: list[ImageFiles] = []
    for folder in _folders(path):
        files = sensor_files(folder, ".png")
        evidence += files.incomplete(folder.name, "image")
        bare = ImageFiles(folder.name, f"{folder.name}/data", files.time_ns.tolist(), files.paths)
        stated = [] if file is None else [_stated(values, file, folder.name[-2:], first_size(bare), T_cam0_imu, why)]
        images.append(ImageFiles(bare.name, bare.source, bare.time_ns, bare.files, stated))
    if file is None:
        text = f"no {_CAMERAS} in, beside or above the drive: download the calibration of the date, or give a camchain"
        evidence.append(Evidence("calibration", "none", "warning", text))
    if imu is None and images:
        first = next(iter(images[0].stated), None)
        images = [
            ImageFiles(one.name, one.source, one.time_ns, one.files, [on_first(camera, first) for camera in one.stated])
            for one in images
        ]
    return open_layout(path, Layout("KITTI raw drive", images, imu=imu, evidence=evidence), options)


def _imu(path: Path, evidence: list[Evidence]) -> ImuTable | None:
    if not (path / "oxts").is_dir():
        return None
    files = sensor_files(path / "oxts", ".txt")
    evidence += replace(files, missing=0).incomplete("oxts", "data file")  # missing ones are counted with the unreadable
    rows, times, unreadable = [], [], 0
    for file, time_ns in zip(files.paths, files.time_ns.tolist(), strict=True):
        values = read_oxts(file)
        if isinstance(values, str):
            unreadable += 1
            continue
        rows.append(values)
        times.append(time_ns)
    if not rows:
        raise RecordingError("IMU samples in oxts/data", f"{unreadable} files that are none", "unpack the drive again")
    rate = (len(times) - 1) / max((max(times) - min(times)) * 1e-9, 1e-9)
    if rate < _SLOW_IMU_HZ:
        text = f"{rate:.1f} Hz (a synchronised drive): too slow for visual-inertial odometry; 'extract' drives have 100 Hz"
        evidence.append(Evidence("imu_rate", f"{rate:.1f} Hz", "warning", text))
    return ImuTable("oxts/data", np.array(times, dtype=np.int64), np.array(rows), unreadable + files.missing)


def _camera_on_imu(path: Path) -> tuple[NDArray[np.float64] | None, str]:
    """T_camera0_imu, camera 0 as it is, not rectified; or None, and which file is missing."""
    T = np.eye(4)
    for name in (_VELODYNE, _IMU):
        file = calibration_file(path, name)
        if file is None:
            return None, f"no {name} in, beside or above the drive"
        T = T @ rigid_transform(calibration_lines(file), file)
    return T, ""


def _stated(
    values: Values, file: Path, number: str, size: tuple[int, int], T_cam0_imu: NDArray[np.float64] | None, why: str
) -> StatedCamera:
    """What the file says of a camera whose images have this size; mounted on camera 0 where there is no IMU."""
    taken, rectified = (_size(values, file, f"{kind}_{number}") for kind in ("S", "S_rect"))
    R_rect = values.get("R_rect_00", np.empty(0))
    if size == taken and size != rectified:
        K, D = _numbers(values, file, f"K_{number}", 9), _numbers(values, file, f"D_{number}", 5)
        model, no_model = camera_model("pinhole", (K[0], K[4], K[2], K[5]), "radtan", D.tolist())
        T_camera_cam0 = rigid_transform(values, file, f"R_{number}", f"T_{number}")
        source = f"{file.name}, camera {number} as taken"
    else:
        P = _numbers(values, file, f"P_rect_{number}", 12).reshape(3, 4)
        model, no_model = camera_model("pinhole", (P[0, 0], P[1, 1], P[0, 2], P[1, 2]), "none", ())
        if R_rect.size != 9:
            raise RecordingError("R_rect_00 (9 numbers)", f"{R_rect.size} in {file}", "download the calibration again")
        turned = rigid_transform({"R": R_rect, "T": np.zeros(3)}, file)
        shifted = np.eye(4)
        shifted[:3, 3] = np.linalg.solve(P[:, :3], P[:, 3])
        T_camera_cam0 = shifted @ turned
        source = f"{file.name}, camera {number} rectified"
        taken = rectified
    missing = {} if model is not None else {"model": no_model}
    T_body_camera: NDArray[np.float64] | None = inverse(T_camera_cam0)
    if T_cam0_imu is not None:
        T_body_camera = inverse(T_camera_cam0 @ T_cam0_imu)
    elif why:
        T_body_camera, missing = None, {**missing, "T_body_camera": why}
    return StatedCamera(source, model, taken, T_body_camera, missing=missing)


def _numbers(values: Values, file: Path, name: str, count: int) -> NDArray[np.float64]:
    found = values.get(name, np.empty(0))
    if found.size != count:
        raise RecordingError(f"{name} ({count} numbers)", f"{found.size} in {file}", "download the calibration of the date again")
    return found


def _size(values: Values, file: Path, name: str) -> tuple[int, int]:
    width, height = _numbers(values, file, name, 2)
    return int(width), int(height)
