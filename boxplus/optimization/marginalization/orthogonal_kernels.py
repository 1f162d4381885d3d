"""Householder reflections for marginalisation: landmark by landmark, then into one triangle (docs/marginalization.md).

Matrices lie column by column, A[column, row], so that a reflection works along contiguous memory. No LAPACK is called: for
matrices this small it is slower, wakes the threads of BLAS, and lets the bits depend on their number.

Source: Golub and Van Loan, Matrix Computations, 5.1 and 5.5; Demmel et al., ICCV 2021, section 4.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel

OWN = -2  # column of a slot: the landmark that is eliminated
BATCH = 256  # rows gathered before they are merged into the triangle; few enough for the second-level cache
PANEL = 4  # columns of a batch that are reflected together
TOGETHER = 3  # reflections applied in one go; the degrees of freedom of a point
STEPS = 4  # parts of the columns; rows that begin in a later one are kept apart, as they have less to be merged into


@kernel(fastmath=True, inline=True)
def eliminate_columns(
    A: NDArray[np.float64],
    X: NDArray[np.float64],
    rows_used: int,
    columns_used: int,
    lengths: NDArray[np.float64],
    least: float,
    order: NDArray[np.int64],
    head: NDArray[np.float64],
    W: NDArray[np.float64],
) -> np.int64:
    """Bring the columns A of [A X] to triangular form with pivoting, in place; returns their rank.

    Args:
        A: (count, rows), column by column, of which the first `rows_used` rows are the matrix.
        X: (rows, columns), row by row, of which the first `rows_used` and `columns_used` are the matrix.
        lengths: (count,) of the columns as they were measured; permuted with the columns.
        least: share of its length below which what is left of a column is rounding.
        order: (count,) receives which column stands where.
        head: (2, count) and
        W: (TOGETHER, columns) to work in.
    """
    columns, rows = np.uint64(columns_used), np.uint64(rows_used)
    n, one = np.uint64(A.shape[0]), np.uint64(1)
    for c in range(n):
        order[c] = c
    diagonal, factor = head[0], head[1]
    rank = np.uint64(0)
    for s in range(min(n, rows)):
        best, pivot = 0.0, s
        for c in range(s, n):
            total = 0.0
            for i in range(s, rows):
                total += A[c, i] * A[c, i]
            share = math.sqrt(total) / lengths[c] if lengths[c] > 0.0 else 0.0
            if share > best:
                best, pivot = share, c
        if not best > least:
            break
        if pivot != s:
            order[s], order[pivot] = order[pivot], order[s]
            lengths[s], lengths[pivot] = lengths[pivot], lengths[s]
            for i in range(rows):
                A[s, i], A[pivot, i] = A[pivot, i], A[s, i]
        total = 0.0
        for i in range(s, rows):
            total += A[s, i] * A[s, i]
        diagonal[s] = -math.copysign(math.sqrt(total), A[s, s])
        A[s, s] -= diagonal[s]
        factor[s] = -1.0 / (diagonal[s] * A[s, s])  # 2 / ‖v‖² of v = a − diagonal e, which takes the place of a
        for c in range(s + one, n):
            along = 0.0
            for i in range(s, rows):
                along += A[s, i] * A[c, i]
            along *= factor[s]
            for i in range(s, rows):
                A[c, i] -= along * A[s, i]
        rank += one
    for s in range(np.uint64(0), rank, np.uint64(TOGETHER)):
        _reflect(A, X, s, min(rank - s, np.uint64(TOGETHER)), rows, columns, factor, W)
    for s in range(rank):
        A[s, s] = diagonal[s]
        for i in range(s + one, rows):
            A[s, i] = 0.0
    return np.int64(rank)


@kernel(fastmath=True, inline=True)
def _reflect(
    A: NDArray[np.float64],
    X: NDArray[np.float64],
    s: np.uint64,
    count: np.uint64,
    rows: np.uint64,
    columns: np.uint64,
    factor: NDArray[np.float64],
    W: NDArray[np.float64],
) -> None:
    """Apply the `count` reflections whose vectors stand in columns s … of A, three at most, to X."""
    two, three = count > np.uint64(1), count > np.uint64(2)
    p, q = s + np.uint64(1), s + np.uint64(2)
    f0, f1, f2 = factor[s], factor[p] if two else 0.0, factor[q] if three else 0.0
    c01, c02, c12 = 0.0, 0.0, 0.0
    for c in range(columns):
        W[0, c], W[1, c], W[2, c] = 0.0, 0.0, 0.0
    for i in range(s, rows):
        v0, v1, v2 = A[s, i], A[p, i] if two and i >= p else 0.0, A[q, i] if three and i >= q else 0.0
        c01 += v0 * v1
        c02 += v0 * v2
        c12 += v1 * v2
        for c in range(columns):
            W[0, c] += v0 * X[i, c]
            W[1, c] += v1 * X[i, c]
            W[2, c] += v2 * X[i, c]
    for c in range(columns):
        W[0, c] *= f0
        W[1, c] = f1 * (W[1, c] - W[0, c] * c01)
        W[2, c] = f2 * (W[2, c] - W[0, c] * c02 - W[1, c] * c12)
    for i in range(s, rows):
        v0, v1, v2 = A[s, i], A[p, i] if two and i >= p else 0.0, A[q, i] if three and i >= q else 0.0
        for c in range(columns):
            X[i, c] -= v0 * W[0, c] + v1 * W[1, c] + v2 * W[2, c]


@kernel(fastmath=True, inline=True)
def _reflection(B: NDArray[np.float64], c: np.uint64, rows: np.uint64, triangle: NDArray[np.float64]) -> tuple[float, float]:
    """(head, factor) of the reflection that takes column c of B into the diagonal of the triangle; factor 0 where it is zero."""
    total = 0.0
    for i in range(rows):
        total += B[c, i] * B[c, i]
    if total == 0.0:
        return 0.0, 0.0
    above = triangle[c, c]
    diagonal = -math.copysign(math.sqrt(above * above + total), above)
    triangle[c, c] = diagonal
    return above - diagonal, -1.0 / (diagonal * (above - diagonal))


@kernel(fastmath=True, inline=True)
def merge_batch(B: NDArray[np.float64], start: int, stop: int, used: int, triangle: NDArray[np.float64]) -> None:
    """triangle ← R of [triangle; rows of B], four reflections at a time; B is used up and left at zero.

    Args:
        B: (w + 1, BATCH), the last column the residuals; its columns before `start` and from `stop` on are zero.
        stop: columns of the triangle from here on are zero as well, but for the residuals.
        used: rows.
        triangle: (w, w + 1).
    """
    width, rows = np.uint64(triangle.shape[0]), np.uint64(used)
    one, last = np.uint64(1), np.uint64(stop)
    head, factor = np.empty(PANEL), np.empty(PANEL)
    c = np.uint64(start)
    while c < last:
        count = min(last - c, np.uint64(PANEL))
        for p in range(c, c + count):
            h, f = _reflection(B, p, rows, triangle)
            head[p - c], factor[p - c] = h, f
            for k in range(p + one, c + count):
                s = h * triangle[p, k]
                for i in range(rows):
                    s += B[p, i] * B[k, i]
                s *= f
                triangle[p, k] -= s * h
                for i in range(rows):
                    B[k, i] -= s * B[p, i]
        if count == np.uint64(PANEL):
            _reflect_four(B, c, last, rows, head, factor, triangle)
        else:
            for p in range(c, c + count):
                h, f = head[p - c], factor[p - c]
                s = h * triangle[p, width]
                for i in range(rows):
                    s += B[p, i] * B[width, i]
                s *= f
                triangle[p, width] -= s * h
                for i in range(rows):
                    B[width, i] -= s * B[p, i]
        c += np.uint64(PANEL)
    for q in range(min(np.uint64(start), last), last + one):
        j = q if q < last else width
        for i in range(rows):
            B[j, i] = 0.0


@kernel(fastmath=True, inline=True)
def _reflect_four(
    B: NDArray[np.float64],
    c: np.uint64,
    last: np.uint64,
    rows: np.uint64,
    head: NDArray[np.float64],
    factor: NDArray[np.float64],
    triangle: NDArray[np.float64],
) -> None:
    """Apply the four reflections whose vectors stand in columns c … of B to the columns after them and the residuals."""
    width, one = np.uint64(triangle.shape[0]), np.uint64(1)
    d, e, f = c + one, c + np.uint64(2), c + np.uint64(3)
    hc, hd, he, hf = head[0], head[1], head[2], head[3]
    cd, ce, cf, de, df, ef = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(rows):
        cd += B[c, i] * B[d, i]
        ce += B[c, i] * B[e, i]
        cf += B[c, i] * B[f, i]
        de += B[d, i] * B[e, i]
        df += B[d, i] * B[f, i]
        ef += B[e, i] * B[f, i]
    for q in range(f + one, last + one):
        j = q if q < last else width
        s, t, u, v = hc * triangle[c, j], hd * triangle[d, j], he * triangle[e, j], hf * triangle[f, j]
        for i in range(rows):
            s += B[c, i] * B[j, i]
            t += B[d, i] * B[j, i]
            u += B[e, i] * B[j, i]
            v += B[f, i] * B[j, i]
        s *= factor[0]
        t = factor[1] * (t - s * cd)
        u = factor[2] * (u - s * ce - t * de)
        v = factor[3] * (v - s * cf - t * df - u * ef)
        triangle[c, j] -= s * hc
        triangle[d, j] -= t * hd
        triangle[e, j] -= u * he
        triangle[f, j] -= v * hf
        for i in range(rows):
            B[j, i] -= s * B[c, i] + t * B[d, i] + u * B[e, i] + v * B[f, i]


@kernel(fastmath=True)
def add_rows(
    data: NDArray[np.float64],
    at: NDArray[np.int64],
    dim: NDArray[np.int64],
    slot: NDArray[np.int64],
    column: NDArray[np.int64],
    dof: NDArray[np.int64],
    step: NDArray[np.int64],
    residual: NDArray[np.int64],
    begin: NDArray[np.int64],
    own: NDArray[np.int64],
    least: float,
    work: NDArray[np.float64],
    squares: NDArray[np.float64],
    triangle: NDArray[np.float64],
) -> None:
    """Take landmarks out of their residuals, and merge what is left into the triangle, landmark by landmark.

    A landmark goes through its residuals from those that begin at the last columns to those that begin at the first, and takes
    what is known about itself along: so what the later ones leave does not reach back to the columns of the earlier ones.

    Args:
        data: Jacobians and residuals, one after the other: residual n is (dim, sum of the dof of its slots + 1) from at[n] on.
        slot: (residuals + 1,) where the slots of each begin in `column` and `dof`.
        column: of the triangle for every slot; −1 for what is held, OWN for the landmark.
        step: (residuals,) the part of the columns in which each begins, from 0 to STEPS − 1.
        residual, begin: the residuals of landmark l are residual[begin[l]:begin[l + 1]], steps descending.
        own: (landmarks,) degrees of freedom of each; 0 for residuals without one, which are merged as they are.
        least: see `eliminate_columns`.
        work: as many numbers as the largest landmark has rows times columns.
        squares: (w,) receives the sum of squares of every column.
        triangle: (w, w + 1).
    """
    zero, one = np.uint64(0), np.uint64(1)
    width = triangle.shape[0]
    place = np.full(width, -1)
    touched = np.empty(width, dtype=np.int64)
    lengths, order = np.empty(max(1, own.max())), np.empty(max(1, own.max()), dtype=np.int64)
    shares, position, head = np.empty_like(lengths), np.empty_like(order), np.empty((2, len(lengths)))
    W = np.empty((TOGETHER, width + 1))
    B = np.zeros((STEPS, width + 1, BATCH + 8))  # columns apart by no power of two, which would share sets of the cache
    used = np.zeros(STEPS, dtype=np.int64)
    start, stop = np.full(STEPS, width), 0  # no row so far reaches a column from `stop` on
    for landmark in range(len(own)):
        k = own[landmark]
        height, count = 0, 0
        for e in range(begin[landmark], begin[landmark + 1]):
            n = residual[e]
            height += dim[n]
            for q in range(slot[n], slot[n + 1]):
                if column[q] >= 0 and place[column[q]] < 0:
                    place[column[q]] = 1 + count
                    for j in range(dof[q]):
                        touched[count] = column[q] + j
                        count += 1
        # Its own columns; the residuals, then the other columns in the order in which they are met.
        A = work[: k * height].reshape((k, height))
        X = work[k * height : (k + 1 + count) * height].reshape((height, 1 + count))
        lengths[:] = 0.0
        for c in range(k):
            position[c] = c
        reach, rows, lowest = 1, 0, width
        e = begin[landmark]
        while e < begin[landmark + 1]:
            now = step[residual[e]]
            kept, before = rows, reach
            first = e
            while e < begin[landmark + 1] and step[residual[e]] == now:
                n = residual[e]
                rows += dim[n]
                for q in range(slot[n], slot[n + 1]):
                    if column[q] >= 0:
                        lowest, stop = min(lowest, column[q]), max(stop, column[q] + dof[q])
                        reach = max(reach, place[column[q]] + dof[q])
                e += 1
            A[:, kept:rows] = 0.0
            X[:kept, before:reach] = 0.0
            X[kept:rows, :reach] = 0.0
            top = np.uint64(kept)
            for f in range(first, e):
                n = residual[f]
                source, numbers, lines = np.uint64(at[n]), np.uint64(0), np.uint64(dim[n])
                for q in range(slot[n], slot[n + 1]):
                    numbers += np.uint64(dof[q])
                numbers += one
                for q in range(slot[n], slot[n + 1]):
                    c, d = column[q], np.uint64(dof[q])
                    if c >= 0:
                        to, u = np.uint64(place[c]), np.uint64(c)
                        for h in range(lines):
                            for j in range(d):
                                value = data[source + h * numbers + j]
                                X[top + h, to + j] += value
                                squares[u + j] += value * value
                    elif c == OWN:
                        for j in range(np.uint64(k)):
                            to = np.uint64(position[j])
                            for h in range(lines):
                                A[to, top + h] += data[source + h * numbers + j]
                    source += d
                for h in range(lines):
                    X[top + h, zero] = data[source + h * numbers]
                top += lines
            rank = 0
            if k > 0:
                for c in range(k):
                    for i in range(kept, rows):
                        lengths[c] += A[c, i] * A[c, i]
                    shares[c] = math.sqrt(lengths[c])
                rank = eliminate_columns(A, X, rows, reach, shares, least, order, head, W)
                for c in range(k):
                    shares[c] = lengths[order[c]]
                for c in range(k):
                    lengths[c] = shares[c]
                for j in range(k):
                    for c in range(k):
                        if order[c] == position[j]:
                            position[j] = c
                            break
            done = rank
            while done < rows:
                if used[now] == BATCH:
                    merge_batch(B[now], start[now], stop, used[now], triangle)
                    used[now] = 0
                fresh, below = min(rows - done, BATCH - used[now]), used[now]
                gathered, from_row, to_row = B[now], np.uint64(done), np.uint64(below)
                for m in range(one, np.uint64(reach)):
                    to = np.uint64(touched[m - one])
                    for h in range(np.uint64(fresh)):
                        gathered[to, to_row + h] = X[from_row + h, m]
                for h in range(np.uint64(fresh)):
                    gathered[np.uint64(width), to_row + h] = X[from_row + h, zero]
                start[now] = min(start[now], lowest)
                used[now] += fresh
                done += fresh
            rows = rank
        for c in range(count):
            place[touched[c]] = -1
    for now in range(STEPS):
        merge_batch(B[now], start[now], stop, used[now], triangle)
