"""Covariance of variables at a solution: blocks of H⁻¹, in their tangents."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import InputError, SingularProblemError
from boxplus.optimization.cholesky import NotPositiveDefinite
from boxplus.optimization.least_squares import LeastSquares, Values
from boxplus.optimization.singularity import explain_singularity, null_space
from boxplus.optimization.variables import VariableRows


def covariance_blocks(problem: LeastSquares, values: Values, first: VariableRows, second: VariableRows) -> NDArray[np.float64]:
    """Blocks (k, dof, dof) of H⁻¹ at `values` for pairs of variables; zero where one of them is fixed.

    Raises:
        InputError: `first` and `second` differ in length.
        SingularProblemError: H has a null space: the covariance of what it touches is infinite.
    """
    if len(first) != len(second):
        raise InputError("as many second variables as first ones", f"{len(first)} and {len(second)}", "pair them")
    if problem.values is not values:
        problem.start(values)
    try:
        directions, _ = null_space(problem)
        if directions.shape[1]:
            raise SingularProblemError(explain_singularity(problem))
        problem.system.factorize(None)
    except NotPositiveDefinite as error:
        raise SingularProblemError(explain_singularity(problem, error)) from error
    i, j = problem.layout.numbers(first), problem.layout.numbers(second)
    blocks = np.zeros((len(first), first.block.manifold.dof, second.block.manifold.dof))
    free = np.flatnonzero((i >= 0) & (j >= 0))
    for k, block in zip(free, problem.system.inverse_blocks(i[free], j[free]), strict=True):
        blocks[k] = block
    return blocks
