"""Sparse Cholesky factorisation of a block matrix: analyse once, factorise and solve many times."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import BoxplusError, InputError
from boxplus.sparse.block_matrix import BlockPattern
from boxplus.sparse.inverse_blocks import SelectedInverse, locate_blocks, split_blocks
from boxplus.sparse.numeric_factor import NumericFactor
from boxplus.sparse.orderings.ordering import Method, order
from boxplus.sparse.supernodes import Fronts, lay_out
from boxplus.sparse.triangular_solve import solve_many, solve_one

_MOST_KEPT, _SMALL = 8, 1000  # analyses, and variables of a matrix; of larger ones the last alone
SOLVED_VARIABLES = 8
"""Covariances with up to so many variables are solved for, those with more come from a selected inversion."""


class NotPositiveDefinite(BoxplusError, ArithmeticError):
    """A matrix has no Cholesky factor: a variable is not determined, or a weight has the wrong sign.

    Attributes:
        block: the variable (block row) at which the elimination failed.
        component: its degree of freedom, from 0.
        pivot: what was left on the diagonal there; not positive, not finite, or below the rounding of its diagonal entry.
    """

    def __init__(self, block: int, component: int, pivot: float) -> None:
        super().__init__(
            "expected a positive definite matrix – "
            f"got the pivot {pivot:.3g} at degree of freedom {component} of variable {block} – "
            "fix or measure what leaves this variable free, or add damping"
        )
        self.block = block
        self.component = component
        self.pivot = pivot


@dataclass(frozen=True, slots=True)
class Analysis:
    """The symbolic part of a factorisation, which does not depend on the values.

    Attributes:
        pattern: of the matrix.
        ordering: name of the method, None where the ordering was given.
        threads: it was made for.
        fronts: the result.
    """

    pattern: BlockPattern
    ordering: Method | None
    threads: int
    fronts: Fronts

    def holds_for(self, pattern: BlockPattern, ordering: Method | NDArray[np.int64], threads: int) -> bool:
        """Whether an analysis of this pattern would give the same."""
        own = self.pattern
        return (
            isinstance(ordering, str)
            and (self.ordering, self.threads) == (ordering, threads)
            and np.array_equal(own.sizes, pattern.sizes)
            and np.array_equal(own.col_start, pattern.col_start)
            and np.array_equal(own.row, pattern.row)
        )


class Analyses:
    """The last analyses, for problems that change and whose patterns come again, as those of a window do frame by frame."""

    def __init__(self) -> None:
        self._kept: list[Analysis] = []  # the latest first

    def find(self, pattern: BlockPattern, ordering: Method | NDArray[np.int64], threads: int) -> Analysis | None:
        """That of this pattern, ordering and number of threads, where it is one of the last."""
        for k, analysis in enumerate(self._kept):
            if analysis.holds_for(pattern, ordering, threads):
                self._kept.insert(0, self._kept.pop(k))
                return analysis
        return None

    def keep(self, analysis: Analysis) -> None:
        """Remember one that was made anew."""
        most = _MOST_KEPT if len(analysis.pattern.sizes) <= _SMALL else 1
        self._kept = [analysis, *self._kept][:most]


class SparseCholesky:
    """L Lᵀ = P H Pᵀ for symmetric positive definite H with the given pattern.

    The constructor orders and analyses; `factorize` takes new values any number of times and allocates nothing. One object
    must not be used by two threads at once. Results are the same bits on every run and for any number of threads.

    Args:
        pattern: of H.
        ordering: name of the fill-reducing ordering, or (n,) integers: the variable at each position.
        threads: that factorise subtrees and large fronts side by side; too small a matrix is left to one.
        known: analyses of matrices before, one of which is taken over where pattern, ordering and threads are the same; what is
            analysed anew is added.

    Raises:
        InputError: an ordering that is no permutation of the variables, or no thread.

    Example:
        >>> from boxplus.sparse.block_matrix import BlockPattern
        >>> pattern, _ = BlockPattern.from_pairs([1, 1], [1], [0])  # two variables of one degree of freedom, coupled
        >>> cholesky = bp.SparseCholesky(pattern)
        >>> cholesky.factorize([4.0, 2.0, 3.0])  # [[4, 2], [2, 3]]
        >>> cholesky.solve([8.0, 7.0]).round(6)
        array([1.25, 1.5 ])
    """

    def __init__(
        self,
        pattern: BlockPattern,
        *,
        ordering: Method | NDArray[np.int64] = "auto",
        threads: int = 1,
        known: Analyses | None = None,
    ) -> None:
        if threads < 1:
            raise InputError("at least one thread", f"{threads}", "give the number of threads")
        self.pattern = pattern
        analysis = None if known is None else known.find(pattern, ordering, threads)
        if analysis is None:
            method = ordering if isinstance(ordering, str) else None
            analysis = Analysis(pattern, method, threads, _analysed(pattern, ordering, threads))
            if known is not None and method is not None:
                known.keep(analysis)
        self.analysis = analysis
        self._fronts = fronts = analysis.fronts
        size = int(pattern.start[-1])
        self._factor, self._diagonal = NumericFactor(fronts, threads), np.zeros(size)
        self._most_below = int(fronts.table["below"].max())
        self._work, self._below = np.empty(size), np.empty(self._most_below)
        self._factorized = False
        self._selected: SelectedInverse | None = None

    @property
    def permutation(self) -> NDArray[np.int64]:
        """(n,) variable at each position of the elimination order."""
        return self._fronts.order

    @property
    def front_count(self) -> int:
        """Number of supernodes."""
        return len(self._fronts.table) - 1

    @property
    def nnz_factor(self) -> int:
        """Stored elements of L: its nonzeros and the zeros that merging columns into supernodes brings."""
        width, below = self._front_sizes
        return int((width * (width + 1) // 2 + width * below).sum())

    @property
    def flops(self) -> float:
        """Multiplications and additions of one factorisation."""
        width, below = self._front_sizes.astype(np.float64)
        return float((width**3 / 3 + width**2 * below + width * below**2).sum())

    @property
    def _front_sizes(self) -> NDArray[np.int64]:
        table = self._fronts.table[:-1]
        return np.stack([table["width"], table["below"]]).astype(np.int64)

    def factorize(self, values: ArrayLike, *, diagonal: ArrayLike = 0.0) -> None:
        """Factorise H + diag(diagonal).

        Args:
            values: values of the pattern's blocks, float64.
            diagonal: a number or (N,) numbers that are added to the diagonal (damping); `values` stay as they are.

        Raises:
            InputError: another number of values.
            NotPositiveDefinite: naming the variable whose pivot is not positive and finite, or only so by rounding.
        """
        values = np.ascontiguousarray(values, np.float64)
        if values.shape != (self.pattern.value_start[-1],):
            raise InputError(
                f"{self.pattern.value_start[-1]} values",
                f"shape {values.shape}",
                "give the values of all blocks, one after another",
            )
        fronts = self._fronts
        self._diagonal[:] = diagonal
        self._factorized, self._selected = False, None
        failed = self._factor.factorize(values, self._diagonal)
        if failed < len(self._factor.pivots):
            row = int(fronts.scalar_order[failed])
            block = int(np.searchsorted(self.pattern.start, row, side="right")) - 1
            raise NotPositiveDefinite(block, row - int(self.pattern.start[block]), float(self._factor.pivots[failed]))
        self._factorized = True

    def solve(self, b: ArrayLike) -> NDArray[np.float64]:
        """x with H x = b for one right-hand side (N,) or several (N, k).

        Raises:
            InputError: another number of rows, or nothing is factorised.
        """
        self._require_factor()
        b = np.ascontiguousarray(b, np.float64)
        if b.ndim not in (1, 2) or len(b) != len(self._factor.pivots):
            raise InputError(
                f"a right-hand side of {len(self._factor.pivots)} rows", f"shape {b.shape}", "give (N,) or (N, k) numbers"
            )
        fronts = self._fronts
        sides = b.size // max(len(b), 1)
        if sides * len(b) > len(self._work):
            self._work, self._below = np.empty(sides * len(b)), np.empty(sides * self._most_below)
        x = np.empty_like(b)
        panels = (fronts.table, fronts.rows, fronts.scalar_order, self._factor.panels, self._factor.inverse)
        if sides == 1:
            solve_one(*panels, b.reshape(-1), self._work, self._below, x.reshape(-1))
        else:
            solve_many(*panels, b.reshape(-1), np.uint64(sides), self._work, self._below, x.reshape(-1))
        return x

    def inverse_blocks(self, i: ArrayLike, j: ArrayLike) -> list[NDArray[np.float64]]:
        """Blocks of the inverse of H: the covariances of pairs of variables when H is an information matrix.

        A few variables are solved for; many are taken from one selected inversion, which is kept until the next
        factorisation. Pairs outside the factor's pattern are always solved for, once for each of the second variables.

        Args:
            i: (m,) variables, rows of the blocks.
            j: (m,) variables, columns.

        Returns:
            m arrays, `(sizes[i], sizes[j])`.

        Raises:
            InputError: a variable out of range, arrays of different lengths, or nothing is factorised.
        """
        i, j = (np.atleast_1d(np.asarray(a, np.int64)) for a in (i, j))
        values, sizes = self.inverse_values(i, j), self.pattern.sizes
        return split_blocks(values, sizes[i], sizes[j])

    def inverse_values(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.float64]:
        """What `inverse_blocks` gives, as one array: block after block, each of them row-major."""
        self._require_factor()
        n = len(self.pattern.sizes)
        if i.shape != j.shape or i.ndim != 1 or (len(i) and (min(i.min(), j.min()) < 0 or max(i.max(), j.max()) >= n)):
            raise InputError(f"pairs of variables from 0 to {n - 1}", f"{i} and {j}", "give two flat arrays of the same length")
        start, sizes = self.pattern.start, self.pattern.sizes
        ends = np.cumsum(sizes[i] * sizes[j])
        found = np.empty(int(ends[-1]) if len(ends) else 0)
        place = np.full(len(i), -1)
        if self._selected is not None or len(np.unique(j)) > SOLVED_VARIABLES:
            place = locate_blocks(self._fronts, i, j)
        solved = np.flatnonzero(place < 0)
        if len(solved) < len(i):
            if self._selected is None:
                self._selected = SelectedInverse(self._fronts, self._factor.panels, self._factor.inverse, self._factor.stack)
            self._selected.read(place, i, j, found)
        for column in np.unique(j[solved]):
            unit = np.zeros((len(self._factor.pivots), sizes[column]))
            unit[start[column] : start[column + 1]] = np.eye(sizes[column])
            x = self.solve(unit)
            for k in solved[j[solved] == column]:
                block = x[start[i[k]] : start[i[k] + 1]]
                found[ends[k] - block.size : ends[k]] = block.reshape(-1)
        return found

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of H.

        Raises:
            InputError: nothing is factorised.
        """
        self._require_factor()
        return float(np.log(self._factor.pivots).sum())

    def _require_factor(self) -> None:
        if not self._factorized:
            raise InputError("a factorised matrix", "none, or one that is not positive definite", "call factorize first")


def _analysed(pattern: BlockPattern, ordering: Method | NDArray[np.int64], threads: int) -> Fronts:
    """The fronts of a pattern in an ordering that is checked, or found by the method named."""
    if isinstance(ordering, str):
        return lay_out(pattern, order(pattern.col_start, pattern.row, pattern.sizes, ordering).permutation, threads)
    first = np.asarray(ordering, np.int64)
    if not np.array_equal(np.sort(first), np.arange(len(pattern.sizes))):
        raise InputError(f"a permutation of 0 … {len(pattern.sizes) - 1}", f"{first}", "give every variable its place once")
    return lay_out(pattern, first, threads)
