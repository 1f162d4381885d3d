"""The navigation state of FAST-LIO2 and its manifold, 24 degrees of freedom (docs/lidar_inertial_odometry.md, section 1).

x = (R, p, v, b_ω, b_a, g, R_imu_lidar, p_imu_lidar): pose and velocity of the IMU in the world, gyro and accelerometer
bias, gravity (pointing down), pose of the LiDAR in the IMU frame. The tangent has the same order, three components a
block: `[θ, p, v, b_ω, b_a, g, θ_L, p_L]`; rotations are updated on the right, everything else is added.

Kernels work on the state packed into one array of 36 numbers (rotations as row-major matrices); `NavState` is the view of
it that people use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.manifolds.so3 import exp_into, log_into

# Offsets into the packed state.
R, P, V, BW, BA, G, RL, PL = 0, 9, 12, 15, 18, 21, 24, 33
PACKED = 36
# Offsets into the tangent.
TANGENT = 24
T_THETA, T_P, T_V, T_BW, T_BA, T_G, T_THETA_L, T_P_L = 0, 3, 6, 9, 12, 15, 18, 21
# The components a LiDAR point measures: pose, then extrinsic.
MEASURED = np.array([0, 1, 2, 3, 4, 5, 18, 19, 20, 21, 22, 23])

STANDARD_GRAVITY = 9.81


@kernel
def _place_into(R: NDArray[np.float64], p: NDArray[np.float64], points: NDArray[np.float32], placed: NDArray[np.float64]) -> None:
    """placed = R points + p, row by row (N, 3); a matrix product would wake the threads of BLAS for it."""
    flat, out = points.reshape(-1), placed.reshape(-1)
    for n in range(np.uint64(points.shape[0])):
        i, j, k = np.uint64(3) * n, np.uint64(3) * n + np.uint64(1), np.uint64(3) * n + np.uint64(2)
        x, y, z = np.float64(flat[i]), np.float64(flat[j]), np.float64(flat[k])
        out[i] = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z + p[0]
        out[j] = R[1, 0] * x + R[1, 1] * y + R[1, 2] * z + p[1]
        out[k] = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z + p[2]


@dataclass(frozen=True, slots=True)
class NavState:
    """The navigation state, one attribute a symbol.

    Attributes:
        R_world_imu: (3, 3) float64.
        p_world_imu: (3,) float64 [m].
        v_world_imu: (3,) float64, velocity of the IMU in the world [m/s].
        bias_gyro: (3,) float64 [rad/s], IMU frame.
        bias_accel: (3,) float64 [m/s²], IMU frame.
        gravity_world: (3,) float64 [m/s²], pointing down.
        R_imu_lidar: (3, 3) float64.
        p_imu_lidar: (3,) float64, origin of the LiDAR in the IMU frame [m].

    Example:
        >>> zero = np.zeros(3)
        >>> state = bp.NavState(np.eye(3), zero, zero, zero, zero, np.array([0.0, 0.0, -9.81]), np.eye(3), zero)
        >>> moved = state.boxplus(np.eye(24)[3])  # a metre along x
        >>> moved.p_world_imu.tolist(), float(moved.boxminus(state)[3])
        ([1.0, 0.0, 0.0], 1.0)
    """

    R_world_imu: NDArray[np.float64]
    p_world_imu: NDArray[np.float64]
    v_world_imu: NDArray[np.float64]
    bias_gyro: NDArray[np.float64]
    bias_accel: NDArray[np.float64]
    gravity_world: NDArray[np.float64]
    R_imu_lidar: NDArray[np.float64]
    p_imu_lidar: NDArray[np.float64]

    @classmethod
    def identity(cls, T_imu_lidar: NDArray[np.float64] | None = None) -> NavState:
        """At the origin, at rest, gravity along −z, without biases; `T_imu_lidar` (4, 4) defaults to the identity.

        Raises:
            InputError: `T_imu_lidar` is not a rigid transform.
        """
        T = np.eye(4) if T_imu_lidar is None else check_transform("T_imu_lidar", T_imu_lidar)
        zero = np.zeros(3)
        gravity = np.array([0.0, 0.0, -STANDARD_GRAVITY])
        return cls(np.eye(3), zero, zero, zero, zero, gravity, T[:3, :3].copy(), T[:3, 3].copy())

    def pack(self) -> NDArray[np.float64]:
        """The state as one array of 36 numbers, as the kernels take it."""
        return np.concatenate(
            [
                self.R_world_imu.ravel(),
                self.p_world_imu,
                self.v_world_imu,
                self.bias_gyro,
                self.bias_accel,
                self.gravity_world,
                self.R_imu_lidar.ravel(),
                self.p_imu_lidar,
            ]
        )

    @classmethod
    def unpack(cls, x: NDArray[np.float64]) -> NavState:
        """The state from its 36 numbers."""
        x = x.copy()
        return cls(
            x[R:P].reshape(3, 3), x[P:V], x[V:BW], x[BW:BA], x[BA:G], x[G:RL], x[RL:PL].reshape(3, 3), x[PL:PACKED]
        )  # fmt: skip

    def to_world(self, p_lidar: NDArray[np.float32]) -> NDArray[np.float64]:
        """Points (N, 3) of the LiDAR frame in the world."""
        p_world = np.empty(p_lidar.shape)
        R_world_lidar = self.R_world_imu @ self.R_imu_lidar
        p_world_lidar = self.R_world_imu @ self.p_imu_lidar + self.p_world_imu
        _place_into(R_world_lidar, p_world_lidar, np.ascontiguousarray(p_lidar, dtype=np.float32), p_world)
        return p_world

    def boxplus(self, delta: NDArray[np.float64]) -> NavState:
        """x ⊞ δ with δ (24,)."""
        x = self.pack()
        boxplus_into(x, np.ascontiguousarray(delta, dtype=np.float64), x)
        return NavState.unpack(x)

    def boxminus(self, base: NavState) -> NDArray[np.float64]:
        """x ⊟ base, (24,): the δ with base ⊞ δ = x."""
        delta = np.zeros(TANGENT)
        boxminus_into(self.pack(), base.pack(), delta)
        return delta


def check_transform(name: str, T: object) -> NDArray[np.float64]:
    """Return `T` as a (4, 4) rigid transform with its rotation made exactly orthonormal.

    Raises:
        InputError: wrong shape, not finite, not a rotation within 1e-3, or a last row that is not 0 0 0 1.
    """
    matrix = np.asarray(T, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"{name} as a 4×4 matrix", f"shape {matrix.shape}", "give R and p as [[R, p], [0 0 0 1]]")
    rotation_ok = np.isfinite(matrix).all() and so3.is_rotation(matrix[:3, :3], tolerance=1e-3)
    if not rotation_ok or np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-9:
        R_given = matrix[:3, :3]
        finite = bool(np.isfinite(matrix).all())
        deviation = np.abs(R_given.T @ R_given - np.eye(3)).max() if finite else np.nan
        determinant = np.linalg.det(R_given) if finite else np.nan
        raise InputError(
            f"{name} with an orthonormal rotation of determinant +1 and last row 0 0 0 1",
            f"RᵀR off by {deviation:.2g}, determinant {determinant:.3g}, last row {matrix[3].tolist()}",
            "check the order of the numbers (row-major) and that all digits were copied",
        )
    clean = matrix.copy()
    # One that is orthonormal to rounding stays as it is, so that a written transform is read back to the bit.
    if np.abs(clean[:3, :3].T @ clean[:3, :3] - np.eye(3)).max() > 1e-14:
        U, _, Vt = np.linalg.svd(clean[:3, :3])
        clean[:3, :3] = U @ Vt
    return clean


@kernel
def boxplus_into(x: NDArray[np.float64], delta: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = x ⊞ δ; `out` may be `x`."""
    step = np.empty((3, 3))
    product = np.empty((3, 3))
    for offset, tangent in ((R, T_THETA), (RL, T_THETA_L)):
        exp_into(delta[tangent], delta[tangent + 1], delta[tangent + 2], step)
        for i in range(3):
            for j in range(3):
                product[i, j] = (
                    x[offset + 3 * i] * step[0, j] + x[offset + 3 * i + 1] * step[1, j] + x[offset + 3 * i + 2] * step[2, j]
                )
        for i in range(3):
            for j in range(3):
                out[offset + 3 * i + j] = product[i, j]
    for i in range(15):
        out[P + i] = x[P + i] + delta[T_P + i]
    for i in range(3):
        out[PL + i] = x[PL + i] + delta[T_P_L + i]


@kernel
def boxminus_into(x: NDArray[np.float64], base: NDArray[np.float64], delta: NDArray[np.float64]) -> None:
    """delta = x ⊟ base."""
    relative = np.empty((3, 3))
    w = np.empty(3)
    for offset, tangent in ((R, T_THETA), (RL, T_THETA_L)):
        for i in range(3):
            for j in range(3):
                relative[i, j] = (
                    base[offset + i] * x[offset + j]
                    + base[offset + 3 + i] * x[offset + 3 + j]
                    + base[offset + 6 + i] * x[offset + 6 + j]
                )
        log_into(relative, w)
        for i in range(3):
            delta[tangent + i] = w[i]
    for i in range(15):
        delta[T_P + i] = x[P + i] - base[P + i]
    for i in range(3):
        delta[T_P_L + i] = x[PL + i] - base[PL + i]
