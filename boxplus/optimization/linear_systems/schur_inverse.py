"""Blocks of the inverse where variables were eliminated: covariances of points, from those of the cameras that see them.

With S the reduced matrix and M = L⁻ᵀ Zᵀ (see `schur`), H⁻¹ is S⁻¹ between kept variables, −M S⁻¹ between an eliminated and the
kept ones, and (C + D)⁻¹ + M S⁻¹ Mᵀ between eliminated ones. An eliminated variable meets few of the kept ones, so that every
block is a short sum Σ Fₐ S⁻¹ₐᵦ Fᵦᵀ over those that its two variables reach, with F = −M of the entry, or 1 of a kept variable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel, run_chunks
from boxplus.optimization.linear_systems.normal_equations import piece
from boxplus.optimization.linear_systems.schur_structure import Entries
from boxplus.sparse.block_matrix import unique_keys

Indices = NDArray[np.int64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Reached:
    """The kept variables through which variables are correlated with others.

    Attributes:
        dof: (n,) degrees of freedom of the variables.
        own: (n,) place of each among the eliminated ones, −1 for a kept one.
        begin: (n + 1,) where the kept variables of each begin in `kept`.
        kept: (m,) kept variables, by their numbers among these.
        width: (m,) degrees of freedom of each.
        at: (m,) where F (dof, width), row-major, begins in `factors`.
        factors: all F.
    """

    dof: Indices
    own: Indices
    begin: Indices
    kept: Indices
    width: Indices
    at: Indices
    factors: Matrix

    @classmethod
    def of(cls, numbers: Indices, sizes: Indices, first: int, L: Matrix, entries: Sequence[Entries]) -> Reached:
        """For the variables `numbers` (n,) of all whose `sizes` these are; the eliminated ones begin at `first`."""
        eliminated, e = len(L), L.shape[1]
        own = numbers - first
        own = np.where((own >= 0) & (own < eliminated), own, -1)
        is_kept = own < 0
        counts = is_kept.astype(np.int64)
        dof = sizes[numbers]
        size = int((dof[is_kept] ** 2).sum())
        for k in entries:
            met = np.where(is_kept, 0, np.diff(k.of_eliminated, append=0)[own])
            counts += met
            size += e * k.dof * int(met.sum())
        begin = np.concatenate([[0], np.cumsum(counts)])
        kept, width, at = (np.empty(int(begin[-1]), dtype=np.int64) for _ in range(3))
        factors, fill = np.zeros(size), begin[:-1].copy()
        number = np.where(numbers < first, numbers, numbers - eliminated)
        end = _list_kept(number, own, dof, begin, kept, width, at, factors)
        for k in entries:
            end = _list_entries(own, k.of_eliminated, k.order, k.kept, k.Z, L, fill, kept, width, at, factors, end)
        return cls(dof, own, begin, kept, width, at, factors)


@kernel
def _list_kept(number: Indices, own: Indices, dof: Indices, begin: Indices, kept: Indices, width: Indices, at: Indices,
               factors: Matrix) -> int:  # fmt: skip
    """Kept variables reach themselves; returns the length of `factors`, which is zero before, so far."""
    end = 0
    for n in range(number.shape[0]):
        if own[n] < 0:
            m, d = begin[n], dof[n]
            kept[m], width[m], at[m] = number[n], d, end
            for i in range(d):
                factors[end + i * (d + 1)] = 1.0
            end += d * d
    return end


@kernel
def _list_entries(own: Indices, of_eliminated: Indices, order: NDArray[np.uint32], entry_kept: Indices, Z: Matrix, L: Matrix,
                  fill: Indices, kept: Indices, width: Indices, at: Indices, factors: Matrix, end: int) -> int:  # fmt: skip
    """Eliminated variables reach the kept ones of their entries, with −L⁻ᵀ Z; `fill` (n,) is moved on."""
    e, d = Z.shape[1], Z.shape[2]
    for n in range(own.shape[0]):
        p = own[n]
        if p < 0:
            continue
        for o in range(of_eliminated[p], of_eliminated[p + 1]):
            entry, m = np.uint64(order[o]), fill[n]
            fill[n] += 1
            kept[m], width[m], at[m] = entry_kept[entry], d, end
            for i in range(e - 1, -1, -1):
                for q in range(d):
                    total = -Z[entry, i, q]
                    for k in range(i + 1, e):
                        total -= L[p, k, i] * factors[end + k * d + q]
                    factors[end + i * d + q] = total / L[p, i, i]
            end += e * d
    return end


@kernel
def _count_pairs(i: Indices, j: Indices, begin: Indices, start: Indices) -> None:
    """Where the pairs of kept variables of each block begin; of a block of the diagonal those of one triangle."""
    for k in range(i.shape[0]):
        rows, columns = begin[i[k] + 1] - begin[i[k]], begin[j[k] + 1] - begin[j[k]]
        start[k + 1] = start[k] + (rows * (rows + 1) // 2 if i[k] == j[k] else rows * columns)


@kernel
def _list_keys(i: Indices, j: Indices, begin: Indices, kept: Indices, number: int, keys: Indices) -> None:
    """a · number + b of the pairs, b by b."""
    m = np.uint64(0)
    for k in range(i.shape[0]):
        for b in range(begin[j[k]], begin[j[k] + 1]):
            for a in range(begin[i[k]], b + 1 if i[k] == j[k] else begin[i[k] + 1]):
                keys[m] = kept[a] * number + kept[b]
                m += np.uint64(1)


@kernel(fastmath=True)
def _add_blocks(first: int, last: int, i: Indices, j: Indices, dof: Indices, own: Indices, begin: Indices, width: Indices,
                at: Indices, factors: Matrix, start: Indices, pair: Indices, inverse_at: Indices, inverse: Matrix, L: Matrix,
                found_at: Indices, found: Matrix) -> None:  # fmt: skip
    """Σ Fₐ S⁻¹ₐᵦ Fᵦᵀ, and (C + D)⁻¹, of the blocks [first, last); a block of the diagonal from one triangle of its sum."""
    largest = 1
    for n in range(dof.shape[0]):
        largest = max(largest, dof[n])
    widest = 1
    for n in range(width.shape[0]):
        widest = max(widest, width[n])
    V, R = np.empty(largest * widest), np.zeros((L.shape[1], L.shape[1]))
    for k in range(first, last):
        x, y = i[k], j[k]
        rows, columns, to = np.uint64(dof[x]), np.uint64(dof[y]), np.uint64(found_at[k])
        m = start[k]
        for b in range(begin[y], begin[y + 1]):
            depth, right = np.uint64(width[b]), np.uint64(at[b])
            for q in range(rows * depth):
                V[q] = 0.0
            for a in range(begin[x], b + 1 if x == y else begin[x + 1]):
                share, across, left, block = (
                    0.5 if x == y and a == b else 1.0,
                    np.uint64(width[a]),
                    np.uint64(at[a]),
                    np.uint64(0),
                )
                block = np.uint64(inverse_at[pair[m]])
                m += 1
                for p in range(rows):
                    for c in range(across):
                        factor = share * factors[left + p * across + c]
                        for q in range(depth):
                            V[p * depth + q] += factor * inverse[block + c * depth + q]
            for p in range(rows):
                for s in range(columns):
                    total = 0.0
                    for q in range(depth):
                        total += V[p * depth + q] * factors[right + s * depth + q]
                    found[to + p * columns + s] += total
        if x != y:
            continue
        for p in range(rows):
            for s in range(p + np.uint64(1)):
                both = found[to + p * columns + s] + found[to + s * columns + p]
                found[to + p * columns + s] = found[to + s * columns + p] = both
        if own[x] >= 0:
            _add_own(L[own[x]], R, found, to)


@kernel
def _add_own(L: Matrix, R: Matrix, found: Matrix, to: np.uint64) -> None:
    """found[to:] += L⁻ᵀ L⁻¹, row-major; R is scratch."""
    e = L.shape[0]
    for s in range(e):
        for p in range(s, e):
            total = 1.0 if p == s else 0.0
            for k in range(s, p):
                total -= L[p, k] * R[k, s]
            R[p, s] = total / L[p, p]
    for p in range(e):
        for s in range(e):
            total = 0.0
            for k in range(max(p, s), e):
                total += R[k, p] * R[k, s]
            found[to + np.uint64(p * e + s)] += total


def inverse_values(
    first: Indices,
    second: Indices,
    sizes: Indices,
    begin: int,
    L: Matrix,
    entries: Sequence[Entries],
    kept_inverse: Callable[[Indices, Indices], tuple[Indices, Matrix]],
    threads: int,
) -> Matrix:
    """Blocks (dof of first[k], dof of second[k]) of H⁻¹ for pairs of variables, one after another, row-major.

    Args:
        sizes: degrees of freedom of all variables.
        begin: number of the first eliminated variable; L (n, e, e): their factors.
        kept_inverse: gives sizes and values of the blocks of S⁻¹ for pairs of kept variables, likewise.
    """
    numbers, place = np.unique(np.concatenate([first, second]), return_inverse=True)
    reached = Reached.of(numbers, sizes, begin, L, entries)
    i, j = place[: len(first)].astype(np.int64), place[len(first) :].astype(np.int64)
    start = np.zeros(len(i) + 1, dtype=np.int64)
    _count_pairs(i, j, reached.begin, start)
    kept = len(sizes) - len(L)
    keys = np.empty(int(start[-1]), dtype=np.int64)
    _list_keys(i, j, reached.begin, reached.kept, kept, keys)
    wanted, pair = unique_keys(keys, kept * kept)
    lengths, inverse = kept_inverse(wanted // max(kept, 1), wanted % max(kept, 1))
    inverse_at = np.cumsum(lengths) - lengths
    rows, columns = reached.dof[i], reached.dof[j]
    ends = np.cumsum(rows * columns)
    found, found_at = np.zeros(int(ends[-1]) if len(ends) else 0), ends - rows * columns

    def work(_: int, from_: int, to: int) -> None:
        _add_blocks(from_, to, i, j, reached.dof, reached.own, reached.begin, reached.width, reached.at, reached.factors,
                    start, pair, inverse_at, inverse, L, found_at, found)  # fmt: skip

    run_chunks(work, len(i), piece(len(i), threads), threads)
    return found
