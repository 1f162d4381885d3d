"""The transform that brings an estimate into the frame of the ground truth, from matched positions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion

PositionAlignment = Literal["none", "yaw", "se3", "sim3"]
AlignmentKind = Literal["none", "yaw", "se3", "sim3", "origin"]

_COINCIDENT_M = 1e-6
_CLEARLY = 0.25  # of the squared error of a rotation, that of a mirror image
_ROUNDING = 1e-9  # of the mean squared size of a path, below which its errors are none
_COLLINEAR = 1e-3  # second against first principal standard deviation


class UndeterminedAlignmentError(InputError):
    """Positions that do not determine the alignment asked for: too few, all in one place, or on one line.

    Example:
        >>> try:
        ...     bp.evaluation.alignment.align(np.zeros((5, 3)), np.zeros((5, 3)))
        ... except bp.InputError as error:
        ...     print(type(error).__name__)
        UndeterminedAlignmentError
    """


@dataclass(frozen=True, slots=True)
class Alignment:
    """x_world = scale · R_world_estimate · x_estimate + p_world_estimate.

    Attributes:
        kind: `none`, `yaw`, `se3`, `sim3` or `origin`.
        R_world_estimate: (3, 3) rotation.
        p_world_estimate: (3,) [m].
        scale: 1 unless `sim3`.
        spread_m: (3,) principal standard deviations of the matched ground-truth positions, largest first [m].
        mirrored: the best fit without the demand for a rotation would have been a mirror image.
    """

    kind: AlignmentKind
    R_world_estimate: NDArray[np.float64]
    p_world_estimate: NDArray[np.float64]
    scale: float
    spread_m: NDArray[np.float64]
    mirrored: bool

    def apply(self, trajectory: Trajectory) -> Trajectory:
        """The trajectory in the frame of the ground truth. Covariances are dropped: they belong to the frame before."""
        R = self.R_world_estimate @ trajectory.R
        p = self.scale * trajectory.p @ self.R_world_estimate.T + self.p_world_estimate
        return replace(trajectory, p=p, q_wxyz=quaternion.from_matrix(R), matrices=R, covariance=None, lines=None)


def align_origin(estimate: Trajectory, ground_truth: Trajectory) -> Alignment:
    """The transform that lays the first pose of the estimate onto that of the ground truth, both matched: T_gt,0 T_est,0⁻¹."""
    R = ground_truth.R[0] @ estimate.R[0].T
    return Alignment("origin", R, ground_truth.p[0] - R @ estimate.p[0], 1.0, principal_spread(ground_truth.p), False)


def align(p_estimate: ArrayLike, p_ground_truth: ArrayLike, kind: PositionAlignment = "se3") -> Alignment:
    """Least-squares transform of the estimate's positions onto the ground truth's (Umeyama 1991, eqs. 34-42).

    Args:
        p_estimate, p_ground_truth: (M, 3) matched positions [m].
        kind: `se3` (rotation and translation), `sim3` (and scale), `yaw` (rotation about z and translation, which is what an
            estimator with gravity does not know: Zhang and Scaramuzza, IROS 2018) or `none` (identity).

    Raises:
        InputError: arrays of other shapes.
        UndeterminedAlignmentError: fewer than three positions, or positions that do not determine the rotation: all in one
            place or on one line; for `yaw` one above the other.
    """
    x, y = np.asarray(p_estimate, dtype=np.float64), np.asarray(p_ground_truth, dtype=np.float64)
    if x.ndim != 2 or x.shape[1:] != (3,) or x.shape != y.shape:
        raise InputError(
            "matched positions of shape (M, 3)", f"shapes {x.shape} and {y.shape}", "associate the trajectories first"
        )
    spread = principal_spread(y)
    if kind == "none":
        return Alignment(kind, np.eye(3), np.zeros(3), 1.0, spread, False)
    if len(x) < 3:
        raise UndeterminedAlignmentError(
            "at least three matched positions to align",
            f"{len(x)}",
            'compare with alignment="origin" or alignment="none", or match more poses',
        )
    if kind == "yaw":
        return _align_heading(x, y, spread)
    for name, values in (("ground truth", spread), ("estimate", principal_spread(x))):
        if values[0] < _COINCIDENT_M:
            raise UndeterminedAlignmentError(
                f"{name} positions that differ, to align by them",
                f"{len(x)} positions within {values[0]:.1e} m: rotation undetermined",
                'compare with alignment="origin", by the first pose, or alignment="none"',
            )
        if values[1] < _COLLINEAR * values[0]:
            raise UndeterminedAlignmentError(
                f"{name} positions off one line, to align by them",
                f"{len(x)} positions that stray {values[1]:.2g} m from a line of {values[0]:.3g} m (standard deviations): the "
                "rotation about that line is undetermined",
                'compare with alignment="origin", by the first pose, or alignment="none"',
            )
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    U, d, Vt = np.linalg.svd((y - mean_y).T @ (x - mean_x) / len(x))
    sign = np.array([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)])
    R = (U * sign) @ Vt
    sizes = [float(((p - mean) ** 2).sum(axis=1).mean()) for p, mean in ((x, mean_x), (y, mean_y))]
    scale = float((d * sign).sum()) / sizes[0] if kind == "sim3" else 1.0

    def left(fit: float) -> float:
        """Mean squared error with Σ ȳᵀ R x̄ = fit, R a rotation or a mirror image."""
        return sizes[1] - fit * fit / sizes[0] if kind == "sim3" else sizes[0] + sizes[1] - 2.0 * fit

    rigid = left(float((d * sign).sum()))
    clearly = rigid > _ROUNDING * sizes[1] and left(float(d.sum())) < _CLEARLY * rigid
    mirrored = bool(sign[2] < 0 and (d[2] > 0.1 * d[1] or clearly))
    return Alignment(kind, R, mean_y - scale * R @ mean_x, scale, spread, mirrored)


def _align_heading(x: NDArray[np.float64], y: NDArray[np.float64], spread: NDArray[np.float64]) -> Alignment:
    """The rotation about z and the translation, closed: the angle of Σ x̄* ȳ, horizontal positions as complex numbers."""
    mean_x, mean_y = x.mean(axis=0), y.mean(axis=0)
    flat_x, flat_y = ((p - mean)[:, 0] + 1j * (p - mean)[:, 1] for p, mean in ((x, mean_x), (y, mean_y)))
    for name, flat in (("ground truth", flat_y), ("estimate", flat_x)):
        size = float(np.sqrt(np.mean(np.abs(flat) ** 2)))
        if size < _COINCIDENT_M:
            raise UndeterminedAlignmentError(
                f"{name} positions that differ horizontally, to align the heading by them",
                f"{len(x)} positions within {size:.1e} m of one vertical",
                'compare with alignment="origin", by the first pose, or alignment="none"',
            )
    angle = float(np.angle(np.vdot(flat_x, flat_y)))
    R = np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
    return Alignment("yaw", R, mean_y - R @ mean_x, 1.0, spread, False)


def principal_spread(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) standard deviations of (M, 3) positions along their principal axes, largest first [m]."""
    centred = p - p.mean(axis=0)
    values = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(p))
    return np.concatenate([values, np.zeros(3 - len(values))])
