"""One local map, and the relative covariance of the odometry between two of them. Derivations: docs/slam.md."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.filtering.small_linalg import positive_part
from boxplus.manifolds import se3
from boxplus.manifolds.se3 import SE3

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap:
    """What was seen on a stretch of odometry.

    Its frame `map` stands where the middle of the stretch was, z up (against gravity; without an IMU as surfaces show it),
    x ahead of the body. The middle rather than the beginning: the odometry drifts within a local map too, and half of its points
    then lie on either side.

    Attributes:
        number: 0, 1, … in the order of time.
        time_ns: of the frame; begin_ns, end_ns: of the first and last scan; absolute [ns].
        T_odo_map: (7,) the frame in the odometry's world [qw, qx, qy, qz, x, y, z].
        covariance: (6, 6) of T_before_map = T_odo_before⁻¹ T_odo_map, moved on the right by [w, v] [rad, m], in this map's frame;
            zero for the first.
        path_m: way from the start of the odometry to the frame [m].
        points: (N, 3) float32 [m], map frame, one per voxel.
        scans: how many it was made of.
        is_level: z is up; False where nobody said and nothing showed where up is: it stands as the body did when they began.
    """

    number: int
    time_ns: int
    begin_ns: int
    end_ns: int
    T_odo_map: Floats
    covariance: Floats
    path_m: float
    points: NDArray[np.float32]
    scans: int
    is_level: bool = True


def relative_covariance(covariance_before: ArrayLike, covariance_after: ArrayLike, T_before_after: ArrayLike) -> Floats:
    """(6, 6) covariance that odometry adds between two poses, given that of each against the first pose.

    Errors on the right compose as ξ_after = Ad(T_before_after⁻¹) ξ_before + ζ with an increment ζ that does not depend on what
    was before, so that Cov ζ = P_after − Ad P_before Adᵀ (docs/slam.md). Where the difference is not positive (an odometry that
    claims to know more than before) the negative part is left out.

    Args:
        covariance_before, covariance_after: (6, 6) of [w, v] on the right of either pose [rad, m].
        T_before_after: (7,) the second pose in the first.

    Raises:
        InputError: matrices of another shape or not finite, a pose whose quaternion is not of unit length.
    """
    before, after = (
        checked_covariance("covariance_before", covariance_before),
        checked_covariance("covariance_after", covariance_after),
    )
    Ad = se3.adjoint(se3.inverse(SE3.check("T_before_after", np.atleast_2d(np.asarray(T_before_after, dtype=np.float64)))[0]))
    return positive_part(after - Ad @ before @ Ad.T)


def drift_covariance(length_m: float, rotation: float, position: float) -> Floats:
    """(6, 6) of a random walk over a way: `rotation`² · length about each axis, `position`² · length along each."""
    return np.diag(np.repeat([rotation**2 * length_m, position**2 * length_m], 3))


def checked_covariance(name: str, covariance: ArrayLike) -> Floats:
    """(6, 6), finite and symmetric to rounding."""
    matrix = as_floats(covariance, name)
    if matrix.shape != (6, 6) or not np.isfinite(matrix).all():
        raise InputError(f"{name} of shape (6, 6), finite", f"shape {matrix.shape}", "give the covariance of [w, v] [rad, m]")
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=1e-12 + 1e-9 * float(np.abs(matrix).max())):
        raise InputError(f"a symmetric {name}", "one that is not", "check the order of its entries")
    return 0.5 * (matrix + matrix.T)
