"""COLMAP's text files: cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from boxplus.errors import InputError
from boxplus.formats.numbers.lines import NumberLines, read_number_lines, rest_of_line
from boxplus.formats.numbers.parser import INTEGER, OTHER
from boxplus.formats.numbers.writer import rows_to_text
from boxplus.formats.output import atomic_file
from boxplus.formats.reconstructions.colmap_model import CAMERA_MODELS, ColmapModel
from boxplus.formats.reconstructions.colmap_parts import ColmapParts

FILES = ("cameras.txt", "images.txt", "points3D.txt")
_CAMERA = "a camera: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
_IMAGE = "an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
_OBSERVATIONS = "the observations of an image: POINTS2D[] as (X, Y, POINT3D_ID)"
_POINT = "a point: POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID, POINT2D_IDX)"
_ADVICE = "correct the line"
_POINTS_AT_ONCE = 1 << 13


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
    parts.image_names.append(rest_of_line(chunk.text, int(chunk.begins[first + 9]), "surrogateescape").rstrip())


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
    with atomic_file(folder / FILES[0]) as file:
        file.writelines(line.encode() for line in _camera_lines(model))
    with atomic_file(folder / FILES[1]) as file:
        _write_images(file, model)
    with atomic_file(folder / FILES[2]) as file:
        _write_points(file, model)


def _camera_lines(model: ColmapModel) -> Iterator[str]:
    yield "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    for i, params in enumerate(model.camera_params):
        width, height = model.camera_sizes[i].tolist()
        yield f"{model.camera_ids[i]} {model.camera_models[i]} {width} {height} {' '.join(map(repr, params.tolist()))}\n"


def _write_images(file: BinaryIO, model: ColmapModel) -> None:
    file.write(
        b"# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n"
        b"#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
    )
    starts = model.observation_starts()
    cameras = model.camera_ids[model.camera_of]
    heads, ends = rows_to_text([model.image_ids[:, None], model.T_camera_world, cameras[:, None]], separator=" ")
    for i, name in enumerate(model.image_names):
        file.write(heads[ends[i - 1] if i else 0 : ends[i]])
        file.write(name.encode(errors="surrogateescape") + b"\n")
        own = slice(starts[i], starts[i + 1])
        points = model.point_of[own].copy()
        points[points >= 0] = model.point_ids[points[points >= 0]]
        text, _ = rows_to_text([model.pixels[own], points[:, None]], separator=" ")
        file.write(text[:-1])
        file.write(b"\n")


def _write_points(file: BinaryIO, model: ColmapModel) -> None:
    file.write(
        b"# 3D point list with one line of data per point:\n"
        b"#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
    )
    starts, track = model.tracks()
    image = model.image_of[track]
    elements = np.column_stack([model.image_ids[image], track - model.observation_starts()[image]])
    for begin in range(0, len(model.point_ids), _POINTS_AT_ONCE):
        block = slice(begin, begin + _POINTS_AT_ONCE)
        own = starts[begin : begin + _POINTS_AT_ONCE + 1]
        colors = model.colors[block].astype(np.int64)
        heads, head_ends = rows_to_text(
            [model.point_ids[block, None], model.points[block], colors, model.errors[block, None]], separator=" "
        )
        tracks, track_ends = rows_to_text([elements[own[0] : own[-1]]], separator=" ")
        bounds = np.concatenate([[0], track_ends])[own - own[0]].tolist()
        at = 0
        for j, end in enumerate(head_ends.tolist()):
            line = bytes(heads[at:end]) + bytes(tracks[bounds[j] : bounds[j + 1]])
            file.write(line[:-1] + b"\n")
            at = end
