"""Which linear system a problem gets: dense, block-sparse, or with variables eliminated by the Schur complement."""

from __future__ import annotations

from collections.abc import Sequence

from boxplus.errors import InputError
from boxplus.optimization.linear_systems.linear_system import DenseSystem, LinearSystem, SparseSystem
from boxplus.optimization.linear_systems.schur import SchurSystem
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.variables import Variables
from boxplus.sparse.cholesky import Analyses

# Below this many degrees of freedom one dense factorisation is faster than any analysis.
_DENSE_DOF = 150


def choose_system(layout: Layout, groups: Sequence[Group], options: SolverOptions, known: Analyses | None = None) -> LinearSystem:
    """The linear system for `options.linear_solver`; `auto` decides, and the system's description says why.

    Args:
        known: analyses of systems before, one of which is taken over where the matrix to factorise has the same pattern.

    Raises:
        InputError: Schur elimination is asked for where no block of variables can be eliminated.
    """
    wanted = options.linear_solver
    eliminated = _largest_independent(layout, groups)
    if wanted == "schur":
        if eliminated is None:
            raise InputError(
                "a block of variables no two of which share a residual",
                "none",
                "let the solver choose, or put the variables to eliminate into a block of their own",
            )
        return SchurSystem(layout, groups, eliminated, options.threads, known)
    if wanted == "dense" or (wanted == "auto" and layout.dof <= _DENSE_DOF):
        return DenseSystem(layout, groups, options.threads)
    if wanted == "auto" and eliminated is not None and 2 * _free_dof(layout, eliminated) > layout.dof:
        return SchurSystem(layout, groups, eliminated, options.threads, known)
    return SparseSystem(layout, groups, options.threads, known)


def _free_dof(layout: Layout, block: Variables) -> int:
    return int((layout.number[block.number] >= 0).sum()) * block.manifold.dof


def _largest_independent(layout: Layout, groups: Sequence[Group]) -> Variables | None:
    """The block with the most degrees of freedom none of whose variables shares a residual with another of it."""
    candidates = []
    for block in layout.blocks:
        met = max(sum(c.block is block for c in group.connections) for group in groups)
        if met == 1 and 0 < _free_dof(layout, block) < layout.dof:
            candidates.append(block)
    return max(candidates, key=lambda block: _free_dof(layout, block), default=None)
