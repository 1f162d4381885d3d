"""What the points of a scan say of the pose, once the noise of their planes' normals is off it.

A shift δ of the pose moves the residuals by what the true normals see of it: b = (S − N) δ, S and N as in `degeneracy`, b
without the pull of noise (`plane_information.accumulate_planes`). The step −S⁻¹b reaches 1 − 1/λ of the shift along a direction,
scan after scan, and claims too much. What the points say is
−(S − N)⁻¹b with the covariance (S − N)⁻¹ S (S − N)⁻¹, nothing along weak directions (Fuller, Measurement Error Models, 1987).

N is an expectation, though, of a few normals: n points that lie on about n / 10 independent planes. What noise really gives a
direction scatters about N by the share ε = √(2 · 10 / n), and into whatever else the points measure by as much. So

* the shift read along direction i has the relative error ε / (λ − 1): where the prior knows the pose along it to P (in units of
  N⁻¹), the variance q = P ε² / (λ − 1)² is added to what is read. A wall without features that by chance seems to have some
  says nothing to a filter that has lost its place along it, and a filter that knows its place loses nothing;
* a weak direction is known within a cone only: of the measured direction i it may contain as much as
  c = √(9 · 10 λ / n) / (λ − λ_weak). Within the cone it is taken to be what the prior knows least, as its covariances say.
  Else a gyroscope that knows the rotation and a weak direction that noise has tilted towards it hold the sensor where it is.

Derivation and what it was measured on: docs/lidar_inertial_odometry.md, section 8.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.degeneracy import PoseDirections
from boxplus.filtering.nav_state import MEASURED
from boxplus.filtering.small_linalg import cholesky_inverse_into

_POINTS_A_NORMAL = 10.0
_CONE = 9.0  # squared standard deviations
_APART = 1e-3  # of two ratios, relative: closer ones are told from each other by chance
_DOF = len(MEASURED)


def without_noise(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    directions: PoseDirections,
    *,
    cov_prior: NDArray[np.float64],
    used: int,
    since_match: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """A and b without what noise of the normals claims about the pose.

    Args:
        A, b: (12, 12), (12,) over [θ, p, θ_L, p_L], what the points say; the pull of noise is off b.
        directions: of the pose; the weak ones are left out.
        cov_prior: (6, 6) covariance of the pose before; zero where all of it counts as known.
        used: how many points that is.
        since_match: (6,) how the pose has moved since the planes were found: they stay, so all of A moves b, and only the share
            of the true normals says something of the world.

    Returns:
        (12, 12), (12,) to be used like A and b, zero where the points measure nothing; None where a covariance is none.
    """
    A_left, b_left = np.zeros((_DOF, _DOF)), np.zeros(_DOF)
    per_normal = _POINTS_A_NORMAL / max(used, 1)
    V, ratios, weak = directions.basis, directions.ratios, ~directions.measured
    if not _take_off(A, b, V, ratios, weak, cov_prior, per_normal, since_match, A_left, b_left):
        return None
    return A_left, b_left


@kernel
def _take_off(
    A: NDArray[np.float64],
    b: NDArray[np.float64],
    V: NDArray[np.float64],
    ratios: NDArray[np.float64],
    weak: NDArray[np.bool_],
    cov_prior: NDArray[np.float64],
    per_normal: float,
    since_match: NDArray[np.float64],
    A_left: NDArray[np.float64],
    b_left: NDArray[np.float64],
) -> bool:
    """`without_noise` with the directions' `basis` V (6, 6); False where a matrix is not positive definite."""
    U, work, inner, other = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    _product(V, False, V, True, inner)
    if not cholesky_inverse_into(inner, other, work):
        return False
    _product(V, True, other, False, U)  # V⁻¹ = Vᵀ N
    P = np.empty((6, 6))
    _product(U, False, cov_prior, False, inner)
    _product(inner, False, U, True, P)

    # T reads a motion along the measured directions, G makes one of it: D = G T.
    T, G = np.zeros((6, 6)), np.zeros((6, 6))
    if not _read_into(U, P, ratios, weak, per_normal, T):
        return False
    for j in range(6):
        if not weak[j]:
            for i in range(6):
                G[i, j] = V[i, j] * (1.0 - 1.0 / ratios[j])
    D = inner
    _product(G, False, T, False, D)
    told = b.copy()
    for j in range(6):
        noise = since_match[j]
        for k in range(6):
            noise -= D[j, k] * since_match[k]
        for i in range(_DOF):
            told[i] -= A[i, j] * noise

    # Along the measured directions the points say B, with the pull of the residuals and C with the mounting. Noise of variance Q
    # added to what is read makes (B⁻¹ + Q)⁻¹ = B − B M B of it, M = √Q (I + √Q B √Q)⁻¹ √Q; what it knows of the mounting shrinks
    # likewise.
    B, C, pull, root = np.empty((6, 6)), np.empty((6, 6)), np.zeros(6), np.zeros(6)
    _product(G, True, np.ascontiguousarray(A[:6, :6]), False, work)
    _product(work, False, G, False, B)
    _product(G, True, np.ascontiguousarray(A[:6, 6:]), False, C)
    for i in range(6):
        for k in range(6):
            pull[i] += G[k, i] * told[k]
        if not weak[i]:
            root[i] = math.sqrt(2.0 * per_normal * max(P[i, i], 0.0)) / (ratios[i] - 1.0)
    M = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            inner[i, j] = root[i] * B[i, j] * root[j] + (1.0 if i == j else 0.0)
    if not cholesky_inverse_into(inner, M, work):
        return False
    for i in range(6):
        for j in range(6):
            M[i, j] *= root[i] * root[j]

    reach = np.empty((6, 6))  # Tᵀ (I − B M): how what is read comes to the pose
    _product(B, False, M, False, inner)
    for i in range(6):
        for j in range(6):
            inner[i, j] = (1.0 if i == j else 0.0) - inner[i, j]
    _product(T, True, inner, False, reach)
    _product(reach, False, B, False, work)
    _product(work, False, T, False, inner)
    shared, lost, change = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    _product(reach, False, C, False, shared)
    _product(C, True, M, False, lost)
    _product(lost, False, C, False, change)
    for i in range(6):
        b_left[i], b_left[6 + i] = 0.0, told[6 + i]
        for j in range(6):
            b_left[i] += reach[i, j] * pull[j]
            b_left[6 + i] -= lost[i, j] * pull[j]
            A_left[i, j] = 0.5 * (inner[i, j] + inner[j, i])
            A_left[i, 6 + j] = shared[i, j]
            A_left[6 + j, i] = shared[i, j]
            A_left[6 + i, 6 + j] = A[6 + i, 6 + j] - 0.5 * (change[i, j] + change[j, i])
    return True


@kernel
def _read_into(
    U: NDArray[np.float64],
    P: NDArray[np.float64],
    ratios: NDArray[np.float64],
    weak: NDArray[np.bool_],
    per_normal: float,
    T: NDArray[np.float64],
) -> bool:
    """Rows of T (6, 6), of measured directions: the coordinate U less what the weak ones may contain of it. False as above."""
    known, inverse, work = np.eye(6), np.empty((6, 6)), np.empty((6, 6))
    trace = 0.0
    for i in range(6):
        for j in range(6):
            if weak[i] and weak[j]:
                known[i, j] = P[i, j]
        trace += P[i, i] if weak[i] else 0.0
    tilts = trace > 0.0
    if tilts and not cholesky_inverse_into(known, inverse, work):
        return False
    for i in range(6):
        if weak[i]:
            continue
        for k in range(6):
            T[i, k] = U[i, k]
        for j in range(6):
            if not (tilts and weak[j]):
                continue
            tilt = 0.0
            for k in range(6):
                if weak[k]:
                    tilt += P[i, k] * inverse[k, j]
            # One that was called weak for another reason may have the larger ratio.
            most = math.sqrt(_CONE * per_normal / ratios[i]) / max(abs(1.0 - ratios[j] / ratios[i]), _APART)
            tilt = min(max(tilt, -most), most)
            for k in range(6):
                T[i, k] -= tilt * U[j, k]
    return True


@kernel
def _product(
    A: NDArray[np.float64], A_transposed: bool, B: NDArray[np.float64], B_transposed: bool, out: NDArray[np.float64]
) -> None:
    """out = A B of (6, 6), either transposed."""
    for i in range(6):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += (A[k, i] if A_transposed else A[i, k]) * (B[j, k] if B_transposed else B[k, j])
            out[i, j] = total
