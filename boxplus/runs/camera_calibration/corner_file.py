"""Corners of a target as detectors write them: Basalt's JSON, and a table.

*JSON* (`detected_corners.json` of Basalt and of the visual navigation course of TU Munich): a list of images, each with the key
`{first: frame, second: camera}` and the pixels and numbers of its corners. A frame's number is its time where it is one, in
nanoseconds (Basalt), else a count.

*Table* (CSV): one line a corner, `time_ns,camera,corner,u,v`, or with `frame` in the place of `time_ns`; the first line names the
columns.

Pixel centres are at integers in both.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.systems.camera_calibration.corners import TargetCorners

_COLUMNS = ("camera", "corner", "u", "v")
_EARLIEST_TIME_NS = 10**12
"""1000 s: numbers above are times, frames are not counted so far."""

_ADVICE = "give Basalt's detected_corners.json, or a CSV of time_ns,camera,corner,u,v"


def read_corner_file(path: str | Path, size: tuple[int, int] | list[tuple[int, int]]) -> TargetCorners:
    """Read corners of a target.

    Args:
        path: `.json`, or a table.
        size: (width, height) of the images [px], or a list of one for each camera: no such file states it.

    Raises:
        InputError: no such file, another content, corners outside of the images or twice in one.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError("a file with corners of a target", f"{file.name}: {error.strerror}", _ADVICE) from None
    stamps, rows, pixels = _from_json(file, text) if text.lstrip()[:1] in ("{", "[") else _from_table(file, text)
    if not len(pixels):
        raise InputError("corners of a target", f"none in {file.name}", _ADVICE)
    cameras = int(rows[:, 0].max()) + 1
    missing = sorted(set(range(cameras)) - set(rows[:, 0].tolist()))
    if missing or rows[:, 0].min() < 0:
        raise InputError("cameras numbered from 0 without a gap", f"{sorted(set(rows[:, 0].tolist()))}", "number them anew")
    sizes = (size,) * cameras if isinstance(size, tuple) else tuple(size)
    if len(sizes) != cameras:
        raise InputError(f"one resolution, or {cameras}", f"{len(sizes)}", "give one for every camera of the file")
    times, frame_of = np.unique(stamps, return_inverse=True)
    is_time = int(times[0]) >= _EARLIEST_TIME_NS
    return TargetCorners(
        names=tuple(str(time) for time in times.tolist()),
        frame_of=frame_of.reshape(-1).astype(np.intp),
        camera_of=rows[:, 0].astype(np.intp),
        corner_of=rows[:, 1].astype(np.intp),
        pixels=pixels,
        sizes=sizes,
        time_ns=times if is_time else None,
    )


def write_corner_file(path: str | Path, corners: TargetCorners) -> None:
    """Write the table that `read_corner_file` reads.

    Raises:
        OutputError: it cannot be written.
    """
    from boxplus.formats.output import atomic_file

    head = "frame" if corners.time_ns is None else "time_ns"
    keys = [int(name) for name in corners.names] if corners.time_ns is None else corners.time_ns.tolist()
    rows = zip(corners.frame_of, corners.camera_of, corners.corner_of, corners.pixels.tolist(), strict=True)
    lines = [f"{keys[frame]},{camera},{corner},{u!r},{v!r}" for frame, camera, corner, (u, v) in rows]
    with atomic_file(path) as file:
        file.write("\n".join([f"{head},camera,corner,u,v", *lines, ""]).encode())


def _from_json(file: Path, text: str) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    stamps: list[int] = []
    rows: list[tuple[int, int]] = []
    pixels: list[tuple[float, float]] = []
    try:
        content: Any = json.loads(text)
        images = content["value0"] if isinstance(content, dict) else content
        for image in images:
            stamp, camera = int(image["key"]["first"]), int(image["key"]["second"])
            seen, numbers = image["value"]["value0"], image["value"]["value1"]
            if len(seen) != len(numbers):
                raise InputError("as many corners as numbers", f"{len(seen)} and {len(numbers)} in frame {stamp}", _ADVICE)
            stamps += [stamp] * len(seen)
            rows += [(camera, int(number)) for number in numbers]
            pixels += [(float(corner["value0"]), float(corner["value1"])) for corner in seen]
    except (KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError("corners as Basalt writes them", f"{file.name}: {type(error).__name__} {error}", _ADVICE) from None
    return _arrays(stamps, rows, pixels)


def _from_table(file: Path, text: str) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    lines = [line for line in text.splitlines() if line.strip()]
    head = [word.strip().lstrip("#").strip() for word in lines[0].split(",")] if lines else []
    if tuple(head[1:]) != _COLUMNS or head[0] not in ("time_ns", "frame"):
        got = f"{file.name} beginning with {lines[0][:60]!r}" if lines else f"nothing in {file.name}"
        raise InputError("a first line time_ns,camera,corner,u,v", got, _ADVICE)
    stamps: list[int] = []
    rows: list[tuple[int, int]] = []
    pixels: list[tuple[float, float]] = []
    for number, line in enumerate(lines[1:], 2):
        try:
            stamp, camera, corner, u, v = line.split(",")
            stamps.append(int(stamp))
            rows.append((int(camera), int(corner)))
            pixels.append((float(u), float(v)))
        except ValueError:
            raise InputError(
                "five numbers in a line, three of them whole", f"line {number}: {line[:60]!r}", "repair it"
            ) from None
    if head[0] == "time_ns" and stamps and min(stamps) < _EARLIEST_TIME_NS:
        raise InputError("times in nanoseconds", f"{min(stamps)}", "multiply seconds by 1e9, or call the column 'frame'")
    return _arrays(stamps, rows, pixels)


def _arrays(
    stamps: list[int], rows: list[tuple[int, int]], pixels: list[tuple[float, float]]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    return (
        np.array(stamps, dtype=np.int64),
        np.array(rows, dtype=np.int64).reshape(-1, 2),
        np.array(pixels, dtype=np.float64).reshape(-1, 2),
    )
