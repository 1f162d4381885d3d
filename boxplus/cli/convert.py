"""`boxplus convert`: a file in another format of its kind."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


class _Target(StrEnum):
    auto = "auto"
    tum = "tum"
    kitti = "kitti"
    csv = "csv"
    cloud = "cloud"
    g2o = "g2o"
    toro = "toro"
    colmap_text = "colmap-text"
    colmap_binary = "colmap-binary"
    bal = "bal"


def convert_command(
    source: Annotated[
        Path, typer.Argument(help="Trajectory, point cloud, pose graph, BAL file or folder of a COLMAP model.", metavar="SOURCE")
    ],
    output: Annotated[Path, typer.Argument(help="New file; its ending tells the format.", metavar="OUTPUT")],
    to: Annotated[_Target, typer.Option("--to", help="The format, where the ending does not tell it.")] = _Target.auto,
) -> None:
    """Write a file in another format of its kind, and say what that format cannot hold.

    Trajectories as TUM, KITTI or boxplus CSV (EuRoC is read), clouds as PLY, PCD, LAS, LAZ or E57, graphs as g2o or TORO,
    reconstructions (BAL, COLMAP) as BAL, plain or compressed, or as COLMAP's text or binary files.
    """
    from boxplus.formats.conversion import convert

    typer.echo(f"{convert(source, output, to.value)} → {output}")
