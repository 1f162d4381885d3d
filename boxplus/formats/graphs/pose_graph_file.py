"""Pose graphs in any format that is read, told apart by the words their lines begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.formats.graphs.g2o import CrossBlock, RotationError, read_g2o, write_g2o
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.graphs.toro import read_toro, write_toro

GraphFormat = Literal["g2o", "toro"]

_TORO = (b"VERTEX2", b"EDGE2", b"VERTEX3", b"EDGE3")
_G2O = (b"VERTEX_SE2", b"EDGE_SE2", b"VERTEX_SE3:QUAT", b"EDGE_SE3:QUAT")


def graph_format(path: str | Path) -> GraphFormat:
    """g2o, or TORO where the first known word is one of TORO's.

    Raises:
        InputError: the file cannot be read.
    """
    source = as_path(path, "a pose graph")
    try:
        with source.open("rb") as file:
            for line in file:
                word = line[:40].split(maxsplit=1)[:1]
                if word and word[0] in (*_TORO, *_G2O):
                    return "toro" if word[0] in _TORO else "g2o"
    except OSError as error:
        raise InputError("a pose graph in g2o's or TORO's format", f"{source}: {error.strerror}", "check the path") from error
    return "g2o"


def read_pose_graph(
    path: str | Path,
    *,
    rotation_error: RotationError = "rotation_vector",
    cross_block: CrossBlock = "auto",
    ignore_unknown: bool = False,
) -> PoseGraph:
    """Read a g2o or a TORO file; arguments as for `read_g2o`, of which only the last concerns TORO.

    Raises:
        InputError: as `read_g2o`.

    Example:
        >>> graph = bp.read_pose_graph("loops.g2o")
        >>> graph.dimension, graph.poses.shape, graph.edges.shape
        (3, (24, 7), (35, 2))
    """
    if graph_format(path) == "toro":
        return read_toro(path, ignore_unknown=ignore_unknown)
    return read_g2o(path, rotation_error=rotation_error, cross_block=cross_block, ignore_unknown=ignore_unknown)


def write_pose_graph(
    path: str | Path, graph: PoseGraph, format: GraphFormat, *, rotation_error: RotationError = "rotation_vector"
) -> None:
    """Write a graph as g2o or TORO; `rotation_error` as it was read with.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_pose_graph("loops.graph", bp.read_pose_graph("loops.g2o"), "toro")
        >>> bp.read_pose_graph("loops.graph").edges.shape  # told by the words its lines begin with
        (35, 2)
    """
    if format == "toro":
        write_toro(path, graph)
    else:
        write_g2o(path, graph, rotation_error=rotation_error)
