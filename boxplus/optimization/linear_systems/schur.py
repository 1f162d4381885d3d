"""Schur elimination: variables that meet no other of their kind are solved for in closed form (docs/least_squares.md).

With E the eliminated variables (the points of a bundle adjustment) and F the kept ones, H = [[F, W], [Wᵀ, C]] and C is
block-diagonal. With C = L Lᵀ and Z = W L⁻ᵀ the reduced matrix is S = F − Z Zᵀ.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import run_chunks
from boxplus.optimization.linear_systems.linear_system import LinearSystem
from boxplus.optimization.linear_systems.normal_equations import Gather, NormalEquations, add_gradient, add_products, piece
from boxplus.optimization.linear_systems.schur_inverse import inverse_values
from boxplus.optimization.linear_systems.schur_kernels import (
    factorize_eliminated,
    reduce_entries,
    solve_eliminated,
    substitute_entries,
    subtract_from_eliminated,
    subtract_from_kept,
)
from boxplus.optimization.linear_systems.schur_structure import (
    Entries,
    Products,
    build_entries,
    build_products,
    eliminated_numbers,
)
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout, connected_numbers
from boxplus.optimization.terms.variables import Variables
from boxplus.sparse.cholesky import Analyses, NotPositiveDefinite, SparseCholesky
from boxplus.sparse.product_tiles import add_sums, tile_of


class SchurSystem(LinearSystem):
    """H with one block of variables eliminated, the rest factorised by the supernodal Cholesky."""

    reads_jacobians = True

    def __init__(
        self, layout: Layout, groups: Sequence[Group], eliminated: Variables, threads: int, known: Analyses | None = None
    ) -> None:
        self._layout, self._threads = layout, threads
        self._rest = layout.without(eliminated)
        own = layout.number[eliminated.number]
        self._first, count, e = int(own[own >= 0][0]), int((own >= 0).sum()), eliminated.manifold.dof
        # The eliminated variables are one block, so their tangents are one piece of the tangent vector.
        begin = int(layout.start[self._first])
        self._own = slice(begin, begin + count * e)
        self._others = np.concatenate([np.arange(begin), np.arange(begin + count * e, layout.dof)])
        self._C, self._L = np.zeros((count, e, e)), np.zeros((count, e, e))
        self._b, self._y = np.zeros((count, e)), np.zeros((count, e))
        self._squares, self._slopes = _gathers_of(layout, groups, eliminated, count, e)
        connected = [connected_numbers(self._rest, group) for group in groups]
        self._equations = NormalEquations(self._rest, groups, connected)
        self._entries = build_entries(layout, self._rest, groups, connected, eliminated, count)
        self._pattern, self._places, self._products = build_products(self._rest, self._equations.pattern, self._entries, count)
        self._values = np.zeros(int(self._pattern.value_start[-1]))
        self._cholesky = SparseCholesky(self._pattern, threads=threads, known=known)
        self.analysis = self._cholesky.analysis
        self.gradient, self.diagonal = np.zeros(layout.dof), np.zeros(layout.dof)
        self.description = (
            f"Schur elimination of {count} {eliminated.name!r} ({e} degrees of freedom each, no residual connects two of them), "
            f"then sparse Cholesky of the {self._rest.dof} degrees of freedom left, {self._cholesky.nnz_factor:,} non-zeros"
        )

    def assemble(self) -> None:
        """See `LinearSystem.assemble`."""
        self._equations.assemble(self._threads)
        self._C[:] = 0.0
        self._b[:] = 0.0
        for gather in self._squares:
            add_products(gather, self._C.reshape(-1), self._threads)
        for gather in self._slopes:
            add_gradient(gather, self._b.reshape(-1), self._threads)
        self.gradient[self._own] = self._b.reshape(-1)
        self.gradient[self._others] = self._equations.gradient
        self.diagonal[self._own] = np.einsum("nii->ni", self._C).reshape(-1)
        self.diagonal[self._others] = self._equations.diagonal

    def factorize(self, damping: NDArray[np.float64] | None) -> None:
        """See `LinearSystem.factorize`."""
        self._eliminate(np.zeros(0) if damping is None else damping[self._own])
        self._reduce()
        try:
            self._cholesky.factorize(self._values, diagonal=0.0 if damping is None else damping[self._others])
        except NotPositiveDefinite as error:
            number = error.block if error.block < self._first else error.block + len(self._C)
            raise NotPositiveDefinite(number, error.component, error.pivot) from error

    def _eliminate(self, damping: NDArray[np.float64]) -> None:
        """C + D = L Lᵀ and Z = W L⁻ᵀ, W straight from the Jacobians: it is never stored."""
        size = piece(len(self._C), self._threads)
        failed = np.full(max(1, -(-len(self._C) // size)), -1, dtype=np.int64)

        def invert(chunk: int, begin: int, end: int) -> None:
            failed[chunk] = factorize_eliminated(begin, end, self._C, damping, self._L)

        run_chunks(invert, len(self._C), size, self._threads)
        if (failed >= 0).any():
            row = int(failed[failed >= 0][0])
            raise NotPositiveDefinite(self._first + row, 0, float(np.linalg.eigvalsh(self._C[row])[0]))
        for entries in self._entries:
            if len(entries.gathers) == 1:
                self._reduce_entries(entries, entries.gathers[0])
            else:
                self._add_and_substitute(entries)

    def _reduce_entries(self, entries: Entries, gather: Gather) -> None:
        """Z of entries that all come from one group."""
        Je, Jf = gather.group.jacobians[gather.a], gather.group.jacobians[gather.b]
        tile = tile_of(Je.shape[1], Je.shape[2], Jf.shape[2])

        def work(first: int, last: int) -> None:
            begin, residual, order, eliminated = gather.begin, gather.residual, entries.order, entries.eliminated
            reduce_entries(tile, first, last, order, begin, residual, Je, Jf, eliminated, self._L, entries.Z)

        self._run(len(entries.eliminated), work)

    def _add_and_substitute(self, entries: Entries) -> None:
        """Z of entries to which several groups add."""
        entries.Z[:] = 0.0
        for gather in entries.gathers:
            add_products(gather, entries.Z.reshape(-1), self._threads)
        self._run(len(entries.eliminated), substitute_entries, entries.eliminated, self._L, entries.Z)

    def _reduce(self) -> None:
        """S = F − Z Zᵀ."""
        self._values[:] = 0.0
        self._values[self._places] = self._equations.values
        for products in self._products:
            self._subtract(products)

    def _subtract(self, k: Products) -> None:
        tile = tile_of(k.a.Z.shape[1], k.a.dof, k.b.dof)

        def work(first: int, last: int) -> None:
            add_sums(tile, -1.0, first, last, k.target, k.begin, k.entry_a, k.entry_b, k.a.Z, k.b.Z, self._values)

        self._run(len(k.target), work)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `LinearSystem.solve`."""
        y, reduced = self._y, right[self._others]
        y[:] = right[self._own].reshape(y.shape)
        self._substitute(y, transposed=False)
        for k in self._entries:
            self._run(len(k.start), subtract_from_kept, k.start, k.begin, k.eliminated, k.Z, y, reduced)
        kept = self._cholesky.solve(reduced)
        for k in self._entries:
            self._run(len(y), subtract_from_eliminated, k.of_eliminated, k.order, k.start_of_entry, k.Z, kept, y)
        self._substitute(y, transposed=True)
        x = np.empty_like(right)
        x[self._own], x[self._others] = y.reshape(-1), kept
        return x

    def _substitute(self, y: NDArray[np.float64], *, transposed: bool) -> None:
        self._run(len(y), solve_eliminated, self._L, transposed, y)

    def _run(self, items: int, run: Callable[..., None], *arguments: object) -> None:
        """Call `run(first, last, *arguments)` over pieces of `items` whose results do not depend on each other."""
        run_chunks(lambda _, first, last: run(first, last, *arguments), items, piece(items, self._threads), self._threads)

    def inverse_values(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `LinearSystem.inverse_values`."""
        end = self._first + len(self._C)
        if ((first < self._first) | (first >= end)).all() and ((second < self._first) | (second >= end)).all():
            return self._inverse_of_kept(first, second)
        return inverse_values(
            first, second, self._layout.sizes, self._first, self._L, self._entries, self._kept_inverse, self._threads
        )

    def _kept_inverse(self, i: NDArray[np.int64], j: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Sizes and values of the blocks of S⁻¹ for pairs of kept variables, by their numbers among these."""
        sizes = self._rest.sizes
        return sizes[i] * sizes[j], self._cholesky.inverse_values(i, j)

    def _inverse_of_kept(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
        """Blocks of S⁻¹, which is the inverse of H between kept variables; symmetric on the diagonal."""
        i, j = (np.where(k < self._first, k, k - len(self._C)) for k in (first, second))
        sizes, values = self._kept_inverse(i, j)
        own, begin = np.flatnonzero(i == j), np.cumsum(sizes) - sizes
        for size in np.unique(sizes[own]):
            dof = math.isqrt(size)
            at = begin[own[sizes[own] == size], None] + np.arange(size)
            blocks = values[at].reshape(-1, dof, dof)
            values[at] = (0.5 * blocks + 0.5 * np.swapaxes(blocks, 1, 2)).reshape(-1, size)
        return values


def _gathers_of(
    layout: Layout, groups: Sequence[Group], eliminated: Variables, count: int, e: int
) -> tuple[list[Gather], list[Gather]]:
    """The residuals that add to C, and to the gradient, of each eliminated variable."""
    squares, slopes = [], []
    for group in groups:
        found = eliminated_numbers(layout, eliminated, group)
        if found is None:
            continue
        slot, number = found
        selected = np.flatnonzero(number >= 0)
        slope = Gather.sorted_by(group, slot, slot, number[selected], np.arange(count) * e, selected)
        slopes.append(slope)
        squares.append(replace(slope, target=slope.target * e))
    return squares, slopes
