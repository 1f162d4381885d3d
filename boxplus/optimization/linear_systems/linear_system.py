"""The linear system of a step, H + D, dense or block-sparse; Schur elimination stands in its own file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.linear_systems.dense_kernels import factorize_dense, solve_dense
from boxplus.optimization.linear_systems.normal_equations import NormalEquations
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout
from boxplus.sparse.cholesky import Analyses, Analysis, NotPositiveDefinite, SparseCholesky
from boxplus.sparse.multifrontal import SINGULAR


class LinearSystem(ABC):
    """The linearised problem: analysed once, assembled for every linearisation, solved for every damping.

    Attributes:
        description: which elimination and factorisation, and why, in a sentence.
        gradient: g = Jᵀr (dof,).
        diagonal: of H (dof,).
        reads_jacobians: `factorize` reads the Jacobians of the groups, which must be those that were assembled.
        analysis: of the sparse matrix that is factorised; None where there is none.
    """

    reads_jacobians = False
    analysis: Analysis | None = None
    description: str
    gradient: NDArray[np.float64]
    diagonal: NDArray[np.float64]

    @abstractmethod
    def assemble(self) -> None:
        """Take H and g from the current linearisation of the groups."""

    @abstractmethod
    def factorize(self, damping: NDArray[np.float64] | None) -> None:
        """Factorise H + diag(damping).

        Raises:
            NotPositiveDefinite: the matrix is singular or indefinite; `block` is the number of a free variable.
        """

    @abstractmethod
    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """x (dof,) with (H + diag(damping)) x = right, for the matrix factorised last."""

    def solve_many(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for several right-hand sides (dof, k) at once: where the factor is large that takes less than one by one."""
        return np.stack([self.solve(np.ascontiguousarray(side)) for side in right.T], axis=1)

    @abstractmethod
    def inverse_values(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
        """Blocks (dof of first[k], dof of second[k]) of H⁻¹ for pairs of free variables, after `factorize(None)`.

        One after another in one array, each of them row-major: a Python object a block would cost as much as the blocks.
        """


class DenseSystem(LinearSystem):
    """All of H as one dense matrix, for problems of few degrees of freedom."""

    def __init__(self, layout: Layout, groups: Sequence[Group], threads: int) -> None:
        self._equations = NormalEquations(layout, groups)
        self._layout, self._threads = layout, threads
        self._dense, self._factor = np.zeros((layout.dof, layout.dof)), np.zeros((layout.dof, layout.dof))
        self._places = self._equations.pattern.dense_places()
        self.description = f"dense Cholesky of {layout.dof} degrees of freedom"

    def assemble(self) -> None:
        """See `LinearSystem.assemble`."""
        self._equations.assemble(self._threads)
        self.gradient, self.diagonal = self._equations.gradient, self._equations.diagonal
        self._dense.reshape(-1)[self._places] = self._equations.values

    def factorize(self, damping: NDArray[np.float64] | None) -> None:
        """See `LinearSystem.factorize`."""
        self._factor[:] = self._dense
        if damping is not None:
            self._factor[np.diag_indices_from(self._factor)] += damping
        row = factorize_dense(self._factor, SINGULAR)
        if row < self._layout.dof:
            block = int(np.searchsorted(self._layout.start, row, side="right")) - 1
            raise NotPositiveDefinite(block, row - int(self._layout.start[block]), float(self._factor[row, row]))

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `LinearSystem.solve`."""
        x = right.reshape(-1, 1).copy()
        solve_dense(self._factor, x)
        return x[:, 0]

    def inverse_values(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `LinearSystem.inverse_values`."""
        inverse = np.eye(self._layout.dof)
        solve_dense(self._factor, inverse)
        start = self._layout.start
        pairs = zip(first, second, strict=True)
        return np.concatenate(
            [np.zeros(0), *(inverse[start[i] : start[i + 1], start[j] : start[j + 1]].reshape(-1) for i, j in pairs)]
        )


class SparseSystem(LinearSystem):
    """Block-sparse H, factorised by the supernodal Cholesky."""

    def __init__(self, layout: Layout, groups: Sequence[Group], threads: int, known: Analyses | None = None) -> None:
        self._equations = NormalEquations(layout, groups)
        self._threads = threads
        self._cholesky = SparseCholesky(self._equations.pattern, threads=threads, known=known)
        self.analysis = self._cholesky.analysis
        self.description = (
            f"sparse Cholesky of {layout.dof} degrees of freedom, {self._cholesky.nnz_factor:,} non-zeros in the factor"
        )

    def assemble(self) -> None:
        """See `LinearSystem.assemble`."""
        self._equations.assemble(self._threads)
        self.gradient, self.diagonal = self._equations.gradient, self._equations.diagonal

    def factorize(self, damping: NDArray[np.float64] | None) -> None:
        """See `LinearSystem.factorize`."""
        self._cholesky.factorize(self._equations.values, diagonal=0.0 if damping is None else damping)

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `LinearSystem.solve`."""
        return self._cholesky.solve(right)

    def solve_many(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """See `LinearSystem.solve_many`."""
        return self._cholesky.solve(right)

    def inverse_values(self, first: NDArray[np.int64], second: NDArray[np.int64]) -> NDArray[np.float64]:
        """See `LinearSystem.inverse_values`."""
        return self._cholesky.inverse_values(first, second)
