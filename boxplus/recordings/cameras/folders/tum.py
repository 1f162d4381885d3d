"""TUM RGB-D folders (Sturm et al., IROS 2012): rgb.txt and depth.txt with a time [s] and a file name on each line.

Depth images hold 1/5000 m and are registered to the colour images, as the format defines. The intrinsics are not part of
the format; they are read from `intrinsics.txt` whose head line names its columns, from `calib.yaml` (a camchain), or given.
IMU samples in `imu.csv` have the columns of EuRoC's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.calibration import StatedCamera, camera_model, numbers, read_camchain, usable_mountings
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.folders.layout import ImageFiles, Layout, nanoseconds, open_layout, read_exposures
from boxplus.recordings.cameras.imu_table import read_imu_table
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.info import Evidence

_DEPTH_UNIT_M = 1.0 / 5000.0
_ROUNDED_NS = 1_000
_INTRINSICS_HEAD = ["fx", "fy", "cx", "cy", "width", "height", "depth_factor"]


def is_tum(path: Path) -> bool:
    """Whether this folder lists its images in the way of the TUM RGB-D benchmark."""
    return (path / "rgb.txt").is_file()


def open_tum(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open such a folder.

    Raises:
        RecordingError: no images, tables or calibrations that cannot be read.
    """
    evidence: list[Evidence] = []
    imu = read_imu_table(path / "imu.csv", "imu.csv") if (path / "imu.csv").is_file() else None
    stated: list[StatedCamera] = []
    noise, unit, unit_source = None, _DEPTH_UNIT_M, "the format's definition, 1/5000 m"
    if (path / "intrinsics.txt").is_file():
        camera, factor = _intrinsics(path / "intrinsics.txt")
        stated.append(camera)
        unit, unit_source = 1.0 / factor, "intrinsics.txt"
    if (path / "calib.yaml").is_file():
        rig = read_camchain(path / "calib.yaml")
        first = next(iter(rig.cameras.values()))
        stated.insert(0, usable_mountings(rig, imu is not None, first, "calib.yaml")[next(iter(rig.cameras))])
        noise = rig.noise
    colour = _listed(path, "rgb", evidence)
    images = [ImageFiles("rgb", "rgb.txt", [t for t, _ in colour], [file for _, file in colour], stated)]
    if (path / "depth.txt").is_file():
        depth = _listed(path, "depth", evidence)
        times, files = [t for t, _ in depth], [file for _, file in depth]
        images.append(ImageFiles("depth", "depth.txt", times, files, (), "depth", unit, unit_source, registered_to="rgb"))
    exposures = _nearest(read_exposures(path / "exposure.csv"), images[0].time_ns)
    layout = Layout("TUM RGB-D folder", images, imu, noise, "calib.yaml", exposures, evidence)
    return open_layout(path, layout, options)


def _listed(path: Path, name: str, evidence: list[Evidence]) -> list[tuple[int, Path]]:
    """Times and files by rgb.txt or depth.txt; lines that name no file that is there are left out, with a finding."""
    listed: list[tuple[int, Path]] = []
    left_out = 0
    for line in (path / f"{name}.txt").read_text(encoding="utf-8", errors="replace").splitlines():
        cells = line.split()
        if not cells or cells[0].startswith("#"):
            continue
        time_ns = nanoseconds(cells[0])
        file = path / name / Path(cells[1]).name if len(cells) > 1 else path
        if time_ns is not None and file.is_file():
            listed.append((time_ns, file))
        else:
            left_out += 1
    if left_out:
        text = f"{left_out} of the {left_out + len(listed)} lines of {name}.txt have no image: these are gaps"
        evidence.append(Evidence("file", "incomplete", "warning", text))
    if not listed:
        raise RecordingError(
            f"lines with a time [s] and a file in {name}.txt", f"{left_out} others", "unpack the recording again"
        )
    return listed


def _intrinsics(file: Path) -> tuple[StatedCamera, float]:
    """Model and size by `# fx fy cx cy width height depth_factor` and the numbers below it, and the depth factor."""
    rows = [line.split() for line in file.read_text(encoding="utf-8", errors="replace").splitlines() if line.strip()]
    head = [word for word in rows[0] if word != "#"] if rows else []
    if head != _INTRINSICS_HEAD or len(rows) != 2 or len(rows[1]) != len(_INTRINSICS_HEAD):
        raise RecordingError(
            f"the head line '# {' '.join(_INTRINSICS_HEAD)}' and one line of numbers",
            f"{len(rows)} lines that begin with {' '.join(rows[0][:9]) if rows else 'nothing'} in {file.name}",
            "write them so, or give a camchain and remove the file",
        )
    fx, fy, cx, cy, width, height, factor = numbers(rows[1], file.name)
    model, _ = camera_model("pinhole", (fx, fy, cx, cy), "none", ())
    if not (np.isfinite(factor) and factor > 0.0):
        raise RecordingError(f"a depth factor in {file.name}, counts a metre", f"{factor}", "check the file")
    return StatedCamera(file.name, model, (int(width), int(height))), factor


def _nearest(exposures: dict[tuple[str, int], float], time_ns: Sequence[int]) -> dict[tuple[str, int], float]:
    """Exposures by the times of the images, which the format cuts off or rounds to microseconds."""
    told = sorted((time, exposure_s) for (name, time), exposure_s in exposures.items() if name == "cam0")
    times = np.array([time for time, _ in told], np.int64)
    found: dict[tuple[str, int], float] = {}
    for time in time_ns:
        for k in np.flatnonzero(np.abs(times - time) <= _ROUNDED_NS)[:1]:
            found["rgb", time] = told[k][1]
    return found
