"""COLMAP's text files: cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.colmap_model import CAMERA_MODELS, ColmapModel
from boxplus.formats.colmap_parts import ColmapParts
from boxplus.formats.number_lines import NumberLines, read_number_lines, rest_of_line
from boxplus.formats.number_parser import INTEGER, OTHER
from boxplus.formats.output import atomic_file

FILES = ("cameras.txt", "images.txt", "points3D.txt")
_CAMERA = "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_IMAGE = "an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_OBSERVATIONS = "the observations of an image: POINTS2D[] as (X, Y, POINT3D_ID)"
_POINT = "a point: POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)"
_ADVICE = "correct the line"


def read_colmap_text(folder: Path) -> ColmapModel:
    """Read the three text files of a folder.

    Raises:
        InputError: a malformed line (the message names file and line), or files that contradict each other.
    """
    parts = ColmapParts()
    for chunk in read_number_lines(folder / FILES[0]):
        for row in np.flatnonzero(chunk.count > 0):
            _read_camera(chunk, int(row), parts)
    _read_images(folder / FILES[1], parts)
    for chunk in read_number_lines(folder / FILES[2]):
        _read_points(chunk, parts)
    return parts.assemble(folder, "text")


def _read_camera(chunk: NumberLines, row: int, parts: ColmapParts) -> None:
    words = chunk.line(row).split()
    first, count = int(chunk.first[row]), int(chunk.count[row])
    known = len(words) > 1 and words[1] in CAMERA_MODELS
    if not known or count != 4 + CAMERA_MODELS[words[1]]:
        expected = _CAMERA if known else "a camera model out of " + ", ".join(CAMERA_MODELS)
        chunk.fail(row, expected, _ADVICE)
    kinds = chunk.kinds[first : first + count]
    if kinds[0] != INTEGER or (kinds[2:4] != INTEGER).any() or (kinds[4:] == OTHER).any():
        chunk.fail(row, _CAMERA, _ADVICE)
    whole = chunk.integers[first : first + 4]
    parts.camera_ids.append(int(whole[0]))
    parts.camera_models.append(words[1])
    parts.camera_sizes.append((int(whole[2]), int(whole[3])))
    parts.camera_params.append(chunk.values[first + 4 : first + count].copy())


def _read_images(path: Path, parts: ColmapParts) -> None:
    """Lines come in pairs; the second one, of the observations, may be empty."""
    inside = False
    for chunk in read_number_lines(path):
        for row in range(len(chunk.number)):
            if inside:
                _read_observations(chunk, row, parts)
                inside = False
            elif chunk.count[row] > 0:
                _read_image(chunk, row, parts)
                inside = True
    if inside:  # the file ends after the first line of a pair
        parts.pixels.append(np.empty((0, 2)))
        parts.observed.append(np.empty(0, np.int64))


def _read_image(chunk: NumberLines, row: int, parts: ColmapParts) -> None:
    first = int(chunk.first[row])
    kinds = chunk.kinds[first : first + 9]
    if chunk.count[row] < 10 or (kinds == OTHER).any() or kinds[0] != INTEGER or kinds[8] != INTEGER:
        chunk.fail(row, _IMAGE, _ADVICE)
    parts.image_ids.append(int(chunk.integers[first]))
    parts.poses.append(chunk.values[first + 1 : first + 8].copy())
    parts.image_cameras.append(int(chunk.integers[first + 8]))
    parts.image_names.append(rest_of_line(chunk.text, int(chunk.begins[first + 9])).rstrip())


def _read_observations(chunk: NumberLines, row: int, parts: ColmapParts) -> None:
    first, count = int(chunk.first[row]), int(chunk.count[row])
    kinds = chunk.kinds[first : first + count]
    if count % 3 or (kinds == OTHER).any() or (kinds[2::3] != INTEGER).any():
        chunk.fail(row, _OBSERVATIONS, _ADVICE)
    table = chunk.values[first : first + count].reshape(-1, 3)
    parts.pixels.append(table[:, :2].copy())
    parts.observed.append(chunk.integers[first + 2 : first + count : 3].copy())


def _read_points(chunk: NumberLines, parts: ColmapParts) -> None:
    rows = np.flatnonzero(chunk.count > 0)
    if not rows.size:
        return
    first, count = chunk.first[rows].astype(np.int64), chunk.count[rows].astype(np.int64)
    bad = np.flatnonzero((count < 8) | (count % 2 != 0))
    if bad.size:
        chunk.fail(int(rows[bad[0]]), _POINT, _ADVICE)
    fixed = first[:, None] + np.arange(8)
    kinds = chunk.kinds[fixed]
    wrong = (kinds == OTHER).any(axis=1) | (kinds[:, [0, 4, 5, 6]] != INTEGER).any(axis=1)
    colors = chunk.integers[fixed[:, 4:7]]
    wrong |= ((colors < 0) | (colors > 255)).any(axis=1)
    lengths = count - 8
    ends = np.cumsum(lengths)
    tokens = np.repeat(first + 8 - (ends - lengths), lengths) + np.arange(ends[-1])
    loose = np.flatnonzero(chunk.kinds[tokens] != INTEGER)
    if loose.size:
        wrong[np.searchsorted(ends, loose[0], side="right")] = True
    if wrong.any():
        chunk.fail(int(rows[np.argmax(wrong)]), _POINT, _ADVICE)
    parts.point_ids.append(chunk.integers[first].copy())
    parts.points.append(chunk.values[fixed[:, 1:4]])
    parts.colors.append(colors.astype(np.uint8))
    parts.errors.append(chunk.values[first + 7])
    parts.track_lengths.append(lengths // 2)
    parts.tracks.append(chunk.integers[tokens].reshape(-1, 2))


def write_colmap_text(folder: Path, model: ColmapModel) -> None:
    """Write the three text files, each of which appears only when it is whole.

    Raises:
        InputError: an image name that a text file cannot hold.
        OutputError: a file cannot be written.
    """
    for name in model.image_names:
        if not name or name != name.strip() or "\n" in name or "\r" in name:
            raise InputError(
                "image names without line breaks and outer spaces", repr(name), "write the binary files, or rename it"
            )
    for name, lines in zip(FILES, (_camera_lines(model), _image_lines(model), _point_lines(model)), strict=True):
        with atomic_file(folder / name) as file:
            file.writelines(line.encode() for line in lines)


def _words(values: NDArray[np.float64]) -> str:
    return " ".join(map(repr, values.tolist()))


def _camera_lines(model: ColmapModel) -> Iterator[str]:
    yield "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for i, params in enumerate(model.camera_params):
        width, height = model.camera_sizes[i].tolist()
        yield f"{model.camera_ids[i]} {model.camera_models[i]} {width} {height} {_words(params)}\n"


def _image_lines(model: ColmapModel) -> Iterator[str]:
    yield (
        "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    starts = model.observation_starts()
    names = np.where(model.point_of >= 0, model.point_ids[model.point_of], -1) if len(model.point_ids) else model.point_of
    for i, name in enumerate(model.image_names):
        yield f"{model.image_ids[i]} {_words(model.T_camera_world[i])} {model.camera_ids[model.camera_of[i]]} {name}\n"
        own = slice(starts[i], starts[i + 1])
        pixels = model.pixels[own].tolist()
        yield " ".join(f"{x!r} {y!r} {point}" for (x, y), point in zip(pixels, names[own].tolist(), strict=True)) + "\n"


def _point_lines(model: ColmapModel) -> Iterator[str]:
    yield (
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    )
    starts, track = model.tracks()
    image = model.image_of[track]
    elements = np.column_stack([model.image_ids[image], track - model.observation_starts()[image]]).reshape(-1).tolist()
    bounds = (2 * starts).tolist()
    rows = zip(model.point_ids.tolist(), model.points.tolist(), model.colors.tolist(), model.errors.tolist(), strict=True)
    for j, (name, (x, y, z), (red, green, blue), error) in enumerate(rows):
        seen = "".join(f" {number}" for number in elements[bounds[j] : bounds[j + 1]])
        yield f"{name} {x!r} {y!r} {z!r} {red} {green} {blue} {error!r}{seen}\n"
