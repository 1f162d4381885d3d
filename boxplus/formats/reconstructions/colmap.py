"""Sparse models of COLMAP, in its text and its binary files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.formats.output import make_folder
from boxplus.formats.reconstructions import colmap_binary, colmap_text
from boxplus.formats.reconstructions.colmap_model import ColmapModel


def read_colmap(path: str | Path) -> ColmapModel:
    """Read a sparse model: a folder with cameras, images and points3D, as .bin or .txt (.bin where it has both).

    Rigs and frames of newer COLMAP versions are not read; the poses of the images say the same.

    Args:
        path: the folder, or one of the files in it.

    Raises:
        InputError: no model there, a malformed line or record, or files that contradict each other.

    Example:
        >>> model = bp.formats.read_colmap("colmap")  # a folder with cameras, images and points3D
        >>> model.format, model.T_camera_world.shape
        ('text', (6, 7))
    """
    folder = as_path(path, "a reconstruction")
    if folder.is_file():
        if folder.name in colmap_text.FILES:
            return colmap_text.read_colmap_text(folder.parent)
        folder = folder.parent
    if (folder / colmap_binary.FILES[0]).is_file():
        return colmap_binary.read_colmap_binary(folder)
    if (folder / colmap_text.FILES[0]).is_file():
        return colmap_text.read_colmap_text(folder)
    raise InputError(
        "a COLMAP model: a folder with cameras, images and points3D, as .bin or .txt",
        f"{Path(path)}, {_what_is_there(Path(path))}",
        "give the folder that has them (often sparse/0), or one BAL file, not its folder",
    )


def write_colmap(folder: str | Path, model: ColmapModel, format: Literal["text", "binary"] | None = None) -> None:
    """Write a sparse model; each file appears only when it is whole.

    Args:
        folder: made where it does not exist.
        model: what to write.
        format: text or binary; None for the one that the model was read from.

    Raises:
        InputError: an unknown format, or an image name that the format cannot hold.
        OutputError: a file cannot be written.

    Example:
        >>> bp.formats.write_colmap("copy", bp.formats.read_colmap("colmap"), "binary")
        >>> bp.formats.read_colmap("copy").format
        'binary'
    """
    kind = model.format if format is None else format
    if kind not in ("text", "binary"):
        raise InputError("the format text or binary", repr(kind), "choose one of them")
    write = colmap_text.write_colmap_text if kind == "text" else colmap_binary.write_colmap_binary
    write(make_folder(folder), model)


def _what_is_there(path: Path) -> str:
    """Nothing, a file by itself, or the first names in a folder."""
    if not path.exists():
        return "which is not there"
    if not path.is_dir():
        return "a file beside which there is none"
    names = sorted(entry.name for entry in path.iterdir())
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return f"a folder with {', '.join(names[:4])}{more}" if names else "an empty folder"
