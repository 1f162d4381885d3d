"""How the LiDAR turned from scan to scan, from the scans alone.

A small point-to-plane ICP against the last few scans, in NumPy and SciPy: a second opinion on the IMU for the check of units,
time bases and extrinsics, not an odometry. Each scan is undistorted with its own motion (constant velocity), and its pose
belongs to the middle of the scan.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from boxplus.manifolds import so3
from boxplus.sensors.scan import Scan

_SCANS_IN_MAP = 4
_POINTS = 1000
_MOST_POINTS = 20_000
_CELL = 0.03
"""Size of the grid on which points are averaged, as a share of the median range; coarser where that makes too many cells."""
_MOST_CELLS = 1500
_NEIGHBOURS = 12
_THICKEST_PLANE = 0.15
"""Largest variance across a neighbourhood, as a share of its second one, that still makes a plane."""
_THINNEST_PLANE = 0.02
"""Smallest second variance as a share of the first: below it the neighbours lie on one ring and have no normal."""
_REACH_M = (1.0, 0.5, 0.3)
_ITERATIONS = 5
_FEWEST_MATCHES = 100
_SAME_PLANE = 0.9
"""Cosine between the normals of two matched points."""
_CONVERGED = 1e-3


@dataclass(frozen=True, slots=True)
class LidarRotations:
    """Relative motions between the middles of consecutive scans, registered scans only.

    Attributes:
        begin_ns, end_ns: (K,) int64, middle of the earlier and the later scan.
        rotation: (K, 3) float64, rotation vector Log(R_earlier_later) in the LiDAR frame [rad].
        translation: (K, 3) float64, the later position in the earlier scan's frame [m].
        failed: scans that could not be registered.
    """

    begin_ns: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    failed: int


def lidar_rotations(scans: Iterable[Scan]) -> LidarRotations:
    """Register every scan to the few before it.

    Args:
        scans: in order of time; streamed, only a few are held at once.
    """
    registration = ScanRegistration()
    for scan in scans:
        registration.add(scan)
    return registration.rotations()


@dataclass(slots=True)
class _Patch:
    """Points of one scan with normals, in the frame of the first scan."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]


_Step = tuple[int, int, NDArray[np.float64], NDArray[np.float64]]
"""Middle of the earlier and of the later scan, rotation vector and translation between them."""


class ScanRegistration:
    """Registers scans one after the other, each to the few before it."""

    def __init__(self) -> None:
        self._failed = 0
        self._steps: list[_Step] = []
        self._patches: deque[_Patch] = deque(maxlen=_SCANS_IN_MAP)
        self._R, self._t = np.eye(3), np.zeros(3)
        self._turn, self._move, self._turned = np.zeros(3), np.zeros(3), False
        self._previous_ns: int | None = None

    def rotations(self) -> LidarRotations:
        """The motions found so far."""
        begin = np.array([step[0] for step in self._steps], np.int64)
        end = np.array([step[1] for step in self._steps], np.int64)
        rotation = np.array([step[2] for step in self._steps]).reshape(-1, 3)
        translation = np.array([step[3] for step in self._steps]).reshape(-1, 3)
        return LidarRotations(begin, end, rotation, translation, self._failed)

    def add(self, scan: Scan) -> None:
        """Register the next scan; one that does not fit the map, or follows a gap, begins a new one."""
        if len(scan) < _FEWEST_MATCHES:
            self._restart()
            return
        raw, share = _cell_means(scan)
        middle_ns = (scan.start_ns + scan.end_ns) // 2
        step_s = 0.0 if self._previous_ns is None else (middle_ns - self._previous_ns) * 1e-9
        if self._previous_ns is None or not 0.0 < step_s < 1.0:
            self._restart()
            self._previous_ns = middle_ns
            planar, normals = _normals(raw)
            self._patches.append(_Patch(raw[planar], normals))
            return
        share *= (scan.end_ns - scan.start_ns) * 1e-9 / step_s
        turn, move = self._turn, self._move
        planar, normals = _normals(_undistort(raw, share, turn, move))
        raw, share = raw[planar], share[planar]
        target = _Patch(*(np.concatenate([getattr(patch, name) for patch in self._patches]) for name in ("points", "normals")))
        tree = cKDTree(target.points, balanced_tree=False, compact_nodes=False)
        # Twice: the motion found first undistorts the scan better than the previous scan's motion.
        for reach in (_REACH_M, _REACH_M[1:]):
            # `turn` is the mean between the middles of two scans; in the middle of this one it has changed by half a step more.
            now = turn + 0.5 * (turn - self._turn) if self._turned else turn
            still = _undistort(raw, share, now, move)
            found = self._register(target, tree, still, normals, turn, move, reach)
            if found is None:
                self._failed += 1
                self._restart()
                return
            turn, move = found
        self._t = self._t + self._R @ move
        self._R = self._R @ so3.exp(turn)
        self._patches.append(_Patch(still @ self._R.T + self._t, normals @ self._R.T))
        begin_ns, self._previous_ns = self._previous_ns, middle_ns
        self._turn, self._move, self._turned = turn, move, True
        self._steps.append((begin_ns, middle_ns, turn, move))

    def _restart(self) -> None:
        self._patches.clear()
        self._R, self._t = np.eye(3), np.zeros(3)
        self._turn, self._move, self._turned = np.zeros(3), np.zeros(3), False
        self._previous_ns = None

    def _register(
        self,
        target: _Patch,
        tree: cKDTree,
        points: NDArray[np.float64],
        normals: NDArray[np.float64],
        turn: NDArray[np.float64],
        move: NDArray[np.float64],
        reach: tuple[float, ...],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Rotation vector and translation from the previous scan, from a first guess of both."""
        stride = -(-len(points) // _POINTS) or 1
        points, normals = points[::stride], normals[::stride]
        if len(target.points) < _FEWEST_MATCHES or len(points) < _FEWEST_MATCHES:
            return None
        R, t = self._R @ so3.exp(turn), self._t + self._R @ move
        for distance in reach:
            for _ in range(_ITERATIONS):
                world = points @ R.T + t
                gap, index = tree.query(world, distance_upper_bound=distance)
                hit = np.isfinite(gap)
                index[~hit] = 0
                plane = target.normals[index]
                hit &= np.abs(np.einsum("ij,ij->i", plane, normals @ R.T)) > _SAME_PLANE
                if hit.sum() < _FEWEST_MATCHES:
                    return None
                change = _gauss_newton_step(world[hit], target.points[index[hit]], plane[hit])
                if change is None:
                    return None
                dR = so3.exp(change[:3])
                R, t = dR @ R, dR @ t + change[3:]
                if np.abs(change).max() < _CONVERGED:
                    break
        return so3.log(self._R.T @ R), self._R.T @ (t - self._t)


def _gauss_newton_step(
    points: NDArray[np.float64], target: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """(6,) rotation vector and translation, on the left, that bring the points onto their planes; None when undetermined."""
    residual = np.einsum("ij,ij->i", normals, points - target)
    sigma = max(1.4826 * float(np.median(np.abs(residual))), 1e-3)
    weight = 1.0 / (1.0 + (residual / (3.0 * sigma)) ** 2) ** 2
    J = np.concatenate((np.cross(points, normals), normals), axis=1)
    H = J.T @ (J * weight[:, None])
    if np.linalg.eigvalsh(H[:3, :3])[0] < 1e-6 * len(points):
        return None
    H[np.diag_indices(6)] += 1e-6 * np.trace(H)  # a corridor leaves a translation free; the rotation is what counts here
    return -np.linalg.solve(H, J.T @ (weight * residual))


def _undistort(
    points: NDArray[np.float64], share: NDArray[np.float64], turn: NDArray[np.float64], move: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The points as seen from the sensor in the middle of the scan, to second order in the rotation."""
    part = share[:, None]
    once = np.cross(turn, points)
    return points + part * (once + move) + 0.5 * part**2 * np.cross(turn, once)


def _cell_means(scan: Scan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The mean of the points in every cell of a grid, and when in the scan it was taken, from -0.5 to 0.5.

    Even over the surfaces where points crowd near the sensor, and with less noise than single points.
    """
    stride = -(-len(scan) // _MOST_POINTS)
    points = scan.p_lidar[::stride].astype(np.float64)
    share = (scan.time_ns[::stride] - scan.start_ns) / max(scan.end_ns - scan.start_ns, 1) - 0.5
    size = max(_CELL * float(np.median(np.linalg.norm(points, axis=1))), 1e-3)
    cell, count = _grid(points, size)
    if len(count) > _MOST_CELLS:
        cell, count = _grid(points, size * float(np.sqrt(len(count) / _MOST_CELLS)))
    means = np.stack([np.bincount(cell, values) for values in (*points.T, share)], axis=1) / count[:, None]
    return means[:, :3], means[:, 3]


def _grid(points: NDArray[np.float64], size: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The cell (N,) of every point, and how many points each cell holds (M,)."""
    cells = np.floor(points / size).astype(np.int64)
    key = (cells[:, 0] * 73_856_093) ^ (cells[:, 1] * 19_349_663) ^ (cells[:, 2] * 83_492_791)
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)
    return cell, count


def _normals(points: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which of the points (N, 3) have neighbours that form a plane (N,), and the normals of those (M, 3)."""
    if len(points) < _NEIGHBOURS:  # a covered sensor sees a single spot
        return np.zeros(len(points), dtype=np.bool_), np.zeros((0, 3))
    _, index = cKDTree(points).query(points, k=_NEIGHBOURS)
    neighbours = points.T[:, index]
    x, y, z = neighbours - neighbours.mean(axis=2, keepdims=True)
    scatter = np.stack([(a * b).sum(axis=1) for a, b in ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))])
    variance = _eigenvalues(scatter)
    plane = (variance[0] < _THICKEST_PLANE * variance[1]) & (variance[1] > _THINNEST_PLANE * variance[2])
    return plane, _eigenvector(scatter[:, plane], variance[0, plane])


def _eigenvalues(A: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, N) rising eigenvalues of symmetric matrices (6, N): xx, yy, zz, xy, xz, yz. Closed form (Smith, CACM 1961)."""
    xx, yy, zz, xy, xz, yz = A
    mean = (xx + yy + zz) / 3.0
    dx, dy, dz = xx - mean, yy - mean, zz - mean
    scale = np.sqrt((dx * dx + dy * dy + dz * dz + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    determinant = dx * (dy * dz - yz * yz) - xy * (xy * dz - yz * xz) + xz * (xy * yz - dy * xz)
    angle = np.arccos(np.clip(0.5 * determinant / np.maximum(scale**3, np.finfo(np.float64).tiny), -1.0, 1.0)) / 3.0
    largest, least = mean + 2.0 * scale * np.cos(angle), mean + 2.0 * scale * np.cos(angle + 2.0 * np.pi / 3.0)
    return np.stack([least, 3.0 * mean - largest - least, largest])


def _eigenvector(A: NDArray[np.float64], eigenvalue: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) unit eigenvectors of an eigenvalue (N,) that is well apart from the others: the longest product of two rows."""
    xx, yy, zz, xy, xz, yz = A
    rows = np.array([[xx - eigenvalue, xy, xz], [xy, yy - eigenvalue, yz], [xz, yz, zz - eigenvalue]])
    products = np.stack([_cross(rows[i], rows[j]) for i, j in ((0, 1), (0, 2), (1, 2))])
    squares = (products * products).sum(axis=1)
    longest = squares.argmax(axis=0)
    column = np.arange(len(eigenvalue))
    axis: NDArray[np.float64] = products[longest, :, column] / np.sqrt(squares[longest, column])[:, None]
    return axis


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """a × b of vectors (3, N)."""
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
