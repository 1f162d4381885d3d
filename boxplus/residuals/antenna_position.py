"""Where the antenna of a satellite receiver was measured to be (docs/residuals/antenna_position.md).

A pose T_map_body is known in a map, and the body knows where its IMU was at the instant of the fix and how fast. With the lever ℓ
from the IMU to the antenna, in the IMU's frame, and a delay δ by which the stamp comes after the measurement,

    a = p_body_imu + R_body_imu ℓ − v δ,     q = R₂ a + p₂,     e = R₁ q + p₁ − z,

(R₁, p₁) = T_enu_map, (R₂, p₂) = T_map_body, z the fix. On the right, T ← T Exp([w, v]):

    ∂e/∂T_enu_map = [−R₁ [q]×  R₁],   ∂e/∂T_map_body = R₁ R₂ [−[a]×  I],   ∂e/∂ℓ = R₁ R₂ R_body_imu,   ∂e/∂δ = −R₁ R₂ v.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.quaternion import rotation_entries
from boxplus.manifolds.se3 import SE3
from boxplus.residuals.point_to_point import checked_points
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

_NO_POSE, _NO_LEVER, _NO_DELAY = np.zeros((0, 3, 6)), np.zeros((0, 3, 3)), np.zeros((0, 3, 1))


@kernel(inline=True)
def _turned(
    R: tuple[float, float, float, float, float, float, float, float, float], x: float, y: float, z: float
) -> tuple[float, float, float]:
    return R[0] * x + R[1] * y + R[2] * z, R[3] * x + R[4] * y + R[5] * z, R[6] * x + R[7] * y + R[8] * z


@kernel
def _antenna_position(
    begin: int,
    end: int,
    T_enu: NDArray[np.float64],
    T_map: NDArray[np.float64],
    levers: NDArray[np.float64],
    delays: NDArray[np.float64],
    enu_of: NDArray[np.uint32],
    map_of: NDArray[np.uint32],
    lever_of: NDArray[np.uint32],
    delay_of: NDArray[np.uint32],
    measured: NDArray[np.float64],
    T_body_imu: NDArray[np.float64],
    velocity: NDArray[np.float64],
    r: NDArray[np.float64],
    J_enu: NDArray[np.float64],
    J_map: NDArray[np.float64],
    J_lever: NDArray[np.float64],
    J_delay: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    for n in range(np.uint64(begin), np.uint64(end)):
        A, B, C = T_enu[enu_of[n]], T_map[map_of[n]], T_body_imu[n]
        lever, delay, v = levers[lever_of[n]], delays[delay_of[n], 0], velocity[n]
        RA = rotation_entries(A[0], A[1], A[2], A[3])
        RB = rotation_entries(B[0], B[1], B[2], B[3])
        RC = rotation_entries(C[0], C[1], C[2], C[3])
        x, y, z = _turned(RC, lever[0], lever[1], lever[2])
        ax, ay, az = x + C[4] - v[0] * delay, y + C[5] - v[1] * delay, z + C[6] - v[2] * delay
        x, y, z = _turned(RB, ax, ay, az)
        qx, qy, qz = x + B[4], y + B[5], z + B[6]
        x, y, z = _turned(RA, qx, qy, qz)
        r[n, 0], r[n, 1], r[n, 2] = x + A[4] - measured[n, 0], y + A[5] - measured[n, 1], z + A[6] - measured[n, 2]
        valid[n] = True
        if with_jacobians:
            for k in range(3):
                # A row of R₁, and of R₁ R₂; a row a of −M [q]× is q × a.
                a0, a1, a2 = RA[3 * k], RA[3 * k + 1], RA[3 * k + 2]
                b0 = a0 * RB[0] + a1 * RB[3] + a2 * RB[6]
                b1 = a0 * RB[1] + a1 * RB[4] + a2 * RB[7]
                b2 = a0 * RB[2] + a1 * RB[5] + a2 * RB[8]
                J_enu[n, k, 0], J_enu[n, k, 1], J_enu[n, k, 2] = qy * a2 - qz * a1, qz * a0 - qx * a2, qx * a1 - qy * a0
                J_enu[n, k, 3], J_enu[n, k, 4], J_enu[n, k, 5] = a0, a1, a2
                J_map[n, k, 0], J_map[n, k, 1], J_map[n, k, 2] = ay * b2 - az * b1, az * b0 - ax * b2, ax * b1 - ay * b0
                J_map[n, k, 3], J_map[n, k, 4], J_map[n, k, 5] = b0, b1, b2
                J_lever[n, k, 0] = b0 * RC[0] + b1 * RC[3] + b2 * RC[6]
                J_lever[n, k, 1] = b0 * RC[1] + b1 * RC[4] + b2 * RC[7]
                J_lever[n, k, 2] = b0 * RC[2] + b1 * RC[5] + b2 * RC[8]
                J_delay[n, k, 0] = -(b0 * v[0] + b1 * v[1] + b2 * v[2])


class AntennaPosition(Residual):
    """Measured positions of an antenna against poses, a lever arm and a delay, as derived in the head of this file.

    Variables: `T_enu_map` (7,) and `T_map_body` (7,) on `SE3`, `p_imu_antenna` (3,) on `Euclidean(3)` [m], `delay` (1,) on
    `Euclidean(1)` [s], positive where stamps come after the measurement. What is known is held (`Problem.fix`): T_enu_map at the
    identity where poses are in ENU already.

    Args:
        p_enu: (N, 3) measured positions, east, north and up of an origin [m].
        T_body_imu: (N, 7) pose of the IMU in the body at each fix; (7,) for all; None: the body is the IMU.
        v_body: (N, 3) velocity of the antenna along the axes of the body [m/s]; None: at rest, a delay has no effect.
        sigma, covariance, information: of a position along east, north and up [m], as in `Whitening.of`.

    Raises:
        InputError: arrays of another shape, of different length or not finite; noise that `Whitening.of` refuses.

    Example: docs/residuals/antenna_position.md

    Example:
        >>> fixes = bp.residuals.AntennaPosition([[1.0, 2.0, 3.5]], sigma=[0.5, 0.5, 1.0])
        >>> pose = [1.0, 0, 0, 0, 1.0, 2.0, 3.0]  # of the body; the antenna is half a metre above
        >>> fixes.evaluate(bp.SE3.identity(), pose, [0.0, 0.0, 0.5], [0.0])
        array([[0., 0., 0.]])
    """

    def __init__(
        self,
        p_enu: ArrayLike,
        T_body_imu: ArrayLike | None = None,
        v_body: ArrayLike | None = None,
        *,
        sigma: ArrayLike | None = None,
        covariance: ArrayLike | None = None,
        information: ArrayLike | None = None,
    ) -> None:
        self.p_enu = checked_points("p_enu", p_enu)
        count = len(self.p_enu)
        poses = SE3.check("T_body_imu", SE3.identity() if T_body_imu is None else T_body_imu)
        if len(poses) not in (1, count):
            raise InputError(f"T_body_imu of shape ({count}, 7) or (7,)", f"{len(poses)} poses", "give one for each fix")
        self.T_body_imu = np.ascontiguousarray(np.broadcast_to(poses, (count, 7)))
        self.v_body = np.zeros((count, 3)) if v_body is None else checked_points("v_body", v_body, count)
        super().__init__(
            dim=3,
            count=count,
            manifolds=(SE3, SE3, Euclidean(3), Euclidean(1)),
            roles=("T_enu_map", "T_map_body", "p_imu_antenna", "delay"),
            whitening=Whitening.of(3, count, sigma=sigma, covariance=covariance, information=information),
            fixes_gauge=False,
        )

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _antenna_position(begin, end, *x, *index, self.p_enu, self.T_body_imu, self.v_body, r, *jacobians, valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        none = _NO_POSE, _NO_POSE, _NO_LEVER, _NO_DELAY
        _antenna_position(begin, end, *x, *index, self.p_enu, self.T_body_imu, self.v_body, r, *none, valid, False)
