"""Distance of points from planes (docs/lidar_inertial_odometry.md, sections 5 and 6).

Residual [m], for a point p of the source and a plane of the target through q with unit normal u, (R, t) = T_target_source:

    e = uᵀ(R p + t − q)

Jacobian with T_target_source moved on the right, T ← T Exp([w, v]), C = Rᵀ u:  ∂e/∂[w, v] = [(p × C)ᵀ  Cᵀ].
The sign of u is irrelevant: e and its Jacobian flip together.

Source: Chen and Medioni, Object Modelling by Registration of Multiple Range Images, IVC 1992.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.point_to_point import checked_points
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

NO_JACOBIANS = np.zeros((0, 1, 6))
_UNIT_TOLERANCE = 1e-3


@kernel
def _point_to_plane(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    p_source: NDArray[np.float64],
    planes: NDArray[np.float64],
    r: NDArray[np.float64],
    J: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        T = poses[pose_of[n]]
        R = rotation_entries(T[0], T[1], T[2], T[3])
        x, y, z = p_source[n, 0], p_source[n, 1], p_source[n, 2]
        ux, uy, uz = planes[n, 0], planes[n, 1], planes[n, 2]
        # C = Rᵀ u; the distance in the source's frame needs no point of the target.
        cx = R[0] * ux + R[3] * uy + R[6] * uz
        cy = R[1] * ux + R[4] * uy + R[7] * uz
        cz = R[2] * ux + R[5] * uy + R[8] * uz
        dx, dy, dz = T[4] - planes[n, 3], T[5] - planes[n, 4], T[6] - planes[n, 5]
        r[n, 0] = cx * x + cy * y + cz * z + ux * dx + uy * dy + uz * dz
        valid[n] = True
        if with_jacobians:
            J[n, 0, 0] = y * cz - z * cy
            J[n, 0, 1] = z * cx - x * cz
            J[n, 0, 2] = x * cy - y * cx
            J[n, 0, 3], J[n, 0, 4], J[n, 0, 5] = cx, cy, cz


class PointToPlane(Residual):
    """Signed distances of points from planes, as derived in the head of this file.

    Variable: `T_target_source` (7,) on `SE3`, which maps points of the source to the frame of the target.

    Args:
        p_source: (N, 3) in the source's frame [m].
        p_target: (N, 3) a point of each plane, in the target's frame [m].
        normals_target: (N, 3) unit normals of the planes, in the target's frame.
        sigma, covariance, information: of a distance [m], as in `Whitening.of`.

    Raises:
        InputError: arrays of another shape, of different length or not finite; a normal whose length is not 1; noise that
            `Whitening.of` refuses.

    Example:
        >>> distance = bp.residuals.PointToPlane([[1.0, 2.0, 0.3]], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]], sigma=0.02)
        >>> np.abs(distance.evaluate(bp.SE3.identity()))
        array([[0.3]])
    """

    def __init__(
        self,
        p_source: ArrayLike,
        p_target: ArrayLike,
        normals_target: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.p_source = checked_points("p_source", p_source)
        count = len(self.p_source)
        self.p_target = checked_points("p_target", p_target, count)
        self.normals_target = checked_normals("normals_target", normals_target, count)
        super().__init__(
            dim=1,
            count=count,
            manifolds=(SE3,),
            roles=("T_target_source",),
            whitening=Whitening.of(1, count, sigma=sigma, covariance=covariance, information=information),
        )
        self._planes = np.hstack([self.normals_target, self.p_target])

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _point_to_plane(begin, end, x[0], index[0], self.p_source, self._planes, r, jacobians[0], valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _point_to_plane(begin, end, x[0], index[0], self.p_source, self._planes, r, NO_JACOBIANS, valid, False)


def checked_normals(name: str, normals: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
    """Normals (N, 3) brought to unit length where they are off by rounding only.

    Raises:
        InputError: as `checked_points`, or a length that is not 1.
    """
    array = checked_points(name, normals, count)
    length = np.linalg.norm(array, axis=1)
    unit = np.abs(length - 1.0) <= _UNIT_TOLERANCE
    if not unit.all():
        n = int(np.argmin(unit))
        raise InputError(f"{name} of length 1", f"{length[n]:.6g} in row {n}", "normalise them; leave out points without a plane")
    unit_normals: NDArray[np.float64] = array / length[:, None]
    return unit_normals
