"""The covariance of an estimate some of whose residuals were counted for less than they are worth.

Residuals with square-root information counted w ≤ 1 times give H = Σ w JᵀJ and, as their noise is what it is and not what it was
counted for, the covariance

    Σ = H⁻¹ M H⁻¹,        M = Σ w² JᵀJ ≤ H.

H⁻¹ would claim √(1/w) times too much. Blocks of a product of three need the whole inverse; but with H(ε) = H + ε M, which is the
same problem with residuals counted w (1 + ε w) times,

    Σ = −d/dε H(ε)⁻¹ at 0  ≈  (H(−ε)⁻¹ − H(ε)⁻¹) (1 − ε²) / 2ε,

blocks of two inverses. It is exact where all w are 1, never negative, and off by ε² at most (docs/refinement.md).

Source: Huber, The Behavior of Maximum Likelihood Estimates under Nonstandard Conditions, 1967 (the product of three).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.solver_options import SolverOptions
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import Variables

Floats = NDArray[np.float64]

_STEP = 0.1


def covariances_of(
    problem: Problem,
    solution: Solution,
    blocks: Sequence[Variables],
    counted: Mapping[Group, Floats],
    held: Mapping[Group, Floats],
    options: SolverOptions,
    *,
    is_determined: bool = False,
) -> list[Floats]:
    """(n, dof, dof) of the variables of each block at a solution.

    Args:
        counted: (N,) w of the residuals of groups that have been counted for less than they are worth; of others it is 1.
        held: (N,) weights that groups have in the problem for other reasons.
        options: that it was solved with.
        is_determined: the problem determines all of its variables; a free one is looked for only where H cannot be factorised.
    """
    if all(bool((w == 1.0).all()) for w in counted.values()):
        return [solution.covariance(x, is_determined=is_determined) for x in blocks]
    sides = []
    for step in (-_STEP, _STEP):
        for group in problem.groups:
            one = np.ones(group.residual.count)
            problem.set_weights(group, held.get(group, one) * (1.0 + step * counted.get(group, one)))
        there = problem.solve(options.model_copy(update={"max_iterations": 0}), start=solution)
        sides.append([there.covariance(x, is_determined=is_determined) for x in blocks])
    for group in problem.groups:  # the solution is asked again under the weights that it was found with
        problem.set_weights(group, held.get(group))
    return [(less - more) * ((1.0 - _STEP**2) / (2.0 * _STEP)) for less, more in zip(*sides, strict=True)]
