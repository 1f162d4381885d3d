"""The numbers of a factorisation, and the threads that compute them: subtrees side by side, then large fronts together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import run_chunks
from boxplus.sparse.dense_kernels import BLOCK, factor_block, update_rows
from boxplus.sparse.multifrontal import begin_front, end_front, factorize
from boxplus.sparse.supernodes import ALIGNMENT, Fronts

LARGE = 3e8
"""Operations from which on a front is worth several threads."""

ROWS = 256
"""Rows of a large front that one thread updates at a time."""


def _aligned(size: int) -> NDArray[np.float64]:
    """Zeros from the start of a cache line on, so that panels do not straddle lines."""
    whole = np.zeros(size + 2 * ALIGNMENT)
    return whole[(-whole.ctypes.data // 8) % ALIGNMENT :][:size]


class NumericFactor:
    """Memory of L for an analysed pattern, filled by `factorize`.

    Attributes:
        panels: the panels of L.
        stack: update matrices; scratch between factorisations.
        inverse: (N,) reciprocals of L's diagonal, in elimination order.
        pivots: (N,) squares of it.
    """

    def __init__(self, fronts: Fronts, threads: int) -> None:
        self._fronts, self._threads = fronts, threads
        size = len(fronts.scalar_order)
        self.panels, self.stack = _aligned(fronts.factor_size), _aligned(fronts.stack_size)
        self.inverse, self.pivots, self._entries = np.zeros(size), np.zeros(size), np.zeros(size)
        width, below = (fronts.table[name].astype(np.float64) for name in ("width", "below"))
        rest = fronts.sequence[fronts.parts[-2] :]
        large = np.flatnonzero((width * (width**2 / 3 + width * below + below**2))[rest] > (LARGE if threads > 1 else np.inf))
        self._large = [int(fronts.parts[-2] + k) for k in large]

    def factorize(self, values: NDArray[np.float64], diagonal: NDArray[np.float64]) -> int:
        """Factorise the matrix with these values plus a diagonal (N,); returns the first failed scalar position, or N."""
        parts, size = self._fronts.parts.tolist(), len(self.pivots)
        failed = [size] * (len(parts) - 2)

        def work(part: int, _begin: int, _end: int) -> None:
            failed[part] = self._factorize_range(parts[part], parts[part + 1], values, diagonal)

        run_chunks(work, len(failed), 1, self._threads)
        first = min(failed, default=size)
        begin = parts[-2]
        for place in [*self._large, parts[-1]]:
            if first == size:
                first = self._factorize_range(begin, place, values, diagonal)
            if first == size and place < parts[-1]:
                first = self._factorize_large(int(self._fronts.sequence[place]), values, diagonal)
            begin = place + 1
        return first

    def _factorize_range(self, begin: int, end: int, values: NDArray[np.float64], diagonal: NDArray[np.float64]) -> int:
        fronts = self._fronts
        return int(
            factorize(
                fronts.sequence, np.uint64(begin), np.uint64(end), fronts.table, fronts.children, fronts.runs, fronts.entries,
                fronts.scalar_order, values, diagonal, self.panels, self.stack, self.inverse, self.pivots, self._entries,
            )
        )  # fmt: skip

    def _factorize_large(self, front: int, values: NDArray[np.float64], diagonal: NDArray[np.float64]) -> int:
        """One front by all threads: block after block of columns, the rest of the front updated in rows side by side."""
        fronts, record, g = self._fronts, self._fronts.table[front], np.uint64(front)
        column, width, below, at, ld = (int(record[name]) for name in ("column", "width", "below", "panel_at", "panel_ld"))
        update_at, update_ld, eager = int(record["update_at"]), int(record["update_ld"]), bool(record["eager"])
        tables = (fronts.table, fronts.children, fronts.runs, fronts.entries, fronts.scalar_order)
        numbers = (values, diagonal, self.panels, self.stack)
        begin_front(g, *tables, *numbers, self._entries)
        for k in range(0, width, int(BLOCK)):
            depth = min(int(BLOCK), width - k)
            corner, place = at + k + k * ld, np.uint64(column + k)
            shape = (np.uint64(width + below - k), np.uint64(depth))
            done = int(factor_block(self.panels, np.uint64(corner), np.uint64(ld), *shape, self.inverse, self.pivots, place))
            if done < depth:
                return column + k + done
            behind = corner + depth * (ld + 1)
            rest = width - k - depth
            self._update(self.panels, behind, ld, corner + depth, ld, rest + below, rest, depth, True)
            self._update(self.stack, update_at, update_ld, at + width + k * ld, ld, below, below, depth, k > 0 or eager)
        done = int(end_front(g, *tables, *numbers, self.pivots, self._entries))
        return column + done if done < width else len(self.pivots)

    def _update(self, c: NDArray[np.float64], c_at: int, ldc: int, a_at: int, lda: int, rows: int, columns: int, depth: int,
                accumulate: bool) -> None:  # fmt: skip
        """C ← C - A Aᵀ in the lower triangle, the rows with the longest way to go first."""
        if columns == 0:
            return
        fixed = [np.uint64(x) for x in (c_at, ldc, a_at, lda, columns, depth, accumulate)]

        def work(_: int, begin: int, end: int) -> None:
            update_rows(c, self.panels, *fixed, np.uint64(rows - end), np.uint64(rows - begin))

        run_chunks(work, rows, ROWS, self._threads)
