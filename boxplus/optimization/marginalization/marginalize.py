"""Marginalisation: variables leave a problem, what they knew stays as a prior on their neighbours (docs/marginalization.md).

The residuals that touch the leaving variables m are linearised, r + J_m δ_m + J_b δ_b, with their Markov blanket b. Minimising
over δ_m leaves Qᵀ(r + J_b δ_b), Q spanning what J_m cannot reach. Its normal matrix is the Schur complement
H_bb − H_bm H_mm⁺ H_mb, got here from orthogonal factorisations of J, without squaring it: first of every leaving variable that
meets no other one (landmarks), each within its own residuals, then of the rest together (Demmel et al., Square root
marginalization for sliding-window bundle adjustment, ICCV 2021). A direction in which the leaving variables were not determined
takes no information with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus._arguments import require, shown
from boxplus.errors import InputError
from boxplus.optimization.marginalization.leak import Gauge, Leak, leak_of
from boxplus.optimization.marginalization.rows import Columns, prior_of, triangle_of
from boxplus.optimization.problem import Problem
from boxplus.optimization.solution import Solution
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.variables import VariableRows, Variables
from boxplus.residuals.marginal_prior import MarginalPrior


@dataclass(frozen=True, slots=True)
class Marginal:
    """What marginalised variables left behind.

    Attributes:
        prior: the group that was added, its residual a `MarginalPrior`; None where nothing is left to know (no neighbours, or no
            information about them).
        variables: the variables that the prior knows, a selection for every block.
        absorbed: for every group that lost residuals to the prior, by name, how many.
        leak: what the prior claims to know of a gauge; None where none was given.
    """

    prior: Group | None
    variables: tuple[VariableRows, ...]
    absorbed: dict[str, int]
    leak: Leak | None


def marginalize(
    problem: Problem,
    leaving: VariableRows | Variables | Sequence[VariableRows | Variables],
    *,
    at: Solution | Sequence[NDArray[np.float64]] | None,
    gauge: Gauge | None = None,
    first_estimates: bool = True,
) -> Marginal:
    """Take variables out of a problem and leave a prior on those that were measured against them.

    The leaving variables and all residuals that touch them, earlier priors too, are removed; a group with the prior is added. For
    linear residuals minimum and covariances of what stays are those of before, else they are to first order about `at`. Robust
    losses are weighed in as they are there. The time grows with the number of landmarks (leaving variables that share no residual
    with another leaving one), and with the square of the number of columns of the others.

    Args:
        leaving: variables to remove. Of fixed ones, and of held components, the prior knows the values they are held at.
        at: where to linearise, normally the solution just found; the problem takes these values for its own. None for those that
            it has.
        gauge: motions that nothing measures; the prior's leak along them is reported.
        first_estimates: take Jacobians of the variables in the prior at `at` from now on, in this prior and in all residuals
            that touch them, so that no information comes from linearising at two places; residuals are taken where the variables
            are. Off, for linear residuals and for comparison.

    Raises:
        InputError: nothing is selected; variables or values of another problem.

    Example:
        >>> problem = bp.Problem()
        >>> poses = problem.add_variables(bp.SE2, [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]], name="poses")
        >>> known = problem.add_residuals(bp.residuals.Prior(bp.SE2, [0.0, 0.0, 0.0], sigma=0.1), poses[0])
        >>> edges = problem.add_residuals(bp.residuals.RelativePose2D([0.0, 1.0, 0.0], sigma=0.1), poses[0], poses[1])
        >>> before = problem.solve()
        >>> sigma = before.standard_deviations(poses[1])
        >>> marginal = bp.marginalize(problem, poses[0], at=before)  # the older pose leaves, a prior stays
        >>> np.allclose(problem.solve().standard_deviations(poses[1]), sigma)
        True
    """
    require(problem, Problem, "a Problem", "make one with boxplus.Problem()")
    require(gauge, (Gauge, type(None)), "a Gauge or None", "make one with world_gauge")
    chosen = [leaving] if isinstance(leaving, (VariableRows, Variables)) else leaving
    if not (isinstance(chosen, Sequence) and all(isinstance(part, (VariableRows, Variables)) for part in chosen)):
        raise InputError("variables to marginalise", shown(leaving), "select rows of a block, such as poses[[0]]")
    if not any(len(part) for part in chosen):
        raise InputError("variables to marginalise", "none", "select rows of a block, such as poses[[0]]")
    if isinstance(at, Solution) and not at.is_of(problem.blocks):
        raise InputError(
            "a solution of this problem", "that of another one, where its values mean something else", "solve this one"
        )
    if at is not None:
        problem.set_values(at)
    gone, touched = problem.reach_of(chosen)
    values = [block.values for block in problem.blocks]
    is_anchored, some_fixed = False, [bool(block.is_fixed.any()) for block in problem.blocks]
    for group, rows in zip(problem.groups, touched, strict=True):
        if rows.any():
            group.linearize_some(values, rows)
            held = any(some_fixed[c.block.number] and c.block.is_fixed[c.rows[rows]].any() for c in group.connections)
            is_anchored |= group.residual.fixes_gauge or held
    columns = Columns.of(problem.blocks, problem.groups, touched, gone)
    J, r0 = prior_of(*triangle_of(problem.groups, touched, columns), columns.leaving)
    staying = [(b, rows) for b, rows in zip(problem.blocks, columns.staying, strict=True) if len(rows)]
    points = [(block, block.linearized_at(block.values)[rows]) for block, rows in staying]
    moved = [block.manifold.boxminus(block.values[rows], x0) for (block, rows), (_, x0) in zip(staying, points, strict=True)]
    if moved:
        r0 -= (J * np.concatenate([m.reshape(-1) for m in moved])).sum(axis=1)  # r₀ is that of x₀
    variables = tuple(block[block.ids[rows]] for block, rows in staying)
    leak = None if gauge is None else leak_of(J, points, gauge, is_anchored=is_anchored)
    if not len(J):
        return Marginal(None, (), problem.take_out(gone, touched), leak)
    residual = MarginalPrior(
        [block.manifold for block, x0 in points for _ in x0],
        [x for _, x0 in points for x in x0],
        J,
        r0,
        roles=[f"{rows.block.name}[{k}]" for rows in variables for k in rows.ids],
        fixes_gauge=is_anchored,
        keeps_first_estimates=first_estimates,
    )
    absorbed = problem.take_out(gone, touched, prior_follows=True)
    prior = problem.add_residuals(residual, *(single for rows in variables for single in rows.singles()))
    return Marginal(prior, variables, absorbed, leak)
