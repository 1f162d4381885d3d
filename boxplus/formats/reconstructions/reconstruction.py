"""Reconstructions (cameras, points, observations) in any format that is read, told apart by what is in the file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.formats.numbers.lines import first_text
from boxplus.formats.reconstructions.bal import BalProblem, read_bal, write_bal
from boxplus.formats.reconstructions.colmap import read_colmap, write_colmap
from boxplus.formats.reconstructions.colmap_model import ColmapModel
from boxplus.formats.reconstructions.gbp import GbpProblem, read_gbp, write_gbp

Reconstruction = BalProblem | GbpProblem | ColmapModel
ReconstructionFormat = Literal["auto", "bal", "gbp", "colmap"]

_COLMAP_NAMES = ("cameras", "images", "points3D")
_LOOKED_AT = 1 << 16  # bytes, for the second line of numbers


def read_reconstruction(path: str | Path, format: ReconstructionFormat = "auto") -> Reconstruction:
    """Read a BAL file (plain or bzip2), one of "Bundle Adjustment on a Graph Processor" or a COLMAP model (text or binary).

    Args:
        path: the file, or the folder of a COLMAP model.
        format: auto takes a folder, and cameras, images or points3D in one, for COLMAP's; and a file whose second line is not
            an observation, which begins with two whole numbers, for the graph processor's.

    Raises:
        InputError: no such file, or as the reader of the format.

    Example:
        >>> scene = bp.read_reconstruction("scene.txt.bz2")
        >>> type(scene).__name__, scene.cameras.shape, scene.points.shape
        ('BalProblem', (6, 9), (40, 3))
    """
    source = as_path(path, "a reconstruction")
    if not source.exists():
        raise InputError("a bundle adjustment file or the folder of a COLMAP model", f"{source}: no such file", "check the path")
    if format == "auto":
        if source.is_dir() or source.stem in _COLMAP_NAMES:
            format = "colmap"
        else:
            format = "gbp" if _has_intrinsics(source) else "bal"
    if format == "colmap":
        return read_colmap(source)
    return read_gbp(source) if format == "gbp" else read_bal(source)


def _has_intrinsics(source: Path) -> bool:
    """Whether the second line of numbers is `fx fy cx cy`, and not an observation."""
    seen = 0
    for line in first_text(source, _LOOKED_AT).splitlines():
        words = line.split("#")[0].split()
        seen += bool(words)
        if seen == 2:
            return len(words) == 4 and not all(word.lstrip("+-").isdigit() for word in words[:2])
    return False


def reconstruction_file_name(reconstruction: Reconstruction, source: str | Path, stem: str) -> str:
    """`stem` with the ending that `write_reconstruction` needs to write as the source was written; a COLMAP model is a folder."""
    if isinstance(reconstruction, ColmapModel):
        return stem
    return f"{stem}.txt.bz2" if Path(source).suffix == ".bz2" and isinstance(reconstruction, BalProblem) else f"{stem}.txt"


def write_reconstruction(path: str | Path, reconstruction: Reconstruction) -> None:
    """Write in the format it was read from: BAL compressed where the name ends in .bz2, COLMAP as text or binary as it came.

    Raises:
        OutputError: it cannot be written.

    Example:
        >>> bp.formats.write_reconstruction("copy.txt", bp.read_reconstruction("scene.txt.bz2"))
        >>> bp.read_reconstruction("copy.txt").points.shape
        (40, 3)
    """
    if isinstance(reconstruction, ColmapModel):
        write_colmap(path, reconstruction)
    elif isinstance(reconstruction, GbpProblem):
        write_gbp(path, reconstruction)
    else:
        write_bal(path, reconstruction)
