"""Local maps on disk, one file each, so that a long drive needs the memory of a few (format: docs/output_folder.md)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from boxplus.errors import InputError
from boxplus.formats.output import atomic_file, make_folder
from boxplus.maps.local_maps.local_map import LocalMap

_FORMAT, _VERSION = "boxplus-local-map", 2
_NAME = re.compile(r"(\d{6,})\.npz")
_NUMBERS = ("number", "time_ns", "begin_ns", "end_ns", "scans")
_SHAPES = {"T_odo_map": (7,), "covariance": (6, 6), "path_m": ()}


class LocalMapFolder:
    """A folder of local maps, written one by one and read again by their number.

    Args:
        path: the folder; it is created by the first `write`.

    Example: `LocalMapFolder("office_slam/local_maps")[3].points`
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def file(self, number: int) -> Path:
        """Where a map lies."""
        return self.path / f"{number:06d}.npz"

    def __len__(self) -> int:
        """How many maps follow each other from number 0 on."""
        there = {int(m[1]) for path in self.path.iterdir() if (m := _NAME.fullmatch(path.name))} if self.path.is_dir() else set()
        return next(k for k in range(len(there) + 1) if k not in there)

    def write(self, local_map: LocalMap) -> None:
        """Write a map, in one step; the same bytes for the same map.

        Raises:
            OutputError: the disk is full or the folder cannot be written.
        """
        make_folder(self.path)
        content = {name: getattr(local_map, name) for name in (*_NUMBERS, *_SHAPES, "is_level", "points")}
        with atomic_file(self.file(local_map.number)) as file:
            np.savez(file, format=np.array(_FORMAT), version=np.array(_VERSION), **content)

    def __getitem__(self, number: int) -> LocalMap:
        """The map of a number.

        Raises:
            InputError: missing, damaged, or of another version; the message names the file.
        """
        path = self.file(number)
        try:
            with np.load(path, allow_pickle=False) as stored:
                if str(stored["format"]) != _FORMAT or int(stored["version"]) != _VERSION:
                    raise ValueError(f"format {stored['format']}, version {stored['version']}")
                numbers: dict[str, Any] = {name: int(stored[name]) for name in _NUMBERS}
                arrays: dict[str, Any] = {name: np.asarray(stored[name], dtype=np.float64) for name in _SHAPES}
                points, is_level = stored["points"], bool(stored["is_level"])
            fits = all(arrays[name].shape == shape and np.isfinite(arrays[name]).all() for name, shape in _SHAPES.items())
            if not fits or points.ndim != 2 or points.shape[1] != 3 or points.dtype != np.float32 or numbers["number"] != number:
                raise ValueError("arrays of another shape, or another number")
        except Exception as error:
            raise InputError(
                f"a local map (version {_VERSION} of {_FORMAT})", f"{path}: {error or type(error).__name__}",
                "leave it out, or run 'boxplus slam' again",
            ) from error  # fmt: skip
        path_m = float(arrays.pop("path_m"))
        return LocalMap(**numbers, **arrays, path_m=path_m, points=points, is_level=is_level)
