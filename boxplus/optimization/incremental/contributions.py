"""What each residual adds to the normal equations: [J, −r]ᵀ[J, −r], whitened and weighted, kept until it is linearised again."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.se2 import between_scalars, log_scalars
from boxplus.optimization.losses import SQUARED
from boxplus.optimization.terms.weighting import weigh_jacobian, weigh_residuals, whiten_jacobian, whiten_residuals
from boxplus.residuals.relative_pose import evaluate_rows, linearize_rows
from boxplus.residuals.relative_pose_2d import evaluate_rows as evaluate_rows_2d
from boxplus.residuals.relative_pose_2d import linearize_rows as linearize_rows_2d

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_ONE, _TWO = np.uint64(1), np.uint64(2)


@kernel
def products(rows: Indices, free: NDArray[np.bool_], source: Indices, r: Array, jacobians: Any, at: Indices,
             contributions: Array) -> int:  # fmt: skip
    """Write the contributions of residuals.

    Args:
        rows: (k,) rows of `free` and `at`.
        free: (N, connections) whether the connected variable is eliminated; a fixed one has no columns.
        source: (k,) rows of `r` and of every Jacobian, a tuple of (·, d, dof).
        at: (N,) first element of each contribution, row-major.

    Returns:
        The first row that is not finite, or −1.
    """
    most = 1
    for J in jacobians:
        most += J.shape[2]
    dim = r.shape[1]
    wide = np.empty((dim, most))
    for k in range(len(rows)):
        n, s, width = rows[k], source[k], 0
        for slot in range(len(jacobians)):
            if free[n, slot]:
                J = jacobians[slot]
                for i in range(dim):
                    for c in range(J.shape[2]):
                        wide[i, width + c] = J[s, i, c]
                width += J.shape[2]
        for i in range(dim):
            wide[i, width] = -r[s, i]
        width += 1
        first, total = at[n], 0.0
        for a in range(width):
            for b in range(a + 1):
                entry = 0.0
                for i in range(dim):
                    entry += wide[i, a] * wide[i, b]
                contributions[first + a * width + b] = entry
                contributions[first + b * width + a] = entry
            total += contributions[first + a * width + a]
        if not math.isfinite(total):
            return n  # type: ignore[no-any-return]
    return -1


@kernel
def errors(rows: Indices, source: Indices, truth: Array, r: Array, jacobians: Any, start: Indices, delta: Array, tolerance: float,
           is_off: NDArray[np.bool_]) -> None:  # fmt: skip
    """Whether the linearisation r + Jδ of residuals is further than `tolerance` from what they are at δ.

    Args:
        rows: (k,) rows of `r`, of every Jacobian and of `start`.
        source: (k,) rows of `truth`.
        start: (k, connections) where the connected variables begin in δ, −1 for a fixed one.
        is_off: (k,) receives the answer; NaN is off.
    """
    for k in range(len(rows)):
        n, square = rows[k], 0.0
        for i in range(r.shape[1]):
            error = truth[source[k], i] - r[n, i]
            for slot in range(len(jacobians)):
                J, at = jacobians[slot], start[k, slot]
                if at >= 0:
                    for c in range(J.shape[2]):
                        error -= J[n, i, c] * delta[at + c]
            square += error * error
        is_off[k] = not square <= tolerance * tolerance


@kernel
def starts(rows: Indices, index: NDArray[np.uint32], ids: Any, start: Indices) -> Indices:
    """(k, connections) where the variables of residuals begin in δ, −1 for fixed ones; `ids` of the block of every connection."""
    found = np.empty((len(rows), len(ids)), np.int64)
    for k in range(len(rows)):
        for slot in range(len(ids)):
            v = ids[slot][index[rows[k], slot]]
            found[k, slot] = start[v] if v >= 0 else -1
    return found


@kernel
def _whitened(rows: Indices, is_spatial: bool, is_exact: bool, with_jacobians: bool, T_i: Array, T_j: Array,
              index: NDArray[np.uint32], measured: Array, factors: Array, code: int, scale: float, r: Array,
              J_i: Array, J_j: Array) -> None:  # fmt: skip
    """Whitened and weighted relative poses of some rows, packed, with Jacobians or without."""
    count, dim = len(rows), factors.shape[1]
    i, j = np.empty(count, np.uint32), np.empty(count, np.uint32)
    Z, W = np.empty((count, measured.shape[1])), np.empty((count, dim, dim))
    for k in range(count):
        n = rows[k]
        i[k], j[k] = index[n, 0], index[n, 1]
        for a in range(measured.shape[1]):
            Z[k, a] = measured[n, a]
        for a in range(dim):
            for b in range(dim):
                W[k, a, b] = factors[n, a, b]
    valid = np.ones(count, np.bool_)
    if with_jacobians:
        if is_spatial:
            linearize_rows(0, count, T_i, T_j, i, j, Z, is_exact, r, J_i, J_j, valid)
        else:
            linearize_rows_2d(0, count, T_i, T_j, i, j, Z, r, J_i, J_j, valid)
    elif is_spatial:
        evaluate_rows(0, count, T_i, T_j, i, j, Z, r, valid)
    else:
        evaluate_rows_2d(0, count, T_i, T_j, i, j, Z, r, valid)
    whiten_residuals(0, count, W, False, r)
    factor, projection = np.empty(count), np.empty(count)
    weigh_residuals(0, count, code, scale, r, valid, valid, factor, projection, np.empty((0, 3)), np.empty(4))
    if with_jacobians:
        whiten_jacobian(0, count, W, False, J_i)
        whiten_jacobian(0, count, W, False, J_j)
        if code != SQUARED:
            weigh_jacobian(0, count, r, factor, projection, J_i)
            weigh_jacobian(0, count, r, factor, projection, J_j)


@kernel
def linearize_relative_poses(rows: Indices, is_spatial: bool, is_exact: bool, T_i: Array, T_j: Array, index: NDArray[np.uint32],
                             measured: Array, factors: Array, code: int, scale: float, free: NDArray[np.bool_], r: Array,
                             J_i: Array, J_j: Array, at: Indices, contributions: Array) -> int:  # fmt: skip
    """Fill some rows of r and J and their contributions; see `products`."""
    count, dim = len(rows), factors.shape[1]
    r_k, J_ik, J_jk = np.empty((count, dim)), np.empty((count, dim, dim)), np.empty((count, dim, dim))
    _whitened(rows, is_spatial, is_exact, True, T_i, T_j, index, measured, factors, code, scale, r_k, J_ik, J_jk)
    for k in range(count):
        n = rows[k]
        for a in range(dim):
            r[n, a] = r_k[k, a]
            for b in range(dim):
                J_i[n, a, b], J_j[n, a, b] = J_ik[k, a, b], J_jk[k, a, b]
    return products(rows, free, rows, r, (J_i, J_j), at, contributions)  # type: ignore[no-any-return]


@kernel
def check_relative_poses(rows: Indices, is_spatial: bool, is_exact: bool, T_i: Array, T_j: Array, index: NDArray[np.uint32],
                         measured: Array, factors: Array, code: int, scale: float, ids_i: Indices, ids_j: Indices,
                         start: Indices, delta: Array, tolerance: float, r: Array, J_i: Array, J_j: Array,
                         is_off: NDArray[np.bool_]) -> None:  # fmt: skip
    """Whether the linearisation of some rows is off at δ, the estimates being T_i and T_j; see `errors`."""
    truth = np.empty((len(rows), factors.shape[1]))
    none = np.empty((0, 0, 0))
    _whitened(rows, is_spatial, is_exact, False, T_i, T_j, index, measured, factors, code, scale, truth, none, none)
    places = starts(rows, index, (ids_i, ids_j), start)
    errors(rows, np.arange(len(rows)), truth, r, (J_i, J_j), places, delta, tolerance, is_off)


@kernel
def turned_factors(begin: int, end: int, measured: Array, factors: Array, turned: Array) -> None:
    """Whitening factors of planar poses Z with the turn that Log(Z⁻¹ M) begins with: W diag(1, R_Zᵀ), rows [begin, end)."""
    for n in range(begin, end):
        c, s = math.cos(measured[n, 0]), math.sin(measured[n, 0])
        for a in range(3):
            turned[n, a, 0] = factors[n, a, 0]
            turned[n, a, 1] = c * factors[n, a, 1] - s * factors[n, a, 2]
            turned[n, a, 2] = s * factors[n, a, 1] + c * factors[n, a, 2]


@kernel(inline=True)
def _product(A: Array, n: int, row: int, a: float, b: float, c: float) -> float:
    return A[n, row, 0] * a + A[n, row, 1] * b + A[n, row, 2] * c  # type: ignore[no-any-return]


@kernel
def check_planar_poses(rows: Indices, T_i: Array, T_j: Array, index: NDArray[np.uint32], measured: Array, turned: Array,
                       ids_i: Indices, ids_j: Indices, start: Indices, delta: Array, tolerance: float, r: Array, J_i: Array,
                       J_j: Array, is_off: NDArray[np.bool_]) -> None:  # fmt: skip
    """As `check_relative_poses`, for least squares in the plane, where nearly all of an update's residuals are looked at in vain.

    V⁻¹ of Log commutes with the turn of Z in the plane, which `turned` has taken in; one sine and cosine are left of two.
    """
    for k in range(np.uint64(len(rows))):
        n = np.uint64(rows[k])
        i, j = np.uint64(index[n, 0]), np.uint64(index[n, 1])
        theta, x, y = between_scalars(T_i[i, 0], T_i[i, 1], T_i[i, 2], T_j[j, 0], T_j[j, 1], T_j[j, 2])
        w, v0, v1 = log_scalars(theta - measured[n, 0], x - measured[n, 1], y - measured[n, 2])
        e0 = _product(turned, n, 0, w, v0, v1) - r[n, 0]
        e1 = _product(turned, n, 1, w, v0, v1) - r[n, 1]
        e2 = _product(turned, n, 2, w, v0, v1) - r[n, 2]
        if ids_i[i] >= 0:
            at = np.uint64(start[ids_i[i]])
            e0 -= _product(J_i, n, 0, delta[at], delta[at + _ONE], delta[at + _TWO])
            e1 -= _product(J_i, n, 1, delta[at], delta[at + _ONE], delta[at + _TWO])
            e2 -= _product(J_i, n, 2, delta[at], delta[at + _ONE], delta[at + _TWO])
        if ids_j[j] >= 0:
            at = np.uint64(start[ids_j[j]])
            e0 -= _product(J_j, n, 0, delta[at], delta[at + _ONE], delta[at + _TWO])
            e1 -= _product(J_j, n, 1, delta[at], delta[at + _ONE], delta[at + _TWO])
            e2 -= _product(J_j, n, 2, delta[at], delta[at + _ONE], delta[at + _TWO])
        is_off[k] = not e0 * e0 + e1 * e1 + e2 * e2 <= tolerance * tolerance
