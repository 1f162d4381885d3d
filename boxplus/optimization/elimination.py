"""Which linear system a problem gets: dense, block-sparse, or with variables eliminated by the Schur complement."""

from __future__ import annotations

from collections.abc import Sequence

from boxplus.optimization.group import Group
from boxplus.optimization.layout import Layout
from boxplus.optimization.linear_system import DenseSystem, LinearSystem, SparseSystem
from boxplus.optimization.solver_options import SolverOptions

# Below this many degrees of freedom one dense factorisation is faster than any analysis.
_DENSE_DOF = 150


def choose_system(layout: Layout, groups: Sequence[Group], options: SolverOptions) -> LinearSystem:
    """The linear system for `options.linear_solver`; `auto` decides, and the system's description says why."""
    if options.linear_solver == "dense" or (options.linear_solver == "auto" and layout.dof <= _DENSE_DOF):
        return DenseSystem(layout, groups, options.threads)
    return SparseSystem(layout, groups, options.threads)
