"""The midpoint recursion of preintegration with its covariance and bias Jacobians, in one pass over the samples.

Derivation: docs/residuals/imu_preintegration.md.
That page perturbs the rotation on the right, γ Exp(θ). Here the recursion runs in φ = R(γ) θ, the same error seen in the
frame of the first keyframe, where the blocks of F become sparse: F_φφ = I and F_βφ = −δt [ā]x, with K = F_φg = −δt R₀ J_l(ω̄ δt),
F_βa = −δt/2 (R₀ + R₁), F_βg = −δt/2 [R₁ a₁]x K; and α' = α + δt/2 (β + β') holds for errors as for values. The columns of the
gyroscope's noise are those of its bias. At the end θ = Rᵀ φ. The result is the same, not an approximation of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.so3 import exp_coefficients, quaternion_into
from boxplus.residuals.matrix3 import (
    IDENTITY,
    ZERO,
    Matrix3,
    Vector3,
    add,
    add_scaled,
    apply,
    cross_add,
    mirrored,
    multiply,
    multiply_add,
    polynomial,
    scaled,
    transposed,
)

# First row of each block of the error state; typed, as what takes a plain number is compiled for each number apart.
ALPHA, THETA, BETA, BIAS_ACCEL, BIAS_GYRO = (np.int64(row) for row in (0, 3, 6, 9, 12))
GAP_S = 0.1  # between samples: above it the midpoint rule is too coarse, and what happens between the samples counts
_GAP_NS, _GAP_STEP_NS = round(1e9 * GAP_S), 10_000_000  # of a step across a gap


@kernel(inline=True)
def _store(A: Matrix3, out: NDArray[np.float64], row: int, column: int) -> None:
    """A into the block of a symmetric matrix that begins at (row, column), row < column, and Aᵀ into its mirror image."""
    for i in range(3):
        for j in range(3):
            value = A[3 * i + j]
            out[row + i, column + j] = value
            out[column + j, row + i] = value


@kernel(inline=True)
def _store_diagonal(A: Matrix3, out: NDArray[np.float64], row: int) -> None:
    """Symmetric A into the diagonal block that begins at `row`."""
    for i in range(3):
        for j in range(3):
            out[row + i, row + j] = A[3 * i + j]


@kernel(inline=True)
def _sample(values: NDArray[np.float64], k: int, share: float, bias: NDArray[np.float64]) -> Vector3:
    """values[k] moved by `share` towards values[k + 1], without its bias."""
    if share == 0.0:
        return values[k, 0] - bias[0], values[k, 1] - bias[1], values[k, 2] - bias[2]
    return (
        values[k, 0] + share * (values[k + 1, 0] - values[k, 0]) - bias[0],
        values[k, 1] + share * (values[k + 1, 1] - values[k, 1]) - bias[1],
        values[k, 2] + share * (values[k + 1, 2] - values[k, 2]) - bias[2],
    )


@kernel(fastmath=True, inline=True)
def integrate_interval(
    time_ns: NDArray[np.int64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    first: int,
    begin_ns: int,
    end_ns: int,
    bias_accel: NDArray[np.float64],
    bias_gyro: NDArray[np.float64],
    variances: NDArray[np.float64],
    merged: bool,
    alpha: NDArray[np.float64],
    gamma_wxyz: NDArray[np.float64],
    beta: NDArray[np.float64],
    P: NDArray[np.float64],
    J: NDArray[np.float64],
    R_work: NDArray[np.float64],
) -> tuple[int, float]:
    """Preintegrate from begin_ns to end_ns; samples at these times are interpolated where there are none.

    Args:
        time_ns: (S,); gyro, accel: (S, 3).
        first: last sample that is not after begin_ns.
        variances: (6,) densities squared of gyroscope, accelerometer, gyroscope bias, accelerometer bias, and of how angular
            velocity and specific force wander within a gap.
        merged: whether neighbouring steps share the noise of their common sample (docs/residuals/imu_preintegration.md).
        alpha, beta: (3,); gamma_wxyz: (4,); P: (15, 15), order α, θ, β, b_a, b_g; J: (9, 6), α, θ, β by b_a, b_g. Written.
        R_work: (3, 3).

    Returns:
        number of steps and the longest time between two samples used [s].
    """
    R0 = IDENTITY
    ax, ay, az = 0.0, 0.0, 0.0
    bx, by, bz = 0.0, 0.0, 0.0
    J_alpha_a, J_alpha_g, J_phi_g, J_beta_a, J_beta_g = ZERO, ZERO, ZERO, ZERO, ZERO
    P_aa, P_ap, P_ab, P_pp, P_pb, P_bb = ZERO, ZERO, ZERO, ZERO, ZERO, ZERO  # a: α, p: φ, b: β
    P_a_ba, P_b_ba, P_a_bg, P_p_bg, P_b_bg = ZERO, ZERO, ZERO, ZERO, ZERO
    var_ba, var_bg = 0.0, 0.0
    longest, steps = 0.0, 0
    k = np.uint64(first)
    one = np.uint64(1)
    now = begin_ns
    share = 0.0
    if begin_ns > time_ns[k]:
        share = float(begin_ns - time_ns[k]) / float(time_ns[k + one] - time_ns[k])
    wx, wy, wz = _sample(gyro, k, share, bias_gyro)
    v0x, v0y, v0z = _sample(accel, k, share, bias_accel)  # R₀ a₀
    while now < end_ns:
        sampled = time_ns[k + one]
        gap_ns = sampled - time_ns[k]
        following, wander_gyro, wander_accel = min(sampled, end_ns), 0.0, 0.0
        if gap_ns > _GAP_NS:
            following = min(following, now + _GAP_STEP_NS)
            # A random walk between two samples that are known leaves the integral that white noise of this density leaves.
            twelfth = float(gap_ns) * float(gap_ns) * 1e-18 / 12.0
            wander_gyro, wander_accel = twelfth * variances[4], twelfth * variances[5]
        longest = max(longest, float(gap_ns) * 1e-9)
        if following == sampled:
            w1x, w1y, w1z = _sample(gyro, k + one, 0.0, bias_gyro)
            a1x, a1y, a1z = _sample(accel, k + one, 0.0, bias_accel)
            k += one
        else:
            share = float(following - time_ns[k]) / float(gap_ns)
            w1x, w1y, w1z = _sample(gyro, k, share, bias_gyro)
            a1x, a1y, a1z = _sample(accel, k, share, bias_accel)
        dt = float(following - now) * 1e-9
        half = 0.5 * dt
        now = following
        steps += 1

        # Rotation over the step, and the two specific forces in the first frame.
        rx, ry, rz = half * (wx + w1x), half * (wy + w1y), half * (wz + w1z)
        wx, wy, wz = w1x, w1y, w1z
        A, B, C = exp_coefficients(rx * rx + ry * ry + rz * rz)
        R1 = multiply(R0, polynomial(1.0, A, B, rx, ry, rz))
        K = scaled(-dt, multiply(R0, polynomial(1.0, B, C, rx, ry, rz)))  # J_l
        v1x, v1y, v1z = apply(R1, a1x, a1y, a1z)
        mx, my, mz = 0.5 * (v0x + v1x), 0.5 * (v0y + v1y), 0.5 * (v0z + v1z)

        ax += dt * (bx + half * mx)
        ay += dt * (by + half * my)
        az += dt * (bz + half * mz)
        bx += dt * mx
        by += dt * my
        bz += dt * mz

        L = (-dt * mx, -dt * my, -dt * mz)  # F_βφ = [L]x
        F_ba = scaled(-half, add(R0, R1))
        F_bg = cross_add(ZERO, (-half * v1x, -half * v1y, -half * v1z), K)

        new = add(J_beta_a, F_ba)
        J_alpha_a = add_scaled(J_alpha_a, half, add(J_beta_a, new))
        J_beta_a = new
        new = cross_add(add(J_beta_g, F_bg), L, J_phi_g)
        J_alpha_g = add_scaled(J_alpha_g, half, add(J_beta_g, new))
        J_beta_g = new
        J_phi_g = add(J_phi_g, K)

        # P ← F P Fᵀ + G Q Gᵀ, block by block. `x_of_old` is cov(x', ·) with the second argument before the step.
        q_gyro, q_accel, q_flat = variances[0] / dt, variances[1] / dt, 0.0
        if not merged:
            q_gyro, q_accel, q_flat = 0.5 * q_gyro, 0.0, half * variances[1]
        q_gyro, q_accel = q_gyro + wander_gyro / dt, q_accel + wander_accel / dt
        p_of_p = multiply_add(P_pp, K, transposed(P_p_bg))
        p_of_b = multiply_add(P_pb, K, transposed(P_b_bg))
        a_of_p = multiply_add(P_ap, P_a_bg, transposed(K))  # cov(α, φ')
        b_of_p = multiply_add(cross_add(transposed(P_pb), L, P_pp), F_bg, transposed(P_p_bg))
        b_of_b = multiply_add(multiply_add(cross_add(P_bb, L, P_pb), F_ba, transposed(P_b_ba)), F_bg, transposed(P_b_bg))
        b_of_a = multiply_add(
            multiply_add(cross_add(transposed(P_ab), L, transposed(P_ap)), F_ba, transposed(P_a_ba)), F_bg, transposed(P_a_bg)
        )
        b_of_bg = cross_add(P_b_bg, L, P_p_bg)
        # The noise of the gyroscope enters as its bias does, that of the accelerometer likewise: together they act as one.
        p_noisy = add_scaled(P_p_bg, var_bg + q_gyro, K)
        b_noisy = add_scaled(b_of_bg, var_bg + q_gyro, F_bg)
        new_b_ba = add_scaled(P_b_ba, var_ba, F_ba)
        new_b_bg = add_scaled(b_of_bg, var_bg, F_bg)

        new_bp = multiply_add(cross_add(transposed(p_of_b), L, transposed(p_of_p)), F_bg, transposed(p_noisy))
        new_bb = cross_add(transposed(b_of_b), L, transposed(b_of_p))
        new_bb = multiply_add(new_bb, F_ba, transposed(add_scaled(new_b_ba, q_accel, F_ba)))
        new_bb = mirrored(add_scaled(multiply_add(new_bb, F_bg, transposed(b_noisy)), q_flat, IDENTITY))
        P_pp = mirrored(multiply_add(p_of_p, p_noisy, transposed(K)))

        P_aa = add_scaled(P_aa, half, add(add(P_ab, transposed(P_ab)), add(b_of_a, transposed(b_of_a))))
        P_aa = mirrored(add_scaled(P_aa, half * half, add(add(P_bb, new_bb), add(b_of_b, transposed(b_of_b)))))
        P_ap = add_scaled(a_of_p, half, add(transposed(p_of_b), new_bp))
        P_ab = add_scaled(transposed(b_of_a), half, add(transposed(b_of_b), new_bb))
        P_a_ba = add_scaled(P_a_ba, half, add(P_b_ba, new_b_ba))
        P_a_bg = add_scaled(P_a_bg, half, add(P_b_bg, new_b_bg))
        P_pb, P_bb, P_b_ba, P_b_bg = transposed(new_bp), new_bb, new_b_ba, new_b_bg
        P_p_bg = add_scaled(P_p_bg, var_bg, K)
        var_bg += dt * variances[2]
        var_ba += dt * variances[3]
        R0 = R1
        v0x, v0y, v0z = v1x, v1y, v1z

    alpha[0], alpha[1], alpha[2] = ax, ay, az
    beta[0], beta[1], beta[2] = bx, by, bz
    for i in range(3):
        for j in range(3):
            R_work[i, j] = R0[3 * i + j]
    quaternion_into(R_work, gamma_wxyz)
    Rt = transposed(R0)  # θ = Rᵀ φ
    J_theta_g = multiply(Rt, J_phi_g)
    for i in range(3):
        for j in range(3):
            n = 3 * i + j
            J[i, j], J[i, 3 + j] = J_alpha_a[n], J_alpha_g[n]
            J[3 + i, j], J[3 + i, 3 + j] = 0.0, J_theta_g[n]
            J[6 + i, j], J[6 + i, 3 + j] = J_beta_a[n], J_beta_g[n]
    _store_diagonal(P_aa, P, ALPHA)
    _store_diagonal(mirrored(multiply(multiply(Rt, P_pp), R0)), P, THETA)
    _store_diagonal(P_bb, P, BETA)
    _store_diagonal(scaled(var_ba, IDENTITY), P, BIAS_ACCEL)
    _store_diagonal(scaled(var_bg, IDENTITY), P, BIAS_GYRO)
    _store(multiply(P_ap, R0), P, ALPHA, THETA)
    _store(P_ab, P, ALPHA, BETA)
    _store(P_a_ba, P, ALPHA, BIAS_ACCEL)
    _store(P_a_bg, P, ALPHA, BIAS_GYRO)
    _store(multiply(Rt, P_pb), P, THETA, BETA)
    _store(ZERO, P, THETA, BIAS_ACCEL)
    _store(multiply(Rt, P_p_bg), P, THETA, BIAS_GYRO)
    _store(P_b_ba, P, BETA, BIAS_ACCEL)
    _store(P_b_bg, P, BETA, BIAS_GYRO)
    _store(ZERO, P, BIAS_ACCEL, BIAS_GYRO)
    return steps, longest


@kernel
def integrate_batch(
    rows: NDArray[np.uint32],
    time_ns: NDArray[np.int64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    first: NDArray[np.int64],
    intervals_ns: NDArray[np.int64],
    bias_accel: NDArray[np.float64],
    bias_gyro: NDArray[np.float64],
    variances: NDArray[np.float64],
    merged: bool,
    alpha: NDArray[np.float64],
    gamma_wxyz: NDArray[np.float64],
    beta: NDArray[np.float64],
    P: NDArray[np.float64],
    J: NDArray[np.float64],
    steps: NDArray[np.int64],
    longest_gap_s: NDArray[np.float64],
) -> None:
    """`integrate_interval` for the intervals `rows` (M,) of N: arrays as there, with a leading axis N; intervals_ns: (N, 2)."""
    R_work = np.empty((3, 3))
    for n in rows:
        steps[n], longest_gap_s[n] = integrate_interval(
            time_ns, gyro, accel, first[n], intervals_ns[n, 0], intervals_ns[n, 1], bias_accel[n], bias_gyro[n], variances,
            merged, alpha[n], gamma_wxyz[n], beta[n], P[n], J[n], R_work,
        )  # fmt: skip
