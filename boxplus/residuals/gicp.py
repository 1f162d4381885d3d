"""Generalised ICP: corresponding points weighted by the surfaces that both lie on.

Residual [m] and Jacobian are those of point-to-point, e = R p + t − q, moved on the right. The covariance of e depends on the
rotation,

    Σ(R) = C_target + R C_source Rᵀ,

and is held fixed while a problem is linearised and solved; `refresh` brings it up to date between solves, as published
implementations do at every new set of correspondences. The Jacobian is exact for the fixed weight.

Source: Segal, Haehnel and Thrun, Generalized-ICP, RSS 2009.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds import quaternion
from boxplus.residuals.point_to_plane import checked_normals
from boxplus.residuals.point_to_point import PointToPoint
from boxplus.residuals.whitening import Whitening


class Gicp(PointToPoint):
    """Differences of corresponding points under both points' covariances, as derived in the head of this file.

    Variable: `T_target_source` (7,) on `SE3`, which maps points of the source to the frame of the target.

    Args:
        p_source, p_target: (N, 3) corresponding points, each in its own frame [m].
        covariance_source, covariance_target: (N, 3, 3), each in its own frame [m²], such as `plane_covariances` makes.
        T_target_source: (7,) or (N, 7), the pose that the weights are first computed at.

    Raises:
        InputError: arrays of another shape, not finite, or a sum of covariances that is not positive definite.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(10, 3))
        >>> flat = bp.residuals.plane_covariances(np.tile([0.0, 0.0, 1.0], (10, 1)))
        >>> gicp = bp.residuals.Gicp(points, points + [0.0, 0.0, 0.1], flat, flat)
        >>> gicp.evaluate(bp.SE3.identity())[0].round(6) + 0.0
        array([ 0. ,  0. , -0.1])
    """

    def __init__(
        self,
        p_source: ArrayLike,
        p_target: ArrayLike,
        covariance_source: ArrayLike,
        covariance_target: ArrayLike,
        T_target_source: ArrayLike = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        super().__init__(p_source, p_target)
        self.covariance_source = _checked_covariances("covariance_source", covariance_source, self.count)
        self.covariance_target = _checked_covariances("covariance_target", covariance_target, self.count)
        self.refresh(T_target_source)

    def refresh(self, T_target_source: ArrayLike) -> None:
        """Compute the weights at this pose, (7,) or (N, 7)."""
        poses = np.asarray(T_target_source, dtype=np.float64)
        if poses.shape not in ((7,), (self.count, 7)):
            raise InputError(
                f"T_target_source of shape (7,) or ({self.count}, 7)", f"shape {poses.shape}", "give one pose, or one for each"
            )
        R = quaternion.to_matrix(poses[..., :4])
        covariance = self.covariance_target + R @ self.covariance_source @ np.swapaxes(R, -1, -2)
        self.whitening = Whitening.of(3, self.count, covariance=covariance)


def plane_covariances(normals: ArrayLike, *, along: float = 1.0, across: float = 1e-3) -> NDArray[np.float64]:
    """Covariances (N, 3, 3) [m²] of points on planes with unit normals (N, 3).

    Args:
        along: variance within the plane [m²].
        across: variance along the normal [m²]; GICP takes 1 and 1e-3, of which only the ratio matters.

    Raises:
        InputError: normals that are not of unit length, or variances that are not positive.

    Example:
        >>> bp.residuals.plane_covariances([[0.0, 0.0, 1.0]]).round(4)
        array([[[1.   , 0.   , 0.   ],
                [0.   , 1.   , 0.   ],
                [0.   , 0.   , 0.001]]])
    """
    if not (np.isfinite([along, across]).all() and min(along, across) > 0.0):
        raise InputError("positive variances", f"along {along}, across {across}", "a plane of no thickness has no covariance")
    u = checked_normals("normals", normals)
    return along * np.eye(3) - (along - across) * u[:, :, None] * u[:, None, :]


def _checked_covariances(name: str, covariances: ArrayLike, count: int) -> NDArray[np.float64]:
    array = np.array(as_floats(covariances, name))
    if array.shape != (count, 3, 3) or not np.isfinite(array).all():
        raise InputError(f"{name} finite, of shape ({count}, 3, 3)", f"shape {array.shape}", "give one for each correspondence")
    return array
