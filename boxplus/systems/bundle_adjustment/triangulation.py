"""Points from the rays that see them, and the pose of a camera from the points it sees: linear, as a start.

Derivation: docs/residuals/reprojection.md.
A point p is taken where the squared distances to its rays, each divided by the distance from the camera, are least:
Σ w (I − d dᵀ)(p − c) = 0 with the centres c, unit directions d and w = 1/‖p − c‖², which makes distances angles (Hartley and
Sturm, Triangulation, 1997). A pose is the direct linear transform from bearings (Hartley and Zisserman, Multiple view geometry,
7.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_ROUNDS = 4  # of the weights
_PARALLEL = 1e-13  # mean squared sine between the rays below which they do not meet anywhere
_LEAST_POINTS = 6
_FLAT = 1e-3  # thickness of a cloud, as a share of its length, below which a plane explains it and the transform fails


def intersect_rays(
    centers: NDArray[np.float64], directions: NDArray[np.float64], of: NDArray[np.intp], count: int
) -> NDArray[np.float64]:
    """Points (count, 3) nearest to their rays; NaN where fewer than two rays that are not parallel belong to one.

    Args:
        centers, directions: (r, 3) rays, directions of any length.
        of: (r,) the point of each ray.
    """
    if not len(of):
        return np.full((count, 3), np.nan)
    middle = centers.mean(axis=0)  # far from the origin, digits are scarce
    c = centers - middle
    d = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    times = np.bincount(of, minlength=count)
    points = np.full((count, 3), np.nan)
    weight = np.ones(len(of))
    for _ in range(_ROUNDS):
        A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
        np.add.at(A, of, weight[:, None, None] * across)
        np.add.at(b, of, weight[:, None] * np.einsum("nij,nj->ni", across, c))
        total = np.einsum("nii->n", A) / 2.0
        solvable = (times >= 2) & (np.linalg.eigvalsh(A)[:, 0] > _PARALLEL * total)
        points[~solvable] = np.nan
        points[solvable] = np.linalg.solve(A[solvable], b[solvable][:, :, None])[:, :, 0]
        length = np.linalg.norm(points[of] - c, axis=1)
        weight = np.where(np.isfinite(length) & (length > 0.0), 1.0 / np.maximum(length, 1e-150) ** 2, weight)
    return np.asarray(points + middle)


def pose_from_points(
    points: NDArray[np.float64], bearings: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """R_camera_world (3, 3) and t (3,) of a camera that sees points (r, 3) along bearings (r, 3), z = 1.

    Returns:
        None where fewer than six points are given, or points in a plane.
    """
    if len(points) < _LEAST_POINTS:
        return None
    middle = points.mean(axis=0)
    spread = np.linalg.svd(points - middle, compute_uv=False)
    if spread[2] <= _FLAT * spread[0]:
        return None
    scale = spread[0] / np.sqrt(len(points))
    X = np.column_stack([(points - middle) / scale, np.ones(len(points))])
    rows = np.zeros((2 * len(X), 12))
    rows[0::2, 0:4], rows[0::2, 8:12] = X, -bearings[:, :1] * X
    rows[1::2, 4:8], rows[1::2, 8:12] = X, -bearings[:, 1:2] * X
    P = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 4)
    if np.linalg.det(P[:, :3]) < 0.0:
        P = -P
    U, length, V = np.linalg.svd(P[:, :3])
    R = U @ V
    if np.linalg.det(R) < 0.0 or length[2] <= 0.0:
        return None
    t = P[:, 3] / length.mean() * scale
    return R, t - R @ middle
