"""Kernels of the Schur elimination; see `schur` for the symbols.

The loops over degrees of freedom have constant lengths, so each kernel is generated for its sizes. Rows of W and Z are padded to
whole vectors of four numbers.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.schur_padding import padded
from boxplus.optimization.schur_tiles import sum_pairs_6, sum_pairs_9


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


@functools.cache
def cross_kernel(dim: int, e: int, dof: int) -> Callable[..., None]:
    """A kernel W[target[k]] += Σ Jₑᵀ J_f over the residuals of each entry k."""

    @kernel(fastmath=True)
    def accumulate_cross(
        first: int,
        last: int,
        target: NDArray[np.int64],
        begin: NDArray[np.int64],
        residual: NDArray[np.uint32],
        Je: NDArray[np.float64],
        Jf: NDArray[np.float64],
        W: NDArray[np.float64],
    ) -> None:
        for k in range(first, last):
            block = W[target[k]]
            for m in range(begin[k], begin[k + 1]):
                n = np.uint64(residual[m])
                for p in range(e):
                    for i in range(dim):
                        factor = Je[n, i, p]
                        for q in range(dof):
                            block[p, q] += factor * Jf[n, i, q]

    return accumulate_cross  # type: ignore[no-any-return]


@functools.cache
def reduce_kernel(e: int, width: int) -> Callable[..., None]:
    """A kernel Z = L⁻¹ W for the entries [begin, end), rows of `width` numbers, padding included."""

    @kernel(fastmath=True)
    def reduce_entries(
        begin: int,
        end: int,
        eliminated: NDArray[np.uint32],
        L: NDArray[np.float64],
        W: NDArray[np.float64],
        Z: NDArray[np.float64],
    ) -> None:
        for n in range(begin, end):
            own, w, z = L[np.uint64(eliminated[n])], W[n], Z[n]
            for p in range(e):
                inverse = 1.0 / own[p, p]
                for q in range(width):
                    z[p, q] = w[p, q]
                for k in range(p):
                    factor = own[p, k]
                    for q in range(width):
                        z[p, q] -= factor * z[k, q]
                for q in range(width):
                    z[p, q] *= inverse

    return reduce_entries  # type: ignore[no-any-return]


def products_kernel(e: int, dof_a: int, dof_b: int) -> Callable[..., None]:
    """A kernel values[target[k]:] −= Σ Zₐ Z_bᵀ over the pairs of entries of each block k of S."""
    if (e, dof_a, dof_b) == (3, 9, 9):
        return _subtract_products_9  # type: ignore[no-any-return]
    if (e, dof_a, dof_b) == (3, 6, 6):
        return _subtract_products_6  # type: ignore[no-any-return]
    return _general_products_kernel(e, dof_a, dof_b)


@kernel
def _subtract_products_9(
    first: int,
    last: int,
    target: NDArray[np.int64],
    begin: NDArray[np.int64],
    entry_a: NDArray[np.uint32],
    entry_b: NDArray[np.uint32],
    Za: NDArray[np.float64],
    Zb: NDArray[np.float64],
    values: NDArray[np.float64],
) -> None:
    total = np.empty((9, 12))
    for k in range(first, last):
        sum_pairs_9(Za, Zb, entry_a, entry_b, np.uint64(begin[k]), np.uint64(begin[k + 1]), total)
        at = np.uint64(target[k])
        for p in range(np.uint64(9)):
            for q in range(np.uint64(9)):
                values[at + np.uint64(9) * p + q] -= total[p, q]


@kernel
def _subtract_products_6(
    first: int,
    last: int,
    target: NDArray[np.int64],
    begin: NDArray[np.int64],
    entry_a: NDArray[np.uint32],
    entry_b: NDArray[np.uint32],
    Za: NDArray[np.float64],
    Zb: NDArray[np.float64],
    values: NDArray[np.float64],
) -> None:
    total = np.empty((6, 8))
    for k in range(first, last):
        sum_pairs_6(Za, Zb, entry_a, entry_b, np.uint64(begin[k]), np.uint64(begin[k + 1]), total)
        at = np.uint64(target[k])
        for p in range(np.uint64(6)):
            for q in range(np.uint64(6)):
                values[at + np.uint64(6) * p + q] -= total[p, q]


@functools.cache
def _general_products_kernel(e: int, dof_a: int, dof_b: int) -> Callable[..., None]:
    width = padded(dof_b)

    @kernel(fastmath=True)
    def subtract_products(
        first: int,
        last: int,
        target: NDArray[np.int64],
        begin: NDArray[np.int64],
        entry_a: NDArray[np.uint32],
        entry_b: NDArray[np.uint32],
        Za: NDArray[np.float64],
        Zb: NDArray[np.float64],
        values: NDArray[np.float64],
    ) -> None:
        total = np.zeros((dof_a, width))
        for k in range(first, last):
            total[:] = 0.0
            for m in range(begin[k], begin[k + 1]):
                a, b = Za[np.uint64(entry_a[m])], Zb[np.uint64(entry_b[m])]
                for p in range(dof_a):
                    for i in range(e):
                        factor = a[i, p]
                        for q in range(width):
                            total[p, q] += factor * b[i, q]
            at = np.uint64(target[k])
            for p in range(dof_a):
                for q in range(dof_b):
                    values[at + np.uint64(p * dof_b + q)] -= total[p, q]

    return subtract_products  # type: ignore[no-any-return]


@kernel
def solve_eliminated(L: NDArray[np.float64], transposed: bool, y: NDArray[np.float64]) -> None:
    """y ← L⁻¹ y, or L⁻ᵀ y, variable by variable; y is (n, e)."""
    count, e = y.shape
    for n in range(count):
        if not transposed:
            for i in range(e):
                for k in range(i):
                    y[n, i] -= L[n, i, k] * y[n, k]
                y[n, i] /= L[n, i, i]
        else:
            for j in range(e):
                i = e - 1 - j
                for k in range(i + 1, e):
                    y[n, i] -= L[n, k, i] * y[n, k]
                y[n, i] /= L[n, i, i]


@kernel
def subtract_from_rest(
    start: NDArray[np.int64],
    begin: NDArray[np.int64],
    eliminated: NDArray[np.uint32],
    Z: NDArray[np.float64],
    dof: int,
    y: NDArray[np.float64],
    rest: NDArray[np.float64],
) -> None:
    """rest −= Z y: F variable k has the entries [begin[k], begin[k + 1]) and starts at start[k] of `rest`."""
    e = y.shape[1]
    for k in range(start.shape[0]):
        at = start[k]
        for n in range(begin[k], begin[k + 1]):
            p = eliminated[n]
            for i in range(e):
                factor = y[p, i]
                for q in range(dof):
                    rest[at + q] -= Z[n, i, q] * factor


@kernel
def subtract_from_eliminated(
    begin: NDArray[np.int64],
    order: NDArray[np.uint32],
    start: NDArray[np.int64],
    Z: NDArray[np.float64],
    dof: int,
    rest: NDArray[np.float64],
    y: NDArray[np.float64],
) -> None:
    """y −= Zᵀ rest: E variable p has the entries order[begin[p]:begin[p + 1]]; entry n starts at start[n] of `rest`."""
    count, e = y.shape
    for p in range(count):
        for m in range(begin[p], begin[p + 1]):
            n = order[m]
            at = start[n]
            for i in range(e):
                total = 0.0
                for q in range(dof):
                    total += Z[n, i, q] * rest[at + q]
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
