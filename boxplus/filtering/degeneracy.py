"""Directions of the pose that a scan does not determine, and the update without them.

The information of m points about the pose is Σ h hᵀ / r, h = [s × C, u] (SPEC.md 9.7). Divided by r, by m, and with
rotations measured in units of the points' root-mean-square lever arm, its eigenvalues say which share of the points
measures a direction: about 1/3 each in a well-shaped room, 0 along a perfect corridor. Noise in the normals alone makes
that share a few thousandths, so an eigenvalue below the threshold is noise, not a measurement, however many points there
are. In such a direction the update is projected out and the filter keeps its prediction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class PoseDirections:
    """Eigen-directions of a scan's information about the pose.

    Attributes:
        shares: (6,) ascending, share of the points that measures each direction.
        vectors: (6, 6), column i is the unit direction of `shares[i]`: rotation (IMU axes, times `lever_arm`), then position.
        lever_arm: root mean square distance of the points from the IMU [m].
        weak: (6,) bool, share below the threshold.
    """

    shares: NDArray[np.float64]
    vectors: NDArray[np.float64]
    lever_arm: float
    weak: NDArray[np.bool_]


def pose_directions(A: NDArray[np.float64], lever_arm: float, threshold: float) -> PoseDirections:
    """Analyse the pose block of A (12, 12), the information of a scan.

    The three position rows of A carry unit normals, so their trace is Σ 1/r: the scale is taken from A itself.
    """
    scale = np.array([1.0 / lever_arm] * 3 + [1.0] * 3)
    total = max(float(np.trace(A[3:6, 3:6])), np.finfo(float).tiny)
    shares, vectors = np.linalg.eigh(A[:6, :6] * np.outer(scale, scale) / total)
    return PoseDirections(shares, vectors, lever_arm, shares < threshold)


def project_out_weak(
    A: NDArray[np.float64], b: NDArray[np.float64], directions: PoseDirections
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A and b without what they claim about the weak directions of the pose."""
    if not directions.weak.any():
        return A, b
    strong = directions.vectors[:, ~directions.weak]
    scale = np.array([directions.lever_arm] * 3 + [1.0] * 3)
    projector = np.eye(12)
    # In scaled coordinates the projector is V Vᵀ; information transforms with the inverse scale.
    projector[:6, :6] = (strong @ strong.T) * np.outer(1.0 / scale, scale)
    return projector.T @ A @ projector, projector.T @ b


def strong_step(A: NDArray[np.float64], b: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """The Gauss-Newton step (6,) of the pose alone, without the weak directions; zero if all are weak."""
    step: NDArray[np.float64] = -strong_covariance(A, directions) @ b[:6]
    return step


def strong_covariance(A: NDArray[np.float64], directions: PoseDirections) -> NDArray[np.float64]:
    """(6, 6) covariance of the pose from A alone, zero along the weak directions."""
    scale = np.array([1.0 / directions.lever_arm] * 3 + [1.0] * 3)
    strong = directions.vectors[:, ~directions.weak]
    reduced = strong.T @ (A[:6, :6] * np.outer(scale, scale)) @ strong
    covariance: NDArray[np.float64] = np.outer(scale, scale) * (strong @ np.linalg.solve(reduced, strong.T))
    return covariance
