"""Distance of corresponding points of two clouds, as in ICP.

Residual [m], for a point p of the source and its counterpart q of the target, (R, t) = T_target_source:

    e = R p + t − q

Jacobian with T_target_source moved on the right, T ← T Exp([w, v]):  ∂e/∂[w, v] = R [−[p]×  I].

Source: Besl and McKay, A Method for Registration of 3-D Shapes, PAMI 1992; derivatives as of a point to a plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

NO_JACOBIANS = np.zeros((0, 3, 6))


@kernel
def _point_to_point(
    begin: int,
    end: int,
    poses: NDArray[np.float64],
    pose_of: NDArray[np.uint32],
    p_source: NDArray[np.float64],
    p_target: NDArray[np.float64],
    r: NDArray[np.float64],
    J: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        T = poses[pose_of[n]]
        R = rotation_entries(T[0], T[1], T[2], T[3])
        x, y, z = p_source[n, 0], p_source[n, 1], p_source[n, 2]
        valid[n] = True
        for i in range(3):
            rx, ry, rz = R[3 * i], R[3 * i + 1], R[3 * i + 2]
            r[n, i] = rx * x + ry * y + rz * z + T[4 + i] - p_target[n, i]
            if with_jacobians:
                J[n, i, 0] = rz * y - ry * z
                J[n, i, 1] = rx * z - rz * x
                J[n, i, 2] = ry * x - rx * y
                J[n, i, 3], J[n, i, 4], J[n, i, 5] = rx, ry, rz


class PointToPoint(Residual):
    """Differences of corresponding points, as derived in the head of this file.

    Variable: `T_target_source` (7,) on `SE3`, which maps points of the source to the frame of the target.

    Args:
        p_source, p_target: (N, 3) corresponding points, each in its own frame [m].
        sigma, covariance, information: of a difference, in the target's frame, as in `Whitening.of`.

    Raises:
        InputError: points of another shape, of different number or not finite; noise that `Whitening.of` refuses.

    Example:
        >>> np.abs(bp.residuals.PointToPoint([[1.0, 2.0, 0.3]], [[1.0, 2.0, 0.0]]).evaluate(bp.SE3.identity()))
        array([[0. , 0. , 0.3]])
    """

    def __init__(
        self,
        p_source: ArrayLike,
        p_target: ArrayLike,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.p_source = checked_points("p_source", p_source)
        self.p_target = checked_points("p_target", p_target, len(self.p_source))
        count = len(self.p_source)
        super().__init__(
            dim=3,
            count=count,
            manifolds=(SE3,),
            roles=("T_target_source",),
            whitening=Whitening.of(3, count, sigma=sigma, covariance=covariance, information=information),
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _point_to_point(begin, end, x[0], index[0], self.p_source, self.p_target, r, jacobians[0], valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _point_to_point(begin, end, x[0], index[0], self.p_source, self.p_target, r, NO_JACOBIANS, valid, False)


def checked_points(name: str, points: ArrayLike, count: int | None = None) -> NDArray[np.float64]:
    """Points as a new (N, 3) float64 array.

    Raises:
        InputError: another shape, another number than `count`, or not finite.
    """
    array = np.array(as_floats(points, name), order="C")
    rows = "N" if count is None else str(count)
    if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
        raise InputError(f"{name} of shape ({rows}, 3)", f"shape {array.shape}", "give one row for each correspondence")
    finite = np.isfinite(array).all(axis=1)
    if not finite.all():
        raise InputError(f"{name} finite", f"{array[np.argmin(finite)]} in row {int(np.argmin(finite))}", "leave that point out")
    return array
