"""One Gauss-Newton step of the iterated update, in information form (docs/lidar_inertial_odometry.md, section 7).

A measurement enters only through its information over the twelve components it touches, `A = Hᵀ R⁻¹ H` (12, 12) and
`b = Hᵀ R⁻¹ z` (12,): the cost is linear in the number of points, and nothing here knows what was measured.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import MEASURED, T_THETA, T_THETA_L, TANGENT, boxminus_into
from boxplus.filtering.small_linalg import cholesky_inverse_into
from boxplus.manifolds.so3 import right_jacobian_into


@kernel
def _congruence(cov: NDArray[np.float64], J_theta: NDArray[np.float64], J_theta_L: NDArray[np.float64]) -> None:
    """cov <- J cov Jᵀ for J the identity but for the blocks of the two rotations."""
    new = np.empty(3)
    for block in range(2):
        offset = T_THETA if block == 0 else T_THETA_L
        J = J_theta if block == 0 else J_theta_L
        for c in range(TANGENT):
            for i in range(3):
                new[i] = J[i, 0] * cov[offset, c] + J[i, 1] * cov[offset + 1, c] + J[i, 2] * cov[offset + 2, c]
            for i in range(3):
                cov[offset + i, c] = new[i]
        for c in range(TANGENT):
            for i in range(3):
                new[i] = J[i, 0] * cov[c, offset] + J[i, 1] * cov[c, offset + 1] + J[i, 2] * cov[c, offset + 2]
            for i in range(3):
                cov[c, offset + i] = new[i]


@kernel
def map_step(
    x: NDArray[np.float64],
    x_prior: NDArray[np.float64],
    cov_prior: NDArray[np.float64],
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    delta: NDArray[np.float64],
    cov: NDArray[np.float64],
) -> bool:
    """One Gauss-Newton step of min Σ h²/r + ‖x ⊟ x_prior‖² (docs/lidar_inertial_odometry.md, section 7).

    Args:
        x, x_prior: (36,) the current iterate and the prior.
        cov_prior: (24, 24).
        A, b: (12, 12), (12,), the measurement's information at x.
        delta: (24,) receives the step: x <- x ⊞ delta.
        cov: (24, 24) receives S = (P⁻¹ + A)⁻¹, the covariance in the tangent space at x.

    Returns:
        False when a matrix is not positive definite; delta and cov are then without meaning.
    """
    d = np.empty(TANGENT)
    J_theta = np.empty((3, 3))
    J_theta_L = np.empty((3, 3))
    prior_information = np.empty((TANGENT, TANGENT))
    total = np.empty((TANGENT, TANGENT))
    work = np.empty((TANGENT, TANGENT))
    boxminus_into(x, x_prior, d)
    right_jacobian_into(d[T_THETA], d[T_THETA + 1], d[T_THETA + 2], J_theta)
    right_jacobian_into(d[T_THETA_L], d[T_THETA_L + 1], d[T_THETA_L + 2], J_theta_L)
    for i in range(TANGENT):
        for j in range(TANGENT):
            total[i, j] = cov_prior[i, j]
    _congruence(total, J_theta, J_theta_L)
    if not cholesky_inverse_into(total, prior_information, work):
        return False
    # Ji d = d: J_r(θ) θ = θ, so the prior's pull is P⁻¹ d at the iterate.
    gradient = np.empty(TANGENT)
    for i in range(TANGENT):
        gradient[i] = 0.0
        for j in range(TANGENT):
            total[i, j] = prior_information[i, j]
            gradient[i] += prior_information[i, j] * d[j]
    for i in range(MEASURED.shape[0]):
        gradient[MEASURED[i]] += b[i]
        for j in range(MEASURED.shape[0]):
            total[MEASURED[i], MEASURED[j]] += A[i, j]
    if not cholesky_inverse_into(total, cov, work):
        return False
    for i in range(TANGENT):
        delta[i] = 0.0
        for j in range(TANGENT):
            delta[i] -= cov[i, j] * gradient[j]
    return True


@kernel
def move_covariance(cov: NDArray[np.float64], delta: NDArray[np.float64]) -> None:
    """cov <- L cov Lᵀ, L = diag(J_r(δ_θ), I, J_r(δ_θL), I): to the tangent space at x ⊞ δ; then symmetrise."""
    J_theta = np.empty((3, 3))
    J_theta_L = np.empty((3, 3))
    right_jacobian_into(delta[T_THETA], delta[T_THETA + 1], delta[T_THETA + 2], J_theta)
    right_jacobian_into(delta[T_THETA_L], delta[T_THETA_L + 1], delta[T_THETA_L + 2], J_theta_L)
    _congruence(cov, J_theta, J_theta_L)
    for i in range(TANGENT):
        for j in range(i):
            mean = 0.5 * (cov[i, j] + cov[j, i])
            cov[i, j] = mean
            cov[j, i] = mean
