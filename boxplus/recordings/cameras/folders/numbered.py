"""Folders of numbered images: sequences of KITTI's odometry benchmark, and 7-Scenes.

KITTI (Geiger et al., CVPR 2012): image_0/, image_1/ (grey), image_2/, image_3/ (colour) with 000000.png …, rectified;
calib.txt with the projections P0 to P3 (3x4, of points in the frame of camera 0); times.txt. Some copies name the folders
image_l and image_r, and have no names in calib.txt.

7-Scenes (Shotton et al., CVPR 2013): frame-000000.color.png, .depth.png in millimetres, 65535 where there is none. The two
cameras are not registered exactly. It has no times; `camera-intrinsics.txt`, K (3x3), is not part of the format and read
where it is there.

Where there are no times, the rate has to be given.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import RecordingError
from boxplus.recordings.cameras.calibration import StatedCamera, camera_model, on_first
from boxplus.recordings.cameras.decode import Pixels
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.folders.layout import IMAGE_SUFFIXES, ImageFiles, Layout, nanoseconds, open_layout
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.info import Evidence

_KITTI_FOLDER = re.compile(r"image_(?:[0-3]|0[0-3]|l|r|left|right)")
_KITTI_FILE = re.compile(r"[0-9]+")
_SCENES_FILE = re.compile(r"frame-([0-9]{6})\.(color|depth)")
_NO_DEPTH = 65535


def is_kitti_odometry(path: Path) -> bool:
    """Whether this folder is a sequence of KITTI's odometry benchmark."""
    return (path / "calib.txt").is_file() and bool(_kitti_folders(path))


def is_seven_scenes(path: Path) -> bool:
    """Whether this folder is a sequence of 7-Scenes."""
    return any(_SCENES_FILE.fullmatch(file.stem) for file in path.glob("frame-*.color.*"))


def open_kitti_odometry(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open a sequence of KITTI's odometry benchmark.

    Raises:
        RecordingError: no times and no rate, a calib.txt without the projections of these folders, no images.
    """
    folders = _kitti_folders(path)
    evidence: list[Evidence] = []
    stated = _projections(path / "calib.txt", folders)
    images: list[ImageFiles] = []
    for folder, camera in zip(folders, stated, strict=True):
        numbered = _numbered(folder)
        if not numbered:
            raise RecordingError(f"numbered images in {folder.name}", "none", "unpack the sequence again")
        times = _times(path / "times.txt", options, evidence if not images else [])
        kept = [(times(number), file) for number, file in numbered]
        images.append(ImageFiles(folder.name, folder.name, [t for t, _ in kept], [file for _, file in kept], [camera]))
    return open_layout(path, Layout("KITTI odometry sequence", images, evidence=evidence), options)


def open_seven_scenes(path: Path, options: CameraRecordingOptions) -> CameraRecording:
    """Open a sequence of 7-Scenes.

    Raises:
        RecordingError: no rate is given, no images.
    """
    text = "colours and depths of 7-Scenes are not registered exactly: expect errors at the edges of objects"
    evidence = [Evidence("registration", "inexact", "warning", text)]
    times = _times(path / "times.txt", options, evidence)
    stated: list[StatedCamera] = []
    file = path / "camera-intrinsics.txt"
    if file.is_file():
        K = _matrix(file.read_text(encoding="utf-8", errors="replace").split(), (3, 3), file.name)
        model, why = camera_model("pinhole", (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), "none", ())
        stated.append(StatedCamera(file.name, model, T_body_camera=np.eye(4), missing={} if model else {"model": why}))
    images = []
    for kind, name in (("color", "rgb"), ("depth", "depth")):
        files = sorted(f for f in path.glob(f"frame-*.{kind}.*") if f.suffix.lower() in IMAGE_SUFFIXES)
        matched = [(match, f) for f in files if (match := _SCENES_FILE.fullmatch(f.stem))]
        if not matched:
            continue
        numbers = [int(match[1]) for match, _ in matched]
        depth = kind == "depth"
        images.append(
            ImageFiles(
                name=name,
                source=f"frame-*.{kind}{matched[0][1].suffix}",
                time_ns=[times(number) for number in numbers],
                files=[f for _, f in matched],
                stated=stated,
                kind="depth" if depth else "intensity",
                depth_unit_m=1e-3 if depth else None,
                depth_unit_source="the format's definition, millimetres" if depth else "",
                convert=_without_no_depth if depth else None,
            )
        )
    return open_layout(path, Layout("7-Scenes sequence", images, evidence=evidence), options)


def _without_no_depth(pixels: Pixels) -> Pixels:
    return np.where(pixels == _NO_DEPTH, 0, pixels).astype(pixels.dtype)


def _kitti_folders(path: Path) -> list[Path]:
    return sorted(folder for folder in path.iterdir() if folder.is_dir() and _KITTI_FOLDER.fullmatch(folder.name))


def _numbered(folder: Path) -> list[tuple[int, Path]]:
    files = (file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and _KITTI_FILE.fullmatch(file.stem))
    return sorted((int(file.stem), file) for file in files)


class _Times:
    """Time of the image of a number: from a file with seconds on each line, or by the rate."""

    def __init__(self, time_ns: list[int], period_ns: float) -> None:
        self._time_ns, self._period_ns = time_ns, period_ns

    def __call__(self, number: int) -> int:
        if not self._time_ns:
            return round(number * self._period_ns)
        if number >= len(self._time_ns):
            raise RecordingError(
                f"a time of image {number} in times.txt", f"{len(self._time_ns)} times", "unpack the sequence again"
            )
        return self._time_ns[number]


def _times(file: Path, options: CameraRecordingOptions, evidence: list[Evidence]) -> _Times:
    if options.frame_rate_hz is not None:
        text = f"{options.frame_rate_hz:g} Hz as given; times begin with zero at image 0"
        evidence.append(Evidence("image_times", "by the rate", "ok", text))
        return _Times([], 1e9 / options.frame_rate_hz)
    if not file.is_file():
        raise RecordingError(
            "times of the images (times.txt)", f"none in {file.parent.name}", "give their rate: --frame-rate (frame_rate_hz)"
        )
    times = [nanoseconds(line.strip()) for line in file.read_text(errors="replace").splitlines() if line.strip()]
    known = [time for time in times if time is not None]
    if not known or len(known) < len(times):
        raise RecordingError("a time [s] on each line", f"something else in {file.name}", "unpack the sequence again")
    evidence.append(Evidence("image_times", file.name, "ok", f"{len(known)} times"))
    return _Times(known, 0.0)


def _matrix(cells: list[str], shape: tuple[int, int], what: str) -> NDArray[np.float64]:
    try:
        return np.array(cells, dtype=np.float64).reshape(shape)
    except ValueError:
        raise RecordingError(f"{shape[0]}x{shape[1]} numbers in {what}", f"{len(cells)} words", "download it again") from None


def _projections(file: Path, folders: list[Path]) -> list[StatedCamera]:
    """Model and mounting of each folder's camera from P = K [I | −p] (3, 4), p being its place in the frame of camera 0."""
    rows: dict[str, NDArray[np.float64]] = {}
    unnamed: list[NDArray[np.float64]] = []
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        name, colon, rest = line.partition(":")
        cells = (rest if colon else line).split()
        if len(cells) != 12:
            continue
        P = _matrix(cells, (3, 4), file.name)
        if colon:
            rows[name.strip()] = P
        else:
            unnamed.append(P)
    stated: list[StatedCamera] = []
    for index, folder in enumerate(folders):
        key = f"P{folder.name[-1]}"
        if key in rows:
            P, source = rows[key], f"{file.name}, {key}"
        elif not rows and len(unnamed) == len(folders):
            P, source = unnamed[index], f"{file.name}, row {index}"
        else:
            got = f"{', '.join(rows) or f'{len(unnamed)} rows without a name'}"
            raise RecordingError(f"the projection of {folder.name} (3x4) in {file.name}", got, "download the calibration again")
        model, why = camera_model("pinhole", (P[0, 0], P[1, 1], P[0, 2], P[1, 2]), "none", ())
        T_reference_camera = np.eye(4)
        T_reference_camera[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
        stated.append(StatedCamera(source, model, None, T_reference_camera, missing={} if model else {"model": why}))
    return [on_first(camera, stated[0]) for camera in stated]
