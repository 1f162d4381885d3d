"""Pose graphs in g2o's text format, in the plane (SE2) and in space (SE3:QUAT)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_path
from boxplus.errors import InputError
from boxplus.formats.graphs.graph_builder import GraphBuilder
from boxplus.formats.graphs.information_matrix import INDEFINITE, examine, triangle_index
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.numbers.lines import NumberLines, read_number_lines
from boxplus.formats.numbers.writer import write_rows
from boxplus.formats.output import atomic_file

RotationError = Literal["rotation_vector", "quaternion"]
CrossBlock = Literal["auto", "upper", "transposed", "dropped"]

_TAGS = ("VERTEX_SE2", "EDGE_SE2", "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT", "FIX")
_VERTEX_2D, _EDGE_2D, _VERTEX_3D, _EDGE_3D, _FIX = range(5)
_EXPECTED = (
    "VERTEX_SE2 with id x y theta",
    "EDGE_SE2 with two ids, x y theta and the 6 upper entries of the information matrix",
    "VERTEX_SE3:QUAT with id x y z qx qy qz qw",
    "EDGE_SE3:QUAT with two ids, x y z qx qy qz qw and the 21 upper entries of the information matrix",
    "FIX with an id",
)
_ADVICE = "correct or remove the line; ids are whole numbers"
# Files have translation first and xyzw; boxplus rotation first and wxyz.
_POSE_2D, _POSE_3D = [2, 0, 1], [6, 3, 4, 5, 0, 1, 2]
_TANGENT = {2: [2, 0, 1], 3: [3, 4, 5, 0, 1, 2]}
_POSE_2D_BACK, _POSE_3D_BACK = [1, 2, 0], [4, 5, 6, 1, 2, 3, 0]


def read_g2o(
    path: str | Path,
    *,
    rotation_error: RotationError = "rotation_vector",
    cross_block: CrossBlock = "auto",
    ignore_unknown: bool = False,
) -> PoseGraph:
    """Read a g2o file: VERTEX_SE2, EDGE_SE2, VERTEX_SE3:QUAT, EDGE_SE3:QUAT and FIX.

    Args:
        path: the file.
        rotation_error: what the rotation part of a 3D information matrix refers to. g2o's own error is the vector part of
            a quaternion, half a rotation vector (`quaternion`): Ω of the rotation vector is then a quarter of the file's,
            and the block between rotation and translation a half. The published data sets, and the programs that read
            them (GTSAM, SE-Sync, Ceres' example), take it for the full rotation vector (`rotation_vector`).
        cross_block: the 3×3 block of a 3D information matrix that ties translation (rows) to rotation (columns). `upper`:
            as g2o has it. `transposed`: as GTSAM wrote it before it corrected its order. `dropped`: taken for zero.
            `auto`: `upper`, except where that makes matrices indefinite and `transposed` makes all of them semi-definite.
        ignore_unknown: leave out lines that begin with another word, and count them in `PoseGraph.warnings`; otherwise
            they are errors.

    Raises:
        InputError: a malformed line, a pose that is missing or there twice, values that are not finite, an information
            matrix that is not positive semi-definite; the message names file and line.

    Example:
        >>> graph = bp.formats.read_g2o("loops.g2o")
        >>> graph.dimension, graph.edges[0].tolist()
        (3, [0, 1])
    """
    for name, value, known in (
        ("rotation_error", rotation_error, ("rotation_vector", "quaternion")),
        ("cross_block", cross_block, ("auto", "upper", "transposed", "dropped")),
    ):
        if value not in known:
            raise InputError(f"{name} as one of {', '.join(known)}", repr(value), "choose one of them")
    source = as_path(path, "a pose graph")
    builder = GraphBuilder(source, _TAGS, ignore_unknown)
    for chunk in read_number_lines(source, _TAGS):
        builder.note_unknown(chunk)
        for tag in range(len(_TAGS)):
            rows = np.flatnonzero(chunk.tag == tag)
            if rows.size:
                _add(builder, chunk, tag, rows)
    dimension = builder.dimension()
    ids, measurements, information, lines = builder.edges()
    warnings: tuple[str, ...] = ()
    if dimension == 3:
        warnings = _order_cross_block(information, cross_block, source)
        if rotation_error == "quaternion":
            information *= _half_angle(0.5)
    return builder.build(dimension, (ids, measurements, information, lines), warnings)


def _add(builder: GraphBuilder, chunk: NumberLines, tag: int, rows: NDArray[np.intp]) -> None:
    """Hand the lines of one kind to the builder, in boxplus' layout."""
    lines = chunk.number[rows]
    if tag == _FIX:
        for row, line in zip(rows, lines, strict=True):
            one = np.array([row])
            names = max(int(chunk.count[row]), 1)
            chunk.table(one, names, _EXPECTED[tag], _ADVICE, whole=range(names))
            for column in range(names):
                builder.add_fixed(int(chunk.column(one, column)[0]), int(line))
    elif tag in (_VERTEX_2D, _VERTEX_3D):
        dimension, order = (2, _POSE_2D) if tag == _VERTEX_2D else (3, _POSE_3D)
        table = chunk.table(rows, 1 + len(order), _EXPECTED[tag], _ADVICE, whole=[0])
        builder.add_poses(dimension, chunk.column(rows, 0), table.take(1 + np.array(order), axis=1), lines)
    else:
        dimension, order = (2, _POSE_2D) if tag == _EDGE_2D else (3, _POSE_3D)
        first = 2 + len(order)
        tangent = _TANGENT[dimension]
        entries = triangle_index(len(tangent))[np.ix_(tangent, tangent)]
        table = chunk.table(rows, first + int(entries.max()) + 1, _EXPECTED[tag], _ADVICE, whole=[0, 1])
        ids = np.column_stack([chunk.column(rows, 0), chunk.column(rows, 1)])
        measured = table.take(2 + np.array(order), axis=1)
        builder.add_edges(dimension, ids, measured, table.take(first + entries, axis=1), lines)


def _half_angle(factor: float) -> NDArray[np.float64]:
    """What turns the information of half the rotation vector into that of the whole (1/2), or back (2)."""
    scale = np.array([factor] * 3 + [1.0] * 3)
    return np.outer(scale, scale)


def _order_cross_block(information: NDArray[np.float64], cross_block: CrossBlock, source: Path) -> tuple[str, ...]:
    """Put the blocks between rotation and translation into place; returns a warning where that took a decision."""
    if cross_block == "dropped":
        information[:, :3, 3:] = information[:, 3:, :3] = 0.0
    elif cross_block == "transposed":
        _transpose_cross_block(information)
    elif cross_block == "auto":
        indefinite = int(np.count_nonzero(examine(information) == INDEFINITE))
        if indefinite:
            other = information.copy()
            _transpose_cross_block(other)
            if (examine(other) != INDEFINITE).all():
                information[:] = other
                return (
                    f"{indefinite} of {len(information)} information matrices of {source} are indefinite as g2o orders them, and "
                    "none with the block between translation and rotation transposed, as GTSAM wrote it; they were read so",
                )
    return ()


def _transpose_cross_block(information: NDArray[np.float64]) -> None:
    information[:, :3, 3:] = information[:, 3:, :3].copy()
    information[:, 3:, :3] = information[:, :3, 3:].transpose(0, 2, 1)


def write_g2o(path: str | Path, graph: PoseGraph, *, rotation_error: RotationError = "rotation_vector") -> None:
    """Write poses, FIX lines and edges in the order of the graph, with as many digits as it takes to read the same numbers.

    Args:
        path: the file; it appears only when it is whole.
        graph: what to write; without poses, only its edges are written.
        rotation_error: as in `read_g2o`; give the same to get the same information back.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> bp.formats.write_g2o("copy.g2o", bp.formats.read_g2o("loops.g2o"))
        >>> len(bp.formats.read_g2o("copy.g2o").edges)
        35
    """
    spatial = graph.dimension == 3
    back = _POSE_3D_BACK if spatial else _POSE_2D_BACK
    vertex, edge = (_TAGS[_VERTEX_3D], _TAGS[_EDGE_3D]) if spatial else (_TAGS[_VERTEX_2D], _TAGS[_EDGE_2D])
    with atomic_file(path) as file:
        if graph.poses is not None:
            write_rows(file, f"{vertex} ", graph.ids[:, None], graph.poses[:, back])
        write_rows(file, "FIX ", graph.ids[graph.fixed][:, None], np.empty((len(graph.fixed), 0)))
        information = graph.information
        if spatial and rotation_error == "quaternion":
            information = information * _half_angle(2.0)
        tangent = np.argsort(_TANGENT[graph.dimension])
        rows, columns = np.triu_indices(len(tangent))
        upper = information[:, tangent[rows], tangent[columns]]
        write_rows(file, f"{edge} ", graph.ids[graph.edges], np.hstack([graph.measurements[:, back], upper]))
