"""Pose graphs in TORO's text format: VERTEX2 and EDGE2 in the plane, VERTEX3 and EDGE3 in space."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import as_path
from boxplus.formats.graphs.graph_builder import GraphBuilder
from boxplus.formats.graphs.information_matrix import triangle_index
from boxplus.formats.graphs.pose_graph import PoseGraph
from boxplus.formats.numbers.lines import NumberLines, read_number_lines
from boxplus.formats.numbers.writer import write_rows
from boxplus.formats.output import atomic_file
from boxplus.manifolds import quaternion

_TAGS = ("VERTEX2", "EDGE2", "VERTEX3", "EDGE3")
_VERTEX_2D, _EDGE_2D, _VERTEX_3D, _EDGE_3D = range(4)
_EXPECTED = (
    "VERTEX2 with id x y theta",
    "EDGE2 with two ids, x y theta and the information I11 I12 I22 I33 I13 I23",
    "VERTEX3 with id x y z roll pitch yaw",
    "EDGE3 with two ids, x y z roll pitch yaw and the 21 upper entries of the information matrix",
)
_ADVICE = "correct or remove the line; ids are whole numbers"
# Where the file has the entries of Ω in the order [theta, x, y], and in [rotation, translation].
_ENTRIES_2D = np.array([[3, 4, 5], [4, 0, 1], [5, 1, 2]])
_TANGENT_3D = [3, 4, 5, 0, 1, 2]
_ENTRIES_3D = triangle_index(6)[np.ix_(_TANGENT_3D, _TANGENT_3D)]


def read_toro(path: str | Path, *, ignore_unknown: bool = False) -> PoseGraph:
    """Read a TORO file: VERTEX2, EDGE2, VERTEX3 and EDGE3.

    The information of a 2D edge is in TORO's own order I11 I12 I22 I33 I13 I23 of (x, y, theta). In 3D rotations are
    R = Rz(yaw) Ry(pitch) Rx(roll); the information of the three angles is taken for that of the rotation vector, which it
    equals to first order of the error.

    Args:
        path: the file.
        ignore_unknown: leave out lines that begin with another word, and count them in `PoseGraph.warnings`; otherwise
            they are errors.

    Raises:
        InputError: as `read_g2o`.

    Example:
        >>> edges, measured = np.array([[0, 1], [1, 0]]), np.array([[np.pi / 2, 1.0, 0.0], [-np.pi / 2, 0.0, 1.0]])
        >>> graph = bp.PoseGraph(2, np.arange(2), None, edges, measured, np.tile(np.eye(3), (2, 1, 1)), np.array([0]))
        >>> bp.formats.write_toro("loop.graph", graph)
        >>> bp.formats.read_toro("loop.graph").measurements.round(3).tolist()
        [[1.571, 1.0, 0.0], [-1.571, 0.0, 1.0]]
    """
    source = as_path(path, "a pose graph")
    builder = GraphBuilder(source, _TAGS, ignore_unknown)
    for chunk in read_number_lines(source, _TAGS):
        builder.note_unknown(chunk)
        for tag in range(len(_TAGS)):
            rows = np.flatnonzero(chunk.tag == tag)
            if rows.size:
                _add(builder, chunk, tag, rows)
    return builder.build(builder.dimension(), builder.edges(), ())


def _add(builder: GraphBuilder, chunk: NumberLines, tag: int, rows: NDArray[np.intp]) -> None:
    """Hand the lines of one kind to the builder, in boxplus' layout."""
    lines = chunk.number[rows]
    dimension, width, convert = (2, 3, _plane_in) if tag in (_VERTEX_2D, _EDGE_2D) else (3, 6, _space_in)
    if tag in (_VERTEX_2D, _VERTEX_3D):
        table = chunk.table(rows, 1 + width, _EXPECTED[tag], _ADVICE, whole=[0])
        builder.add_poses(dimension, chunk.column(rows, 0), convert(table[:, 1:]), lines)
    else:
        entries = _ENTRIES_2D if tag == _EDGE_2D else _ENTRIES_3D
        table = chunk.table(rows, 2 + width + int(entries.max()) + 1, _EXPECTED[tag], _ADVICE, whole=[0, 1])
        ids = np.column_stack([chunk.column(rows, 0), chunk.column(rows, 1)])
        information = table.take(2 + width + entries, axis=1)
        builder.add_edges(dimension, ids, convert(table[:, 2 : 2 + width]), information, lines)


def _plane_in(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """[x, y, theta] to [theta, x, y]."""
    return rows.take([2, 0, 1], axis=1)


def _space_in(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """[x, y, z, roll, pitch, yaw] to [qw, qx, qy, qz, x, y, z]."""
    half = 0.5 * rows[:, 3:]
    with np.errstate(invalid="ignore"):  # an infinite angle becomes NaN, which the graph refuses with its line
        cosine, sine = np.cos(half), np.sin(half)
    zero = np.zeros(len(rows))
    roll = np.column_stack([cosine[:, 0], sine[:, 0], zero, zero])
    pitch = np.column_stack([cosine[:, 1], zero, sine[:, 1], zero])
    yaw = np.column_stack([cosine[:, 2], zero, zero, sine[:, 2]])
    q_wxyz = quaternion.multiply(quaternion.multiply(yaw, pitch), roll)
    return np.hstack([q_wxyz, rows[:, :3]])


def _plane_out(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """[theta, x, y] to [x, y, theta]."""
    return rows.take([1, 2, 0], axis=1)


def _space_out(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """[qw, qx, qy, qz, x, y, z] to [x, y, z, roll, pitch, yaw]; where the pitch is ±90° the roll is chosen zero."""
    R = quaternion.to_matrix(np.ascontiguousarray(rows[:, :4]))
    across = np.hypot(R[:, 0, 0], R[:, 1, 0])
    locked = across < 1e-9
    roll = np.where(locked, 0.0, np.arctan2(R[:, 2, 1], R[:, 2, 2]))
    pitch = np.arctan2(-R[:, 2, 0], across)
    yaw = np.where(locked, np.arctan2(-R[:, 0, 1], R[:, 1, 1]), np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    return np.column_stack([rows[:, 4:], roll, pitch, yaw])


def write_toro(path: str | Path, graph: PoseGraph) -> None:
    """Write poses and edges in the order of the graph; TORO has no word for poses that are fixed, so that is lost.

    Raises:
        OutputError: the file cannot be written.

    Example:
        >>> edges, measured = np.array([[0, 1], [1, 0]]), np.array([[np.pi / 2, 1.0, 0.0], [-np.pi / 2, 0.0, 1.0]])
        >>> graph = bp.PoseGraph(2, np.arange(2), None, edges, measured, np.tile(np.eye(3), (2, 1, 1)), np.array([0]))
        >>> bp.formats.write_toro("loop.graph", graph)
        >>> bp.formats.read_toro("loop.graph").edges.tolist()
        [[0, 1], [1, 0]]
    """
    if graph.dimension == 2:
        vertex, edge, convert, entries = _TAGS[_VERTEX_2D], _TAGS[_EDGE_2D], _plane_out, _ENTRIES_2D
    else:
        vertex, edge, convert, entries = _TAGS[_VERTEX_3D], _TAGS[_EDGE_3D], _space_out, _ENTRIES_3D
    # The first place in Ω of each entry of the file.
    _, places = np.unique(entries, return_index=True)
    flat = graph.information.reshape(len(graph.edges), -1)
    with atomic_file(path) as file:
        if graph.poses is not None:
            write_rows(file, f"{vertex} ", graph.ids[:, None], convert(graph.poses))
        numbers = np.hstack([convert(graph.measurements), flat[:, places]])
        write_rows(file, f"{edge} ", graph.ids[graph.edges], numbers)
