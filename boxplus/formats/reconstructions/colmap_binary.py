"""COLMAP's binary files: cameras.bin, images.bin and points3D.bin, little-endian."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO, NoReturn

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.formats.output import atomic_file
from boxplus.formats.reconstructions.colmap_model import CAMERA_MODELS, ColmapModel
from boxplus.formats.reconstructions.colmap_parts import ColmapParts

FILES = ("cameras.bin", "images.bin", "points3D.bin")

BLOCK = 1 << 22
"""Bytes of points3D.bin that are read at a time."""

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_OBSERVATION = np.dtype([("pixel", "<f8", 2), ("point", "<i8")])
_POINT = np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_ELEMENT = np.dtype([("image", "<u4"), ("index", "<u4")])
_POINT_BYTES, _ELEMENT_BYTES = np.uint64(_POINT.itemsize), np.uint64(_ELEMENT.itemsize)
_LENGTH_AT = np.uint64(_POINT.itemsize - 8)
_ONE, _EIGHT = np.uint64(1), np.uint64(8)
_POINTS_AT_ONCE = 1 << 16
_LONGEST_NAME = 4096
_LARGEST_IMAGE = 1 << 31
_COPY = "the file is cut, or not one of COLMAP: copy it again"
_NAMES = tuple(CAMERA_MODELS)


class _File:
    """A binary file read front to back, that says where it ends too early."""

    def __init__(self, path: Path, file: BinaryIO) -> None:
        self.path = path
        self.file = file
        self.left = path.stat().st_size

    def read(self, size: int, what: str) -> bytes:
        if size > self.left:
            self.cut(what)
        self.left -= size
        return self.file.read(size)

    def count(self, what: str, smallest: int) -> int:
        """A count that stands in the file, of things that take at least `smallest` bytes each."""
        (count,) = _COUNT.unpack(self.read(_COUNT.size, f"the number of {what}"))
        if count * smallest > self.left:
            self.cut(f"{count} {what}")
        return int(count)

    def cut(self, what: str) -> NoReturn:
        raise InputError(what, f"the end of the file ({self.path})", _COPY)

    def finish(self) -> None:
        if self.left:
            raise InputError(
                "the end of the file", f"{self.left} more bytes ({self.path})", "check that the file is one of COLMAP's models"
            )


def read_colmap_binary(folder: Path) -> ColmapModel:
    """Read the three binary files of a folder.

    Raises:
        InputError: a file is missing, cut or longer than it says, or the files contradict each other.
    """
    parts = ColmapParts()
    for name, read in zip(FILES, (_read_cameras, _read_images, _read_points), strict=True):
        path = folder / name
        try:
            with path.open("rb", buffering=1 << 20) as file:
                source = _File(path, file)
                read(source, parts)
                source.finish()
        except OSError as error:
            raise InputError(
                "a readable file", f"{path}: {error.strerror}", "check that the model has all three files"
            ) from error
    return parts.assemble(folder, "binary")


def _read_cameras(file: _File, parts: ColmapParts) -> None:
    for i in range(file.count("cameras", _CAMERA.size)):
        name, model, width, height = _CAMERA.unpack(file.read(_CAMERA.size, f"camera {i}"))
        if not 0 <= model < len(_NAMES):
            raise InputError(
                f"a camera model from 0 to {len(_NAMES) - 1}",
                f"{model}, camera {name} ({file.path})",
                "convert it to a known one",
            )
        if max(width, height) > _LARGEST_IMAGE:
            raise InputError(
                f"an image of at most {_LARGEST_IMAGE} pixels a side", f"{width} × {height}, camera {name} ({file.path})", _COPY
            )
        size = 8 * CAMERA_MODELS[_NAMES[model]]
        parts.camera_ids.append(name)
        parts.camera_models.append(_NAMES[model])
        parts.camera_sizes.append((width, height))
        parts.camera_params.append(np.frombuffer(file.read(size, f"the parameters of camera {name}"), "<f8").astype(np.float64))


def _read_images(file: _File, parts: ColmapParts) -> None:
    for i in range(file.count("images", _IMAGE.size + 1 + _COUNT.size)):
        name, *pose, camera = _IMAGE.unpack(file.read(_IMAGE.size, f"image {i}"))
        parts.image_ids.append(name)
        parts.poses.append(np.array(pose))
        parts.image_cameras.append(camera)
        parts.image_names.append(_read_name(file, name))
        count = file.count(f"observations of image {name}", _OBSERVATION.itemsize)
        records = np.frombuffer(file.read(count * _OBSERVATION.itemsize, ""), _OBSERVATION)
        parts.pixels.append(records["pixel"].astype(np.float64))
        parts.observed.append(records["point"].astype(np.int64))


def _read_name(file: _File, image: int) -> str:
    letters = bytearray()
    while len(letters) < _LONGEST_NAME:
        letter = file.read(1, f"the name of image {image}")
        if letter == b"\0":
            return letters.decode("utf-8", errors="surrogateescape")
        letters += letter
    raise InputError(
        f"the name of image {image}, ended by a zero byte", f"{_LONGEST_NAME} other bytes ({file.path})", "check what the file is"
    )


def _read_points(file: _File, parts: ColmapParts) -> None:
    total = file.count("points", _POINT.itemsize)
    done, held, wanted = 0, b"", BLOCK
    while done < total:
        block = held + file.read(min(wanted, file.left), "")
        buffer = np.frombuffer(block, np.uint8)
        records = np.empty((len(block) // _POINT.itemsize + 1) * _POINT.itemsize, np.uint8)
        elements = np.empty_like(buffer)
        count, tracked = _split_points(buffer, np.uint64(total - done), records, elements)
        if count == 0:
            # A point that is longer than the block, or cut.
            if not file.left:
                file.cut(f"{total} points")
            held, wanted = block, 2 * max(wanted, len(block))
            continue
        table = records[: count * _POINT.itemsize].view(_POINT)
        track = elements[: tracked * _ELEMENT.itemsize].view(_ELEMENT)
        parts.point_ids.append(table["id"].astype(np.int64))
        parts.points.append(table["xyz"].astype(np.float64))
        parts.colors.append(table["rgb"].copy())
        parts.errors.append(table["error"].astype(np.float64))
        parts.track_lengths.append(table["length"].astype(np.int64))
        parts.tracks.append(np.column_stack([track["image"], track["index"]]).astype(np.int64))
        held = block[count * _POINT.itemsize + tracked * _ELEMENT.itemsize :]
        done += count
        if not file.left and done < total and not held:
            file.cut(f"{total} points")
    file.left += len(held)


@kernel
def _split_points(
    block: NDArray[np.uint8], limit: np.uint64, records: NDArray[np.uint8], elements: NDArray[np.uint8]
) -> tuple[int, int]:
    """Separate the fixed parts of at most `limit` points from their tracks; returns how many points and track elements."""
    end = np.uint64(len(block))
    at, count, tracked = np.uint64(0), np.uint64(0), np.uint64(0)
    while count < limit and at + _POINT_BYTES <= end:
        length = np.uint64(0)
        for k in range(_EIGHT):
            byte = np.uint64(7) - np.uint64(k)
            length = (length << _EIGHT) | np.uint64(block[at + _LENGTH_AT + byte])
        if length > (end - at - _POINT_BYTES) // _ELEMENT_BYTES:
            break
        out = count * _POINT_BYTES
        for k in range(_POINT_BYTES):
            records[out + np.uint64(k)] = block[at + np.uint64(k)]
        at += _POINT_BYTES
        out = tracked * _ELEMENT_BYTES
        for k in range(length * _ELEMENT_BYTES):
            elements[out + np.uint64(k)] = block[at + np.uint64(k)]
        at += length * _ELEMENT_BYTES
        tracked += length
        count += _ONE
    return int(count), int(tracked)


def write_colmap_binary(folder: Path, model: ColmapModel) -> None:
    """Write the three binary files, each of which appears only when it is whole.

    Raises:
        InputError: an image name with a zero byte.
        OutputError: a file cannot be written.
    """
    for name in model.image_names:
        if "\0" in name:
            raise InputError("image names without zero bytes", repr(name), "rename the image")
    with atomic_file(folder / FILES[0]) as file:
        file.write(_COUNT.pack(len(model.camera_ids)))
        for i, params in enumerate(model.camera_params):
            kind = _NAMES.index(model.camera_models[i])
            file.write(_CAMERA.pack(model.camera_ids[i], kind, *model.camera_sizes[i].tolist()))
            file.write(params.astype("<f8").tobytes())
    with atomic_file(folder / FILES[1]) as file:
        _write_images(file, model)
    with atomic_file(folder / FILES[2]) as file:
        _write_points(file, model)


def _write_images(file: BinaryIO, model: ColmapModel) -> None:
    starts = model.observation_starts()
    records = np.empty(len(model.pixels), _OBSERVATION)
    records["pixel"] = model.pixels
    seen = model.point_of >= 0
    records["point"] = -1
    records["point"][seen] = model.point_ids[model.point_of[seen]]
    file.write(_COUNT.pack(len(model.image_ids)))
    for i, name in enumerate(model.image_names):
        camera = model.camera_ids[model.camera_of[i]]
        file.write(_IMAGE.pack(model.image_ids[i], *model.T_camera_world[i].tolist(), camera))
        file.write(name.encode("utf-8", errors="surrogateescape") + b"\0")
        file.write(_COUNT.pack(starts[i + 1] - starts[i]))
        file.write(records[starts[i] : starts[i + 1]].tobytes())


def _write_points(file: BinaryIO, model: ColmapModel) -> None:
    starts, track = model.tracks()
    image = model.image_of[track]
    elements = np.empty(len(track), _ELEMENT)
    elements["image"] = model.image_ids[image]
    elements["index"] = track - model.observation_starts()[image]
    file.write(_COUNT.pack(len(model.point_ids)))
    for begin in range(0, len(model.point_ids), _POINTS_AT_ONCE):
        end = min(begin + _POINTS_AT_ONCE, len(model.point_ids))
        records = np.empty(end - begin, _POINT)
        records["id"] = model.point_ids[begin:end]
        records["xyz"] = model.points[begin:end]
        records["rgb"] = model.colors[begin:end]
        records["error"] = model.errors[begin:end]
        records["length"] = np.diff(starts[begin : end + 1])
        own = elements[starts[begin] : starts[end]]
        block = np.empty(records.nbytes + own.nbytes, np.uint8)
        _join_points(records.view(np.uint8), own.view(np.uint8), np.diff(starts[begin : end + 1]), block)
        file.write(block.tobytes())


@kernel
def _join_points(
    records: NDArray[np.uint8], elements: NDArray[np.uint8], lengths: NDArray[np.int64], block: NDArray[np.uint8]
) -> None:
    """Put the track of each point behind its fixed part."""
    at, tracked = np.uint64(0), np.uint64(0)
    for j in range(np.uint64(len(lengths))):
        out = np.uint64(j) * _POINT_BYTES
        for k in range(_POINT_BYTES):
            block[at + np.uint64(k)] = records[out + np.uint64(k)]
        at += _POINT_BYTES
        size = np.uint64(lengths[j]) * _ELEMENT_BYTES
        for k in range(size):
            block[at + np.uint64(k)] = elements[tracked + np.uint64(k)]
        at += size
        tracked += size
