"""Point clouds of any format, by the ending of the file's name."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import cast

from boxplus.errors import InputError
from boxplus.formats.clouds.cloud_writer import CloudWriter
from boxplus.formats.clouds.point_cloud import PointCloud

_ROOM = "boxplus.formats.clouds"
_KINDS = {
    ".ply": ("ply", "PlyWriter", "read_ply"),
    ".pcd": ("pcd", "PcdWriter", "read_pcd"),
    ".las": ("las", "LasWriter", "read_las"),
    ".laz": ("las", "LasWriter", "read_las"),
    ".e57": ("e57", "E57Writer", "read_e57"),
}
CLOUD_ENDINGS = tuple(_KINDS)


def cloud_writer(path: str | Path) -> CloudWriter:
    """A streaming writer of a PLY, PCD, LAS, LAZ or E57 file; imports what the format needs.

    Raises:
        InputError: another ending, or the format's library is not installed.
        OutputError: the file cannot be created.
    """
    module, writer, _ = _kind(Path(path))
    return cast(CloudWriter, getattr(importlib.import_module(f"{_ROOM}.{module}"), writer)(path))


def read_cloud(path: str | Path, *, everything: bool = False) -> PointCloud:
    """Read a PLY, PCD, LAS, LAZ or E57 file.

    Args:
        everything: read what it says of each point beside its intensity, too, and name what of it is left out.

    Raises:
        InputError: another ending, or as the reader of the format.
    """
    module, _, read = _kind(Path(path))
    return cast(PointCloud, getattr(importlib.import_module(f"{_ROOM}.{module}"), read)(path, everything=everything))


def _kind(path: Path) -> tuple[str, str, str]:
    if path.suffix.lower() not in _KINDS:
        raise InputError(f"a point cloud that ends in {', '.join(_KINDS)}", f"{path.name}", "choose one of these endings")
    return _KINDS[path.suffix.lower()]
