"""Whitening and robust weighting of linearised residuals, in place, a chunk at a time while it lies in the cache."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus._jit import kernel
from boxplus.errors import InputError
from boxplus.optimization.losses import SQUARED, USER, triggs, triggs_factors

_SIX = np.uint64(6)


def checked_weights(weights: ArrayLike, count: int) -> NDArray[np.float64]:
    """Weights (count,) of residuals, one each.

    Raises:
        InputError: another shape, negative or not finite ones.
    """
    checked = np.asarray(weights, dtype=np.float64)
    if checked.shape != (count,) or not (np.isfinite(checked) & (checked >= 0.0)).all():
        got = f"shape {checked.shape}, smallest {checked.min(initial=np.inf):g}"
        raise InputError(f"weights ({count},), finite and not negative", got, "repair them")
    return checked


@kernel
def whiten_residuals(begin: int, end: int, W: NDArray[np.float64], is_diagonal: bool, r: NDArray[np.float64]) -> None:
    """r ← W r for the rows [begin, end); W is (1 or N, d, d)."""
    dim = r.shape[1]
    shared = W.shape[0] == 1
    row = np.empty(dim)
    for n in range(begin, end):
        w = W[0] if shared else W[n]
        if is_diagonal:
            for i in range(dim):
                r[n, i] *= w[i, i]
            continue
        for i in range(dim):
            total = 0.0
            for j in range(dim):
                total += w[i, j] * r[n, j]
            row[i] = total
        for i in range(dim):
            r[n, i] = row[i]


@kernel
def _whiten_six(begin: int, end: int, W: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    """J ← W J of 6×6 matrices; a row of the product at a time stays in registers."""
    flat, factors, step = J.reshape(-1), W.reshape(-1), np.uint64(0 if W.shape[0] == 1 else _SIX * _SIX)
    product = np.empty(_SIX * _SIX)
    for n in range(np.uint64(begin), np.uint64(end)):
        at, w = n * _SIX * _SIX, n * step
        for i in range(_SIX):
            p0, p1, p2, p3, p4, p5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            row = i * _SIX
            for j in range(_SIX):
                factor, k = factors[w + row + j], at + j * _SIX
                if factor != 0.0:  # half of a root is
                    p0 += factor * flat[k]
                    p1 += factor * flat[k + np.uint64(1)]
                    p2 += factor * flat[k + np.uint64(2)]
                    p3 += factor * flat[k + np.uint64(3)]
                    p4 += factor * flat[k + np.uint64(4)]
                    p5 += factor * flat[k + np.uint64(5)]
            product[row], product[row + np.uint64(1)], product[row + np.uint64(2)] = p0, p1, p2
            product[row + np.uint64(3)], product[row + np.uint64(4)], product[row + np.uint64(5)] = p3, p4, p5
        for q in range(_SIX * _SIX):
            flat[at + q] = product[q]


@kernel
def _whiten_three(begin: int, end: int, W: NDArray[np.float64], J: NDArray[np.float64]) -> None:
    """J ← W J of 3×3 matrices."""
    step = np.uint64(0 if W.shape[0] == 1 else 1)
    for n in range(np.uint64(begin), np.uint64(end)):
        w, j = W[n * step], J[n]
        w00, w01, w02, w10, w11, w12 = w[0, 0], w[0, 1], w[0, 2], w[1, 0], w[1, 1], w[1, 2]
        w20, w21, w22 = w[2, 0], w[2, 1], w[2, 2]
        for c in range(np.uint64(3)):
            a, b, d = j[0, c], j[1, c], j[2, c]
            j[0, c], j[1, c], j[2, c] = (
                (w00 * a + w01 * b) + w02 * d,
                (w10 * a + w11 * b) + w12 * d,
                (w20 * a + w21 * b) + w22 * d,
            )


@kernel
def whiten_jacobian(begin: int, end: int, W: NDArray[np.float64], is_diagonal: bool, J: NDArray[np.float64]) -> None:
    """J ← W J for the rows [begin, end); J is (N, d, k)."""
    dim, width = J.shape[1], J.shape[2]
    shared = W.shape[0] == 1
    if shared and is_diagonal:
        is_even = True
        for i in range(1, dim):
            is_even &= W[0, i, i] == W[0, 0, 0]
        if is_even:  # one factor for all: a pass that vectorises
            w00, flat = W[0, 0, 0], J.reshape(-1)
            for k in range(np.uint64(begin * dim * width), np.uint64(end * dim * width)):
                flat[k] *= w00
            return
    if dim == 6 and width == 6 and not is_diagonal:  # poses in space and in the plane, written out
        _whiten_six(begin, end, W, J)
        return
    if dim == 3 and width == 3 and not is_diagonal:
        _whiten_three(begin, end, W, J)
        return
    product = np.empty((dim, width))
    for n in range(begin, end):
        w = W[0] if shared else W[n]
        if is_diagonal:
            for i in range(dim):
                for c in range(width):
                    J[n, i, c] *= w[i, i]
            continue
        product[:] = 0.0
        for i in range(dim):
            for j in range(dim):
                factor = w[i, j]
                if factor != 0.0:
                    for c in range(width):
                        product[i, c] += factor * J[n, j, c]
        for i in range(dim):
            for c in range(width):
                J[n, i, c] = product[i, c]


@kernel
def weigh_residuals(
    begin: int,
    end: int,
    code: int,
    scale: float,
    r: NDArray[np.float64],
    valid: NDArray[np.bool_],
    counted: NDArray[np.bool_],
    factor: NDArray[np.float64],
    projection: NDArray[np.float64],
    derivatives: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Cost of the rows [begin, end), and Triggs' scaling of their whitened residuals.

    Args:
        code, scale: of the loss.
        r: (N, d), whitened; becomes √ρ′/(1 − α) r.
        valid: (N,) of this linearisation; an invalid residual costs nothing.
        counted: (N,) residuals that were valid at the point the step started from.
        factor, projection: (N,) receive √ρ′ and α/‖r̃‖² for `weigh_jacobian`; untouched for least squares.
        derivatives: (N, 3) ρ, ρ′, ρ″ of a loss of a user's own; of any length for others.
        sums: receives ½ Σ ρ over the valid rows, the same over those of them that are `counted`, the number of rows
            counted but no longer valid, and the number of valid rows.
    """
    dim = r.shape[1]
    cost, common, lost, alive = 0.0, 0.0, 0.0, 0.0
    for n in range(begin, end):
        if not valid[n]:
            if counted[n]:
                lost += 1.0
            if code != SQUARED:
                factor[n], projection[n] = 0.0, 0.0
            continue
        s = 0.0
        for i in range(dim):
            s += r[n, i] * r[n, i]
        rho = s
        if code != SQUARED:
            if code == USER:
                rho, root, alpha = triggs_factors(derivatives[n, 0], derivatives[n, 1], derivatives[n, 2], s)
            else:
                rho, root, alpha = triggs(code, scale, s)
            grow = root / (1.0 - alpha)
            for i in range(dim):
                r[n, i] *= grow
            factor[n] = root
            scaled = s * grow * grow
            projection[n] = alpha / scaled if scaled > 0.0 else 0.0
        cost += rho
        alive += 1.0
        if counted[n]:
            common += rho
    sums[0], sums[1], sums[2], sums[3] = 0.5 * cost, 0.5 * common, lost, alive


@kernel
def weigh_jacobian(
    begin: int,
    end: int,
    r: NDArray[np.float64],
    factor: NDArray[np.float64],
    projection: NDArray[np.float64],
    J: NDArray[np.float64],
) -> None:
    """J ← √ρ′ (I − α r rᵀ/‖r‖²) J for the rows [begin, end), with the weighed r of `weigh_residuals`."""
    dim, width = J.shape[1], J.shape[2]
    each = np.uint64(dim * width)
    flat = J.reshape(-1)
    for n in range(begin, end):
        root, share = factor[n], projection[n]
        if share == 0.0:  # as for everything that the loss counts in full
            if root != 1.0:
                at = np.uint64(n) * each
                for k in range(at, at + each):
                    flat[k] *= root
            continue
        for c in range(width):
            along = 0.0
            for i in range(dim):
                along += r[n, i] * J[n, i, c]
            along *= share
            for i in range(dim):
                J[n, i, c] = root * (J[n, i, c] - along * r[n, i])


@kernel
def first_not_finite(values: NDArray[np.float64]) -> int:
    """Row of the first NaN or infinity of (N, m) values, or −1."""
    for n in range(values.shape[0]):
        for i in range(values.shape[1]):
            if not math.isfinite(values[n, i]):
                return n
    return -1


@kernel
def add_product_with_jacobian(
    J: NDArray[np.float64], start: NDArray[np.int64], delta: NDArray[np.float64], product: NDArray[np.float64]
) -> None:
    """product (N, d) += J δ; the tangent of row n starts at start[n] of δ, or is fixed at −1."""
    for n in range(J.shape[0]):
        at = start[n]
        if at < 0:
            continue
        for i in range(J.shape[1]):
            total = 0.0
            for c in range(J.shape[2]):
                total += J[n, i, c] * delta[at + c]
            product[n, i] += total


@kernel
def add_product_with_transposed_jacobian(
    J: NDArray[np.float64], start: NDArray[np.int64], z: NDArray[np.float64], product: NDArray[np.float64]
) -> None:
    """product (dof,) += Jᵀ z, z (N, d); the tangent of row n starts at start[n] of it, or is fixed at −1."""
    for n in range(J.shape[0]):
        at = start[n]
        if at < 0:
            continue
        for i in range(J.shape[1]):
            for c in range(J.shape[2]):
                product[at + c] += J[n, i, c] * z[n, i]


@kernel
def add_own_curvature(J: NDArray[np.float64], row: NDArray[np.int64], curvature: NDArray[np.float64]) -> None:
    """curvature (m, k, k) += JᵀJ of J (N, d, k), that of row n to curvature[row[n]], or nowhere at −1."""
    for n in range(J.shape[0]):
        at = row[n]
        if at < 0:
            continue
        for a in range(J.shape[2]):
            for b in range(J.shape[2]):
                total = 0.0
                for i in range(J.shape[1]):
                    total += J[n, i, a] * J[n, i, b]
                curvature[at, a, b] += total
