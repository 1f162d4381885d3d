"""IMU error between two keyframes (docs/residuals/imu_preintegration.md).

States: pose (q, p) of the IMU in the world, and [v, b_a, b_g]; T the duration, R = R(q_i), g gravity pointing down. With α̂, β̂,
γ̂ corrected for the bias (7.4) and E = γ̂⁻¹ ⊗ q_i⁻¹ ⊗ q_j, its sign such that w ≥ 0, the residual (15) is

    [ Rᵀ(p_j − p_i − v_i T − ½ g T²) − α̂,  Log(E) or 2 E_xyz,  Rᵀ(v_j − v_i − g T) − β̂,  b_aj − b_ai,  b_gj − b_gi ]

Gravity may be a variable by its direction u on `S2`, g = ‖g‖ u, and so may the time offset t_d: the sensor whose poses these
are stamps t what the IMU's clock calls t + t_d. The intervals then begin and end t_d − t_d0 later than they were integrated, t_d0
being the offset assumed there; to first order (`Preintegration.time_jacobian`)

    α̂ + α_t (t_d − t_d0),    γ̂ = γ Exp(J^γ_bg δb_g + θ_t (t_d − t_d0)),    β̂ + β_t (t_d − t_d0)

    ∂e/∂δ_u = ‖g‖ [−½ T² Rᵀ B(u),  0,  −T Rᵀ B(u)],    ∂e/∂t_d = [−α_t,  −J_l⁻¹(Log E) J_r(δθ) θ_t,  −β_t]

Its Jacobians are derived there, with the columns of a pose in the order of its tangent, [θ, p]; q is moved on the right
and p is added to. `2 E_xyz` saturates at 2 and loses rank at a half turn; Log(E) does neither.

Source: Forster et al., TRO 2017; Qin, Li and Shen, VINS-Mono, TRO 2018; corrected on that page.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus._numbers import as_floats
from boxplus.errors import InputError
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.euclidean import Euclidean
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.quaternion import exp_scalars, multiply_scalars, rotation_entries
from boxplus.manifolds.so3 import exp_coefficients, inverse_jacobian_coefficient, log_quaternion
from boxplus.manifolds.sphere import S2, basis_scalars
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from boxplus.residuals.inertial.sample_checks import rows_of
from boxplus.residuals.matrix3 import IDENTITY, Matrix3, apply, multiply, polynomial, scaled, transposed
from boxplus.residuals.residual import Array, Arrays, Mask, Residual, Rows
from boxplus.residuals.whitening import Whitening

VELOCITY_BIAS = Euclidean(9)
_OPTIONAL: tuple[tuple[str, Manifold], ...] = (("gravity_direction", S2), ("imu_time_offset", Euclidean(1)))
REINTEGRATE_OFFSET_S = 0.005  # change of the time offset above which the first order is given up
_NO_JACOBIANS = tuple(np.zeros((0, 15, dof)) for dof in (6, 9, 6, 9, 2, 1))


@kernel(inline=True)
def _store(A: Matrix3, J: NDArray[np.float64], n: np.uint64, row: int, column: int) -> None:
    for i in range(3):
        for j in range(3):
            J[n, row + i, column + j] = A[3 * i + j]


@kernel(inline=True)
def _block(A: NDArray[np.float64], n: np.uint64, row: int, column: int) -> Matrix3:
    return (
        A[n, row, column],
        A[n, row, column + 1],
        A[n, row, column + 2],
        A[n, row + 1, column],
        A[n, row + 1, column + 1],
        A[n, row + 1, column + 2],
        A[n, row + 2, column],
        A[n, row + 2, column + 1],
        A[n, row + 2, column + 2],
    )


@kernel
def _imu(
    begin: int,
    end: int,
    poses_i: NDArray[np.float64],
    states_i: NDArray[np.float64],
    poses_j: NDArray[np.float64],
    states_j: NDArray[np.float64],
    pose_i_of: NDArray[np.uint32],
    state_i_of: NDArray[np.uint32],
    pose_j_of: NDArray[np.uint32],
    state_j_of: NDArray[np.uint32],
    gravities: NDArray[np.float64],
    gravity_of: NDArray[np.uint32],
    offsets: NDArray[np.float64],
    offset_of: NDArray[np.uint32],
    duration_s: NDArray[np.float64],
    alpha: NDArray[np.float64],
    gamma_wxyz: NDArray[np.float64],
    beta: NDArray[np.float64],
    bias_jacobian: NDArray[np.float64],
    bias_accel: NDArray[np.float64],
    bias_gyro: NDArray[np.float64],
    time_jacobian: NDArray[np.float64],
    magnitude: float,
    time_offset_s: float,
    is_log: bool,
    r: NDArray[np.float64],
    J_pose_i: NDArray[np.float64],
    J_state_i: NDArray[np.float64],
    J_pose_j: NDArray[np.float64],
    J_state_j: NDArray[np.float64],
    J_gravity: NDArray[np.float64],
    J_offset: NDArray[np.float64],
    valid: NDArray[np.bool_],
    with_jacobians: bool,
) -> None:
    has_gravity, has_offset = J_gravity.shape[0] > 0, J_offset.shape[0] > 0
    for n in range(np.uint64(begin), np.uint64(end)):
        xi, si = poses_i[pose_i_of[n]], states_i[state_i_of[n]]
        xj, sj = poses_j[pose_j_of[n]], states_j[state_j_of[n]]
        valid[n] = True
        T = duration_s[n]
        u = gravities[gravity_of[n]]
        g0, g1, g2 = magnitude * u[0], magnitude * u[1], magnitude * u[2]
        late, rate = offsets[offset_of[n], 0] - time_offset_s, time_jacobian[n]

        # What the IMU measured, corrected for the change of bias (7.4) and of the interval.
        ax, ay, az = si[3] - bias_accel[n, 0], si[4] - bias_accel[n, 1], si[5] - bias_accel[n, 2]
        gx, gy, gz = si[6] - bias_gyro[n, 0], si[7] - bias_gyro[n, 1], si[8] - bias_gyro[n, 2]
        J_alpha_a, J_alpha_g = _block(bias_jacobian, n, 0, 0), _block(bias_jacobian, n, 0, 3)
        J_beta_a, J_beta_g = _block(bias_jacobian, n, 6, 0), _block(bias_jacobian, n, 6, 3)
        J_theta_g = _block(bias_jacobian, n, 3, 3)
        alpha_a, alpha_g = apply(J_alpha_a, ax, ay, az), apply(J_alpha_g, gx, gy, gz)
        beta_a, beta_g = apply(J_beta_a, ax, ay, az), apply(J_beta_g, gx, gy, gz)
        tx, ty, tz = apply(J_theta_g, gx, gy, gz)
        tx, ty, tz = tx + late * rate[3], ty + late * rate[4], tz + late * rate[5]
        ew, ex, ey, ez = exp_scalars(tx, ty, tz)
        cw, cx, cy, cz = multiply_scalars(gamma_wxyz[n, 0], gamma_wxyz[n, 1], gamma_wxyz[n, 2], gamma_wxyz[n, 3], ew, ex, ey, ez)

        # What the states say, in the first frame.
        R = rotation_entries(xi[0], xi[1], xi[2], xi[3])
        Rt = transposed(R)
        half = 0.5 * T * T
        dx, dy, dz = apply(
            Rt,
            xj[4] - xi[4] - si[0] * T - half * g0,
            xj[5] - xi[5] - si[1] * T - half * g1,
            xj[6] - xi[6] - si[2] * T - half * g2,
        )
        ux, uy, uz = apply(Rt, sj[0] - si[0] - g0 * T, sj[1] - si[1] - g1 * T, sj[2] - si[2] - g2 * T)
        w, x, y, z = multiply_scalars(xi[0], -xi[1], -xi[2], -xi[3], xj[0], xj[1], xj[2], xj[3])
        w, x, y, z = multiply_scalars(cw, -cx, -cy, -cz, w, x, y, z)
        if w < 0.0:
            w, x, y, z = -w, -x, -y, -z
        if is_log:
            ex, ey, ez = log_quaternion(w, x, y, z)
        else:
            ex, ey, ez = 2.0 * x, 2.0 * y, 2.0 * z

        r[n, 0] = dx - (alpha[n, 0] + alpha_a[0] + alpha_g[0] + late * rate[0])
        r[n, 1] = dy - (alpha[n, 1] + alpha_a[1] + alpha_g[1] + late * rate[1])
        r[n, 2] = dz - (alpha[n, 2] + alpha_a[2] + alpha_g[2] + late * rate[2])
        r[n, 3], r[n, 4], r[n, 5] = ex, ey, ez
        r[n, 6] = ux - (beta[n, 0] + beta_a[0] + beta_g[0] + late * rate[6])
        r[n, 7] = uy - (beta[n, 1] + beta_a[1] + beta_g[1] + late * rate[7])
        r[n, 8] = uz - (beta[n, 2] + beta_a[2] + beta_g[2] + late * rate[8])
        for k in range(3, 9):
            r[n, 6 + k] = sj[k] - si[k]
        if not with_jacobians:
            continue

        if is_log:
            d = inverse_jacobian_coefficient(ex * ex + ey * ey + ez * ez)
            E_left = polynomial(1.0, -0.5, d, ex, ey, ez)  # J_l⁻¹(ε)
            E_right = polynomial(1.0, 0.5, d, ex, ey, ez)  # J_r⁻¹(ε)
        else:
            E_left = polynomial(w, -1.0, 0.0, x, y, z)  # ⟨E⟩_R
            E_right = polynomial(w, 1.0, 0.0, x, y, z)  # ⟨E⟩_L
        _, b, c = exp_coefficients(tx * tx + ty * ty + tz * tz)
        minus_Rt = scaled(-1.0, Rt)
        J_pose_i[n] = 0.0
        J_state_i[n] = 0.0
        J_pose_j[n] = 0.0
        J_state_j[n] = 0.0
        _store(polynomial(0.0, 1.0, 0.0, dx, dy, dz), J_pose_i, n, 0, 0)
        _store(minus_Rt, J_pose_i, n, 0, 3)
        _store(scaled(-1.0, multiply(E_left, transposed(rotation_entries(cw, cx, cy, cz)))), J_pose_i, n, 3, 0)
        _store(polynomial(0.0, 1.0, 0.0, ux, uy, uz), J_pose_i, n, 6, 0)
        _store(scaled(T, minus_Rt), J_state_i, n, 0, 0)
        _store(scaled(-1.0, J_alpha_a), J_state_i, n, 0, 3)
        _store(scaled(-1.0, J_alpha_g), J_state_i, n, 0, 6)
        E_by_theta = multiply(E_left, polynomial(1.0, -b, c, tx, ty, tz))  # J_l⁻¹(ε) J_r(δθ)
        _store(scaled(-1.0, multiply(E_by_theta, J_theta_g)), J_state_i, n, 3, 6)
        _store(minus_Rt, J_state_i, n, 6, 0)
        _store(scaled(-1.0, J_beta_a), J_state_i, n, 6, 3)
        _store(scaled(-1.0, J_beta_g), J_state_i, n, 6, 6)
        _store(scaled(-1.0, IDENTITY), J_state_i, n, 9, 3)
        _store(scaled(-1.0, IDENTITY), J_state_i, n, 12, 6)
        _store(Rt, J_pose_j, n, 0, 3)
        _store(E_right, J_pose_j, n, 3, 0)
        _store(Rt, J_state_j, n, 6, 0)
        _store(IDENTITY, J_state_j, n, 9, 3)
        _store(IDENTITY, J_state_j, n, 12, 6)
        if has_gravity:
            J_gravity[n] = 0.0
            B = basis_scalars(u[0], u[1], u[2])
            for k in range(2):
                vx, vy, vz = apply(minus_Rt, B[3 * k], B[3 * k + 1], B[3 * k + 2])
                J_gravity[n, 0, k], J_gravity[n, 6, k] = half * magnitude * vx, T * magnitude * vx
                J_gravity[n, 1, k], J_gravity[n, 7, k] = half * magnitude * vy, T * magnitude * vy
                J_gravity[n, 2, k], J_gravity[n, 8, k] = half * magnitude * vz, T * magnitude * vz
        if has_offset:
            J_offset[n] = 0.0
            vx, vy, vz = apply(E_by_theta, rate[3], rate[4], rate[5])
            for k in range(3):
                J_offset[n, k, 0], J_offset[n, 6 + k, 0] = -rate[k], -rate[6 + k]
            J_offset[n, 3, 0], J_offset[n, 4, 0], J_offset[n, 5, 0] = -vx, -vy, -vz


class ImuPreintegration(Residual):
    """Preintegrated IMU samples between keyframes i and j, as derived in the head of this file.

    Rows [α, θ, β, b_a, b_g]: m, rad, m/s, m/s², rad/s, whitened by the covariance of the preintegration.
    Variables: `T_world_imu_i`, `T_world_imu_j` (7,), wxyz and xyz, on `BodyPose`: rotation and position move
    apart, unlike on `SE3`; `velocity_bias_i`, `velocity_bias_j` (9,) on `Euclidean(9)`: v_world [m/s],
    b_a [m/s²], b_g [rad/s]. They come in the order i, i, j, j, and then, where asked for: `gravity_direction` (3,) on `S2`, in
    the world, down; `imu_time_offset` (1,) [s] on `Euclidean(1)`, IMU clock minus that of the sensor whose poses these are.

    Either the intervals of the IMU follow the time offset, here, or what was seen is moved to the poses (`OnBody`). Both at
    once would count it twice, and a `Problem` refuses it.

    Args:
        preintegration: of N intervals.
        gravity: (3,) in the world frame, pointing down [m/s²]; of its magnitude alone where the direction is a variable.
        rotation: `log` for Log(E), `vector` for 2 E_xyz, as in the VINS papers.
        gravity_direction, time_offset: whether these are variables.
        time_offset_s: the offset that is in the intervals of the preintegration [s].

    Raises:
        InputError: gravity of another shape, or zero where its direction is a variable; an unknown `rotation`; an interval of
            a single step, whose covariance is singular; a time offset that is not finite.

    Example:
        >>> noise = bp.residuals.ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3)
        >>> time_ns = np.arange(0, 1_000_000_001, 5_000_000)  # a second at rest, 200 Hz
        >>> at_rest = np.zeros((201, 3)), np.tile([0.0, 0.0, 9.81], (201, 1))
        >>> between = bp.residuals.Preintegration.integrate(time_ns, *at_rest, noise=noise)
        >>> imu = bp.residuals.ImuPreintegration(between)
        >>> pose, state = bp.BodyPose.identity(), np.zeros(9)  # velocity and biases
        >>> bool(np.abs(imu.evaluate(pose, state, pose, state)).max() < 1e-9)  # gravity takes back what it gave
        True
    """

    def __init__(
        self,
        preintegration: Preintegration,
        *,
        gravity: ArrayLike = (0.0, 0.0, -9.81),
        rotation: Literal["log", "vector"] = "log",
        gravity_direction: bool = False,
        time_offset: bool = False,
        time_offset_s: float = 0.0,
    ) -> None:
        if rotation not in ("log", "vector"):
            raise InputError('rotation "log" or "vector"', repr(rotation), 'leave it out for "log"')
        self.rotation = rotation
        self.gravity = np.array(as_floats(gravity, "gravity"))
        if self.gravity.shape != (3,) or not np.isfinite(self.gravity).all():
            raise InputError("gravity as three finite numbers", repr(gravity), "give (0, 0, -9.81) in a world with z up")
        if gravity_direction and not self.gravity.any():
            raise InputError("gravity with a magnitude where its direction is a variable", "zero", "give (0, 0, -9.81)")
        if not math.isfinite(time_offset_s):
            raise InputError("time_offset_s finite [s]", f"{time_offset_s}", "give the offset the intervals were cut at")
        self.time_offset_s = float(time_offset_s)
        count = len(preintegration)
        slots = [slot for slot, asked in zip(_OPTIONAL, (gravity_direction, time_offset), strict=True) if asked]
        super().__init__(
            dim=15,
            count=count,
            manifolds=(BodyPose, VELOCITY_BIAS, BodyPose, VELOCITY_BIAS, *(manifold for _, manifold in slots)),
            roles=("T_world_imu_i", "velocity_bias_i", "T_world_imu_j", "velocity_bias_j", *(role for role, _ in slots)),
            whitening=_whitening(preintegration),
        )
        self._is_variable = (True, True, True, True, gravity_direction, time_offset)
        self._optional_at = (4 if gravity_direction else None, 4 + gravity_direction if time_offset else None)
        # What is no variable stands in its place as a constant.
        once = np.zeros(count, dtype=np.uint32)
        self._constants = (None,) * 4 + (self.gravity[None], np.full((1, 1), self.time_offset_s))
        self._constant_index = (None,) * 4 + (once, once)
        self._set(preintegration)

    def refresh(self, velocity_bias_i: ArrayLike, time_offset_s: float | None = None) -> int:
        """Integrate anew, at these biases and this time offset, what moved too far from those of its integration.

        Residuals and whitening jump a little, so that it is called between solves, not within one.

        Args:
            velocity_bias_i: (N, 9) or (9,), the present values for every residual.
            time_offset_s: the present value, where it is a variable; all intervals are cut anew when it moved by more than 5 ms.

        Returns:
            intervals integrated anew.

        Raises:
            InputError: an array of another shape; a time offset that is no variable, or that leads beyond the samples.
        """
        state = rows_of("velocity_bias_i", velocity_bias_i, self.count, 9)
        stale = self.preintegration.is_stale(state[:, 3:6], state[:, 6:])
        preintegration = self.preintegration.reintegrated(state[:, 3:6], state[:, 6:], stale) if stale.any() else None
        if time_offset_s is not None and not self._is_variable[5]:
            raise InputError("no time_offset_s where it is no variable", f"{time_offset_s}", "give time_offset=True")
        late = 0.0 if time_offset_s is None else float(time_offset_s) - self.time_offset_s
        if abs(late) > REINTEGRATE_OFFSET_S:
            shift_ns = round(late * 1e9)
            preintegration = (preintegration or self.preintegration).shifted(shift_ns)
            self.time_offset_s += 1e-9 * shift_ns
            stale[:] = True
        if preintegration is not None:
            self.whitening = _whitening(preintegration)
            self._set(preintegration)
        return int(stale.sum())

    def _set(self, preintegration: Preintegration) -> None:
        self.preintegration, p = preintegration, preintegration
        magnitude = float(np.linalg.norm(self.gravity)) if self._is_variable[4] else 1.0
        time_jacobian = p.time_jacobian if self._is_variable[5] else np.zeros((self.count, 9))
        self._terms = (
            p.duration_s, p.alpha, p.gamma_wxyz, p.beta, p.bias_jacobian, p.bias_accel, p.bias_gyro,
            time_jacobian, magnitude, self.time_offset_s, self.rotation == "log",
        )  # fmt: skip

    def linearize_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, jacobians: Arrays, valid: Mask) -> None:
        """See `Residual.linearize_into`."""
        _imu(begin, end, *self._arguments(x, index), *self._terms, r, *self._all(jacobians, _NO_JACOBIANS), valid, True)

    def evaluate_into(self, begin: int, end: int, x: Arrays, index: Rows, r: Array, valid: Mask) -> None:
        """See `Residual.evaluate_into`."""
        _imu(begin, end, *self._arguments(x, index), *self._terms, r, *_NO_JACOBIANS, valid, False)

    def _arguments(self, x: Arrays, index: Rows) -> tuple[object, ...]:
        values, rows = self._all(x, self._constants), self._all(index, self._constant_index)
        return *values[:4], *rows[:4], values[4], rows[4], values[5], rows[5]

    def _all(self, given: tuple[object, ...], otherwise: tuple[object, ...]) -> tuple[object, ...]:
        """One array for each of the six places: the next one given where it is a variable, else its constant."""
        return *given[:4], *(otherwise[4 + k] if at is None else given[at] for k, at in enumerate(self._optional_at))


def _whitening(preintegration: Preintegration) -> Whitening:
    single = preintegration.steps < 2
    if single.any():
        raise InputError(
            "at least two steps between IMU samples in every interval",
            f"{preintegration.steps[np.argmax(single)]} in interval {np.argmax(single)}",
            "position and velocity share the noise of a single step: take keyframes further apart",
        )
    return Whitening.of(15, len(preintegration), covariance=preintegration.covariance)
