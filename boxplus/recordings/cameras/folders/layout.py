"""Folders with one file for each image: what their formats have in common."""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from functools import partial
from pathlib import Path

import numpy as np

from boxplus._extras import require
from boxplus.errors import RecordingError
from boxplus.recordings.cameras.calibration import StatedCamera, read_camchain, usable_mountings
from boxplus.recordings.cameras.decode import MalformedImageError, Pixels, decode_file, needs_opencv
from boxplus.recordings.cameras.events import IMU, CameraEvent, CameraRecording, Pending, StampFilter, assembled
from boxplus.recordings.cameras.imu_table import ImuTable, imu_stream
from boxplus.recordings.cameras.info import CameraRecordingInfo, ImageKind, ImuStream
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.recordings.cameras.streams import FoundCamera, camera_streams, stated_for
from boxplus.recordings.info import Evidence, Topic
from boxplus.recordings.options import check_start
from boxplus.recordings.recording import Tally
from boxplus.residuals.inertial.imu_noise import ImuNoise

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".pgm", ".ppm")
_PROBED = 5
_STAMP = re.compile(r"[0-9]{15,19}")


@dataclass(frozen=True, slots=True, eq=False)
class ImageFiles:
    """The images of one camera in a folder.

    Attributes:
        name, kind: as in `CameraStream`.
        source: the folder, relative to the recording.
        time_ns, files: of each image, in the order of the format's list.
        stated: what the format's files say of the calibration.
        depth_unit_m, depth_unit_source: of depth images.
        convert: applied to the pixels after decoding.
        registered_to: the intensity camera in whose pixels the depths lie; its calibration is theirs.
    """

    name: str
    source: str
    time_ns: Sequence[int]
    files: Sequence[Path]
    stated: Sequence[StatedCamera] = ()
    kind: ImageKind = "intensity"
    depth_unit_m: float | None = None
    depth_unit_source: str = ""
    convert: Callable[[Pixels], Pixels] | None = None
    registered_to: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """A folder as its format's reader found it.

    Attributes:
        format: for `CameraRecordingInfo`.
        images: one entry a camera.
        imu: samples, or None.
        noise, noise_source: of the IMU.
        exposures: seconds by camera and time.
        evidence: of the format's own.
    """

    format: str
    images: Sequence[ImageFiles]
    imu: ImuTable | None = None
    noise: ImuNoise | None = None
    noise_source: str = ""
    exposures: Mapping[tuple[str, int], float] = field(default_factory=dict)
    evidence: Sequence[Evidence] = ()


def open_layout(path: Path, layout: Layout, options: CameraRecordingOptions) -> CameraRecording:
    """The recording of a folder.

    Raises:
        RecordingError: no image can be decoded, OpenCV is needed and not there, a wrong calibration, a start beyond the end.
    """
    found, noise, noise_source = _found(layout, options)
    imu: ImuStream | None = None
    evidence = [*layout.evidence]
    if layout.imu is not None:
        imu, findings = imu_stream(layout.imu, noise, noise_source, options)
        evidence += findings
    cameras, findings = camera_streams(found, imu is not None)
    evidence += findings
    shift_ns = [round((camera.time_offset_s or 0.0) * 1e9) for camera in cameras]
    ends = [
        s + shift
        for images, shift in zip(layout.images, shift_ns, strict=True)
        for s in (min(images.time_ns), max(images.time_ns))
    ]
    if layout.imu is not None:
        ends += [int(layout.imu.time_ns.min()), int(layout.imu.time_ns.max())]
    first, last = min(ends), max(ends)
    check_start(options.start_s, (last - first) * 1e-9)
    start_ns = first + round(options.start_s * 1e9)
    stop_ns = last + 1 if options.duration_s is None else start_ns + round(options.duration_s * 1e9)
    topics = [Topic(images.source, f"{images.kind} images", len(images.files)) for images in layout.images]
    if imu is not None:
        topics.append(Topic(imu.source, "IMU samples", imu.count))
    info = CameraRecordingInfo(
        path=path,
        format=layout.format,
        topics=topics,
        duration_s=(last - first) * 1e-9,
        message_count=sum(topic.count for topic in topics),
        cameras=cameras,
        imu=imu,
        evidence=evidence,
    )

    def read(tally: Tally) -> Iterator[CameraEvent]:
        names = {camera.index: camera.name for camera in cameras} | {IMU: "imu"}
        stamps = StampFilter(names, tally)
        sources = [
            _image_items(images, index, shift_ns[index], layout, stamps, tally) for index, images in enumerate(layout.images)
        ]
        if layout.imu is not None:
            sources.append(_imu_items(layout.imu, stamps, tally))
        items = heapq.merge(*sources, key=lambda item: (item.time_ns, item.stream))
        return assembled((item for item in items if start_ns <= item.time_ns < stop_ns), cameras, imu, tally)

    return CameraRecording(info, read, lambda: None)


def _found(layout: Layout, options: CameraRecordingOptions) -> tuple[list[FoundCamera], ImuNoise | None, str]:
    given: dict[str, StatedCamera] = {}
    noise, noise_source = layout.noise, layout.noise_source
    if options.calibration is not None:
        rig = read_camchain(options.calibration)
        first = rig.cameras.get(layout.images[0].name, next(iter(rig.cameras.values())))
        given = usable_mountings(rig, layout.imu is not None, first, options.calibration.name)
        if rig.noise is not None:
            noise, noise_source = rig.noise, options.calibration.name
    count = sum(images.kind == "intensity" for images in layout.images)
    found: list[FoundCamera] = []
    for images in layout.images:
        stated = [*images.stated]
        if images.registered_to:
            stated += _of_registered(images.registered_to, found, layout.imu is not None)
        elif options.calibration is not None and (images.kind == "intensity" or images.name in given):
            stated = stated_for(given, images.name, count, options.calibration.name) + stated
        unit, unit_source = images.depth_unit_m, images.depth_unit_source
        if images.kind == "depth" and options.depth_unit_m is not None:
            unit, unit_source = options.depth_unit_m, "the option depth_unit_m"
        found.append(
            FoundCamera(
                name=images.name,
                kind=images.kind,
                source=images.source,
                time_ns=images.time_ns,
                count=len(images.files),
                size=first_size(images),
                stated=stated,
                depth_unit_m=unit,
                depth_unit_source=unit_source,
            )
        )
    return found, noise, noise_source


def _of_registered(name: str, found: Sequence[FoundCamera], has_imu: bool) -> list[StatedCamera]:
    """The calibration of the camera `name` for depths that are registered to it."""
    same = [replace(c, source=f"{c.source} (of {name})") for camera in found if camera.name == name for c in camera.stated]
    if not has_imu and found and found[0].name == name and all(camera.T_body_camera is None for camera in same):
        same.append(StatedCamera(f"the format's definition, registered to {name}", T_body_camera=np.eye(4)))
    return same


def first_size(images: ImageFiles) -> tuple[int, int]:
    """(width, height) of the first image that can be decoded."""
    reason = "no files"
    for file in images.files[:_PROBED]:
        try:
            data = file.read_bytes()
            if needs_opencv(data):
                require("cv2", f"to decode the images in {images.source}", RecordingError)
            pixels = decode_file(data)
        except MalformedImageError as error:
            reason = f"{file.name}: {error}"
        except OSError as error:
            reason = f"{file.name}: {error.strerror}"
        else:
            return int(pixels.shape[1]), int(pixels.shape[0])
    raise RecordingError(f"images in {images.source}", reason, "copy the recording again, or leave this camera out")


def _load(file: Path, convert: Callable[[Pixels], Pixels] | None) -> Pixels:
    pixels = decode_file(file.read_bytes())
    return pixels if convert is None else convert(pixels)


def _image_items(
    images: ImageFiles, camera: int, shift_ns: int, layout: Layout, stamps: StampFilter, tally: Tally
) -> Iterator[Pending]:
    for stamp_ns, file in zip(images.time_ns, images.files, strict=True):
        tally.done += 1
        if stamps.takes(camera, stamp_ns):
            exposure_s = layout.exposures.get((images.name, stamp_ns))
            yield Pending(stamp_ns + shift_ns, camera, partial(_load, file, images.convert), (), exposure_s)


def _imu_items(imu: ImuTable, stamps: StampFilter, tally: Tally) -> Iterator[Pending]:
    for stamp_ns, values in zip(imu.time_ns.tolist(), imu.values.tolist(), strict=True):
        tally.done += 1
        if stamps.takes(IMU, stamp_ns):
            yield Pending(stamp_ns, IMU, None, tuple(values))


def nanoseconds(text: str) -> int | None:
    """Seconds in decimal notation as integer nanoseconds, without the rounding of a float; None: not a time."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        return None
    return int((value * 1_000_000_000).to_integral_value()) if value.is_finite() and abs(value) < 10**10 else None


def stamped_files(folder: Path) -> list[tuple[int, Path]]:
    """Images named by their time in nanoseconds, in order. A name that is no time is left out."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    return sorted((int(file.stem), file) for file in files if _STAMP.fullmatch(file.stem))


def read_exposures(file: Path) -> dict[tuple[str, int], float]:
    """Exposure times [s] by camera and time from a table with columns `#timestamp [ns]`, `cam0 shutter [s]`; no file, none.

    Raises:
        RecordingError: the file has no such columns.
    """
    if not file.is_file():
        return {}
    lines = file.read_text(encoding="utf-8", errors="replace").splitlines()
    header = [cell.strip() for cell in (lines or [""])[0].split(",")]
    columns = {header.index(cell): cell.split()[0] for cell in header if cell.endswith("shutter [s]")}
    if header[0] != "#timestamp [ns]" or not columns:
        raise RecordingError("columns '#timestamp [ns]' and 'cam0 shutter [s]'", f"{lines[:1]} in {file.name}", "rename the file")
    exposures: dict[tuple[str, int], float] = {}
    for line in lines[1:]:
        cells = line.split(",")
        for column, name in columns.items():
            try:
                exposure_s = float(cells[column])
                if np.isfinite(exposure_s) and exposure_s > 0.0:
                    exposures[name, int(cells[0])] = exposure_s
            except (ValueError, IndexError):
                continue  # an image without its exposure
    return exposures
