"""Kernels of the Schur elimination; see `schur` for the symbols."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.sparse.product_tiles import LANES, sum_products


@kernel
def factorize_eliminated(
    begin: int, end: int, C: NDArray[np.float64], damping: NDArray[np.float64], L: NDArray[np.float64]
) -> int:
    """L Lᵀ = C + diag(damping) for the variables [begin, end); the first that is not positive definite, or −1.

    C is (n, e, e), its lower triangle is read; damping is (n e,), or empty for none.
    """
    e = C.shape[1]
    damped = damping.shape[0] > 0
    for n in range(begin, end):
        for j in range(e):
            pivot = C[n, j, j]
            if damped:
                pivot += damping[n * e + j]
            whole = pivot
            for k in range(j):
                pivot -= L[n, j, k] * L[n, j, k]
            # What rounding leaves of a pivot that is zero is not information.
            if not pivot > 1e-14 * whole:
                return n
            root = math.sqrt(pivot)
            L[n, j, j] = root
            for i in range(j + 1, e):
                total = C[n, i, j]
                for k in range(j):
                    total -= L[n, i, k] * L[n, j, k]
                L[n, i, j] = total / root
    return -1


@kernel
def reduce_entries(
    tile: int,
    first: int,
    last: int,
    order: NDArray[np.uint32],
    begin: NDArray[np.int64],
    residual: NDArray[np.uint32],
    Je: NDArray[np.float64],
    Jf: NDArray[np.float64],
    eliminated: NDArray[np.uint32],
    L: NDArray[np.float64],
    Z: NDArray[np.float64],
) -> None:
    """Zᵀ = L⁻¹ Σ Jₑᵀ J_f for the entries order[first:last], each with the residuals [begin[n], begin[n + 1]).

    In the order of the eliminated variables, which is that of the residuals in most files, Jacobians and L are read one after
    the other; only what is written jumps, from one kept variable to the next.
    """
    e, dof = Z.shape[1], Z.shape[2]
    total = np.empty((e, (dof + LANES - 1) // LANES * LANES))
    for m in range(first, last):
        n = np.uint64(order[m])
        sum_products(tile, Je, Jf, residual, residual, begin[n], begin[n + 1], total)
        _substitute(L[np.uint64(eliminated[n])], total, Z[n])


@kernel
def substitute_entries(
    first: int, last: int, eliminated: NDArray[np.uint32], L: NDArray[np.float64], Z: NDArray[np.float64]
) -> None:
    """Z ← L⁻¹ Z for the entries [first, last)."""
    for n in range(first, last):
        _substitute(L[np.uint64(eliminated[n])], Z[n], Z[n])


@kernel(inline=True)
def _substitute(L: NDArray[np.float64], right: NDArray[np.float64], z: NDArray[np.float64]) -> None:
    """z = L⁻¹ right; they may be the same."""
    if z.shape[0] == 3:  # points, unrolled
        a, b, c = 1.0 / L[0, 0], 1.0 / L[1, 1], 1.0 / L[2, 2]
        l10, l20, l21 = L[1, 0], L[2, 0], L[2, 1]
        for q in range(np.uint64(z.shape[1])):
            first = right[0, q] * a
            second = (right[1, q] - l10 * first) * b
            third = (right[2, q] - l20 * first - l21 * second) * c
            z[0, q], z[1, q], z[2, q] = first, second, third
        return
    for p in range(np.uint64(z.shape[0])):
        inverse = 1.0 / L[p, p]
        for q in range(np.uint64(z.shape[1])):
            value = right[p, q]
            for k in range(p):
                value -= L[p, k] * z[k, q]
            z[p, q] = value * inverse


@kernel
def solve_eliminated(first: int, last: int, L: NDArray[np.float64], transposed: bool, y: NDArray[np.float64]) -> None:
    """y ← L⁻¹ y, or L⁻ᵀ y, for the variables [first, last); y is (n, e)."""
    e = y.shape[1]
    for n in range(first, last):
        if not transposed:
            for i in range(e):
                value = y[n, i]
                for k in range(i):
                    value -= L[n, i, k] * y[n, k]
                y[n, i] = value / L[n, i, i]
        else:
            for j in range(e):
                i = e - 1 - j
                value = y[n, i]
                for k in range(i + 1, e):
                    value -= L[n, k, i] * y[n, k]
                y[n, i] = value / L[n, i, i]


@kernel(fastmath=True)
def subtract_from_kept(
    first: int,
    last: int,
    start: NDArray[np.int64],
    begin: NDArray[np.int64],
    eliminated: NDArray[np.uint32],
    Z: NDArray[np.float64],
    y: NDArray[np.float64],
    kept: NDArray[np.float64],
) -> None:
    """kept −= Z y for the F variables [first, last): k has the entries [begin[k], begin[k + 1]) and starts at start[k]."""
    e, dof = Z.shape[1], Z.shape[2]
    total = np.empty(dof)
    for k in range(first, last):
        total[:] = 0.0
        for n in range(np.uint64(begin[k]), np.uint64(begin[k + 1])):
            p = np.uint64(eliminated[n])
            for i in range(np.uint64(e)):
                factor = y[p, i]
                for q in range(np.uint64(dof)):
                    total[q] += Z[n, i, q] * factor
        for q in range(np.uint64(dof)):
            kept[np.uint64(start[k]) + q] -= total[q]


@kernel(fastmath=True)
def subtract_from_eliminated(
    first: int,
    last: int,
    begin: NDArray[np.int64],
    order: NDArray[np.uint32],
    start: NDArray[np.int64],
    Z: NDArray[np.float64],
    kept: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """y −= Zᵀ kept for the E variables [first, last): p has the entries order[begin[p]:begin[p + 1]], which start at start[n]."""
    e, dof = Z.shape[1], Z.shape[2]
    for p in range(first, last):
        for m in range(np.uint64(begin[p]), np.uint64(begin[p + 1])):
            n = np.uint64(order[m])
            at = np.uint64(start[n])
            for i in range(np.uint64(e)):
                total = 0.0
                for q in range(np.uint64(dof)):
                    total += Z[n, i, q] * kept[at + q]
                y[p, i] -= total


@kernel
def count_pairs(begin: NDArray[np.int64]) -> int:
    """Pairs (a ≥ b) of entries of the same E variable."""
    total = 0
    for p in range(begin.shape[0] - 1):
        k = begin[p + 1] - begin[p]
        total += k * (k + 1) // 2
    return total


@kernel
def list_pairs(begin: NDArray[np.int64], order: NDArray[np.int64], a: NDArray[np.uint32], b: NDArray[np.uint32]) -> None:
    """The pairs that `count_pairs` counts, E variable by E variable; `order` lists its entries by ascending F variable."""
    m = 0
    for p in range(begin.shape[0] - 1):
        for i in range(begin[p], begin[p + 1]):
            for j in range(begin[p], i + 1):
                a[m], b[m] = order[i], order[j]
                m += 1


@kernel
def number_entries(
    kept_of: NDArray[np.int64],
    eliminated_of: NDArray[np.int64],
    at_eliminated: NDArray[np.int64],
    at_kept: NDArray[np.int64],
    entry: NDArray[np.int64],
    kept: NDArray[np.int64],
    eliminated: NDArray[np.int64],
    variables: NDArray[np.int64],
    begin: NDArray[np.int64],
) -> tuple[int, int]:
    """Number the different pairs of an F and an E variable, F variable by F variable, ascending in E within each.

    Args:
        kept_of, eliminated_of: (n,) the pairs, repeated and in any order.
        at_eliminated, at_kept: zeros, one more than there are variables of either kind.
        entry: (n,) receives the number of each pair.
        kept, eliminated: receive the pair of each number.
        variables, begin: receive the F variables that are met, where the pairs of each begin, and their number.

    Returns:
        Numbers of different pairs, and of F variables that are met.
    """
    count = len(kept_of)
    for n in range(count):
        at_eliminated[eliminated_of[n] + 1] += 1
        at_kept[kept_of[n] + 1] += 1
    for k in range(len(at_eliminated) - 1):
        at_eliminated[k + 1] += at_eliminated[k]
    for k in range(len(at_kept) - 1):
        at_kept[k + 1] += at_kept[k]
    by_eliminated, order = np.empty(count, np.uint32), np.empty(count, np.uint32)
    for n in range(count):
        by_eliminated[at_eliminated[eliminated_of[n]]] = n
        at_eliminated[eliminated_of[n]] += 1
    for k in range(count):  # stably, so that pairs of an F variable ascend in E
        n = by_eliminated[k]
        order[at_kept[kept_of[n]]] = n
        at_kept[kept_of[n]] += 1
    pairs, met = 0, 0
    for k in range(count):
        n = order[k]
        f, p = kept_of[n], eliminated_of[n]
        if pairs == 0 or f != kept[pairs - 1] or p != eliminated[pairs - 1]:
            if pairs == 0 or f != kept[pairs - 1]:
                variables[met], begin[met] = f, pairs
                met += 1
            kept[pairs], eliminated[pairs] = f, p
            pairs += 1
        entry[n] = pairs - 1
    begin[met] = pairs
    return pairs, met
