"""A pose graph as files carry it: poses, relative poses measured between them, and how well each is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import InitVar, dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError
from boxplus.formats.graphs.information_matrix import ASYMMETRIC, INDEFINITE, NOT_FINITE, examine, smallest_eigenvalue

QUATERNION_TOLERANCE = 1e-2
"""Largest |‖q‖ − 1| that is taken for rounding and normalised away."""

_UNIT = 8e-16
_FAULTS = {
    NOT_FINITE: (
        "a finite",
        "one with NaN or infinity",
        "a standard deviation of zero has infinite information: give the measurement its real noise",
    ),
    ASYMMETRIC: ("a symmetric", "one that is not", "check the order of its entries"),
    INDEFINITE: ("a positive semi-definite", "one with the eigenvalue", "check the order of its entries"),
}
_LAYOUT = {2: "theta, x, y", 3: "qw, qx, qy, qz, x, y, z"}


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """n poses `T_world_body` and m measurements of `T_i⁻¹ T_j`.

    The error of an edge is `Log(Z⁻¹ T_i⁻¹ T_j)`, and chi2 the sum of `eᵀ Ω e` with the information Ω in the
    order of the tangent, rotation first: [wx, wy, wz, vx, vy, vz] in 3D, [w, vx, vy] in 2D [rad, m].

    Attributes:
        dimension: 2 or 3.
        ids: (n,) int64, the names of the poses in the file, all different, in the order of the file.
        poses: (n, 7) float64 [qw, qx, qy, qz, x, y, z] in 3D, (n, 3) [theta, x, y] in 2D; None where the file has only
            edges. Quaternions are normalised.
        edges: (m, 2) int64, indices i and j into `ids`, i ≠ j.
        measurements: (m, 7) or (m, 3) float64, laid out as the poses.
        information: (m, 6, 6) or (m, 3, 3) float64, symmetric and positive semi-definite; an edge may have none.
        fixed: (k,) int64, indices of the poses that the file holds fixed.
        source: where the graph comes from; error messages begin with it.
        warnings: what the reader had to leave out or to read otherwise, one sentence each.

    Raises:
        InputError: on construction, where shapes do not match, a value is not finite, a quaternion is not of unit length,
            an index dangles, a name repeats, or an information matrix is not symmetric and semi-definite. The
            message names the source and the line or index.

    Example:
        >>> edges, measured = np.array([[0, 1], [1, 2], [2, 0]]), np.tile([2 * np.pi / 3, 1.0, 0.0], (3, 1))
        >>> graph = bp.PoseGraph(2, np.arange(3), None, edges, measured, np.tile(np.eye(3), (3, 1, 1)), np.array([0]))
        >>> graph.dimension, len(graph.edges)
        (2, 3)
    """

    dimension: Literal[2, 3]
    ids: NDArray[np.int64]
    poses: NDArray[np.float64] | None
    edges: NDArray[np.int64]
    measurements: NDArray[np.float64]
    information: NDArray[np.float64]
    fixed: NDArray[np.int64]
    source: str = "pose graph"
    warnings: tuple[str, ...] = ()
    pose_lines: InitVar[NDArray[np.int64] | None] = None
    edge_lines: InitVar[NDArray[np.int64] | None] = None

    def __post_init__(self, pose_lines: NDArray[np.int64] | None, edge_lines: NDArray[np.int64] | None) -> None:
        if self.dimension not in (2, 3):
            raise InputError("a pose graph of dimension 2 or 3", f"{self.dimension} ({self.source})", "give one of them")

        def pose(row: int) -> str:
            return f"{self.source}, " + (f"pose {row}" if pose_lines is None else f"line {pose_lines[row]}")

        def edge(row: int) -> str:
            return f"{self.source}, " + (f"edge {row}" if edge_lines is None else f"line {edge_lines[row]}")

        width, tangent = (7, 6) if self.dimension == 3 else (3, 3)
        count, measured = len(self.ids), len(self.edges)
        self._set("ids", np.ascontiguousarray(self.ids, np.int64), (count,))
        self._set("edges", np.ascontiguousarray(self.edges, np.int64), (measured, 2))
        self._set("fixed", np.ascontiguousarray(self.fixed, np.int64), (len(self.fixed),))
        self._check_names(pose)
        self._check_edges(edge)
        measurements = np.ascontiguousarray(self.measurements, np.float64)
        self._set("measurements", measurements, (measured, width))
        self._set("measurements", _checked_poses(measurements, "measurement", edge), (measured, width))
        if self.poses is not None:
            poses = np.ascontiguousarray(self.poses, np.float64)
            self._set("poses", poses, (count, width))
            self._set("poses", _checked_poses(poses, "pose", pose), (count, width))
        self._set("information", np.ascontiguousarray(self.information, np.float64), (measured, tangent, tangent))
        _check_information(self.information, edge)

    def _set(self, name: str, array: NDArray[np.int64] | NDArray[np.float64], shape: tuple[int, ...]) -> None:
        if array.shape != shape:
            layout = f"; a row is {_LAYOUT[self.dimension]}" if name in ("poses", "measurements") else ""
            raise InputError(f"{name} of shape {shape}", f"{array.shape} ({self.source})", f"give matching arrays{layout}")
        object.__setattr__(self, name, array)

    def _check_names(self, where: Callable[[int], str]) -> None:
        order = np.argsort(self.ids, kind="stable")
        repeated = np.flatnonzero(self.ids[order][1:] == self.ids[order][:-1])
        if repeated.size:
            first, second = sorted((int(order[repeated[0]]), int(order[repeated[0] + 1])))
            raise InputError(
                "each pose once",
                f"pose {self.ids[first]} again ({where(second)}; first: {where(first)})",
                "remove one of the two",
            )
        bad = np.flatnonzero((self.fixed < 0) | (self.fixed >= len(self.ids)))
        if bad.size:
            raise InputError(
                f"fixed poses from 0 to {len(self.ids) - 1}", f"{self.fixed[bad[0]]} ({self.source})", "give indices, not names"
            )

    def _check_edges(self, where: Callable[[int], str]) -> None:
        bad = np.flatnonzero(((self.edges < 0) | (self.edges >= len(self.ids))).any(axis=1))
        if bad.size:
            raise InputError(
                f"edges between poses 0 to {len(self.ids) - 1}",
                f"{self.edges[bad[0]].tolist()} ({where(int(bad[0]))})",
                "give indices into ids",
            )
        bad = np.flatnonzero(self.edges[:, 0] == self.edges[:, 1])
        if bad.size:
            name = self.ids[self.edges[bad[0], 0]]
            raise InputError(
                "edges between two different poses", f"one from pose {name} to itself ({where(int(bad[0]))})", "remove the edge"
            )


def _checked_poses(values: NDArray[np.float64], name: str, where: Callable[[int], str]) -> NDArray[np.float64]:
    """The rows with unit quaternions, where all are finite and nearly so."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if bad.size:
        row = int(bad[0])
        raise InputError(
            f"a finite {name}",
            f"{values[row].tolist()} ({where(row)}; {bad.size} such)",
            f"remove the {name} or find out how it became NaN or infinite",
        )
    if values.shape[1] == 3:
        return values
    length = np.sqrt(np.einsum("ni,ni->n", values[:, :4], values[:, :4]))
    bad = np.flatnonzero(np.abs(length - 1.0) > QUATERNION_TOLERANCE)
    if bad.size:
        row = int(bad[0])
        raise InputError(
            f"a unit quaternion in each {name}",
            f"length {length[row]:.6g} ({where(row)}; {bad.size} such)",
            "check the order of the columns",
        )
    off = np.abs(length - 1.0) > _UNIT  # a unit quaternion keeps its digits
    if off.any():
        values = values.copy()
        values[off, :4] /= length[off, None]
    return values


def _check_information(information: NDArray[np.float64], where: Callable[[int], str]) -> None:
    """Refuse information matrices that are not finite, symmetric and semi-definite."""
    verdicts = examine(information)
    for fault, (expected, got, advice) in _FAULTS.items():
        bad = np.flatnonzero(verdicts == fault)
        if bad.size:
            row = int(bad[0])
            if fault == INDEFINITE:
                got += f" {smallest_eigenvalue(information[row]):.6g}"
            raise InputError(f"{expected} information matrix", f"{got} ({where(row)}; {bad.size} such)", advice)
