"""EuRoC ASL folders (Burri et al., IJRR 2016), and folders of images named by their time, as Kalibr's bagcreater reads them.

mav0/cam0/data.csv (time [ns], file), mav0/cam0/data/, mav0/cam0/sensor.yaml (T_BS: sensor to body), mav0/imu0/data.csv,
mav0/imu0/sensor.yaml; the same without `mav0`. Without data.csv: cam0/<time [ns]>.png, cam0.yaml, imu0.csv or imu.csv, imu0.yaml.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.calibration import (
    StatedCamera,
    as_transform,
    camera_model,
    imu_noise,
    inverse,
    numbers,
    on_first,
    read_yaml,
)
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.folders.layout import ImageFiles, Layout, open_layout, read_exposures, stamped_files
from boxplus.recordings.cameras.imu_table import ImuTable, read_imu_table
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.info import Evidence

_IMU_FILES = ("imu0/data.csv", "imu0.csv", "imu.csv")


def is_euroc(path: Path) -> bool:
    """Whether this folder has cameras in the way of EuRoC."""
    return bool(_camera_folders(_root(path)))


def _root(path: Path) -> Path:
    return path / "mav0" if (path / "mav0").is_dir() else path


def _camera_folders(root: Path) -> list[Path]:
    folders = [folder for folder in root.glob("cam[0-9]*") if folder.is_dir() and folder.name[3:].isdigit()]
    return sorted(folders, key=lambda folder: int(folder.name[3:]))


def open_euroc(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open such a folder.

    Raises:
        RecordingError: no images, tables or calibrations that cannot be read.
    """
    root = _root(path)
    evidence: list[Evidence] = []
    imu, T_imu_body, noise_block, noise_source = _imu(root)
    images = [_images(folder, T_imu_body, imu is not None, evidence) for folder in _camera_folders(root)]
    if imu is None and images:
        first = next(iter(images[0].stated), None)
        images = [replace(files, stated=[on_first(camera, first) for camera in files.stated]) for files in images]
    has_lists = any((folder / "data.csv").is_file() for folder in _camera_folders(root))
    layout = Layout(
        format="EuRoC ASL folder" if has_lists else "folder of images named by their time",
        images=images,
        imu=imu,
        noise=None if noise_block is None else imu_noise(noise_block),
        noise_source=noise_source,
        exposures=next((e for e in (read_exposures(p / "exposure.csv") for p in dict.fromkeys((path, root))) if e), {}),
        evidence=evidence,
    )
    return open_layout(path, layout, options)


def _yaml_of(root: Path, name: str) -> Path | None:
    return next((file for file in (root / name / "sensor.yaml", root / f"{name}.yaml") if file.is_file()), None)


def _imu(root: Path) -> tuple[ImuTable | None, NDArray[np.float64], Mapping[str, Any] | None, str]:
    """Samples, the inverse of the IMU's T_BS, and what its file says."""
    file = next((root / name for name in _IMU_FILES if (root / name).is_file()), None)
    if file is None:
        return None, np.eye(4), None, ""
    table = read_imu_table(file, str(file.relative_to(root)))
    stated = _yaml_of(root, "imu0")
    if stated is None:
        return table, np.eye(4), None, ""
    block = read_yaml(stated)
    source = str(stated.relative_to(root))
    T_imu_body = inverse(as_transform(block["T_BS"], f"T_BS in {source}")) if "T_BS" in block else np.eye(4)
    return table, T_imu_body, block, source


def _images(folder: Path, T_imu_body: NDArray[np.float64], has_imu: bool, evidence: list[Evidence]) -> ImageFiles:
    root, name = folder.parent, folder.name
    data = folder / "data" if (folder / "data").is_dir() else folder
    listed = _listed(folder, data, evidence) if (folder / "data.csv").is_file() else stamped_files(data)
    if not listed:
        raise RecordingError(
            f"images in {name}: a data.csv with times and names, or files named by their time [ns]",
            f"{len(list(data.iterdir()))} other files",
            "unpack the recording again",
        )
    stated = _yaml_of(root, name)
    return ImageFiles(
        name=name,
        source=str(data.relative_to(root)),
        time_ns=[time_ns for time_ns, _ in listed],
        files=[file for _, file in listed],
        stated=[] if stated is None else [_stated(stated, str(stated.relative_to(root)), T_imu_body)],
    )


def _listed(folder: Path, data: Path, evidence: list[Evidence]) -> list[tuple[int, Path]]:
    """Times and files by data.csv; lines that name no file that is there are left out, with a finding."""
    listed: list[tuple[int, Path]] = []
    left_out = 0
    for line in (folder / "data.csv").read_text(encoding="utf-8", errors="replace").splitlines():
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        stamp, _, file = (part.strip() for part in line.partition(","))
        path = data / Path(file).name
        if stamp.isdigit() and file and path.is_file():
            listed.append((int(stamp), path))
        else:
            left_out += 1
    if left_out:
        text = f"{left_out} of the {left_out + len(listed)} lines of {folder.name}/data.csv have no image: these are gaps"
        evidence.append(Evidence("file", "incomplete", "warning", text))
    return listed


def _stated(file: Path, source: str, T_imu_body: NDArray[np.float64]) -> StatedCamera:
    block = read_yaml(file)
    model, why = camera_model(
        str(block.get("camera_model", "")),
        numbers(block.get("intrinsics", []), f"intrinsics in {source}"),
        str(block.get("distortion_model", "none")),
        numbers(block.get("distortion_coefficients", []), f"distortion_coefficients in {source}"),
    )
    missing = {} if model is not None else {"model": f"{source}: {why}"}
    size = numbers(block.get("resolution", []), f"resolution in {source}")
    T_body_camera = None
    if "T_BS" in block:
        T_body_camera = T_imu_body @ as_transform(block["T_BS"], f"T_BS in {source}")
    else:
        missing["T_body_camera"] = f"{source} has no T_BS"
    return StatedCamera(
        source=source,
        model=model,
        size=(int(size[0]), int(size[1])) if len(size) == 2 else None,
        T_body_camera=T_body_camera,
        missing=missing,
    )
