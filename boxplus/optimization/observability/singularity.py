"""Says why a problem does not determine its variables: from its structure before solving, from its null space after."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.errors import SingularProblemError
from boxplus.optimization.linear_systems.least_squares import LeastSquares, inner
from boxplus.optimization.observability.components import Components
from boxplus.optimization.observability.free_motions import describe_shared
from boxplus.optimization.observability.null_space import NullSpace, find_null_space
from boxplus.optimization.observability.own_motions import describe_own
from boxplus.optimization.observability.variable_names import variable_names
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout
from boxplus.optimization.terms.variables import Variables
from boxplus.sparse.cholesky import NotPositiveDefinite

_SENTENCES = 6  # told before the rest is counted
# A step whose curvature, scaled to a unit diagonal, is below this may be rounding along a free direction.
_SUSPICIOUS = 1e-9


def structural_defects(blocks: Sequence[Variables], groups: Sequence[Group]) -> list[str]:
    """Sentences about free variables that no residual touches, and connected components that nothing ties to the world."""
    layout = Layout(blocks)
    components = Components.of(layout, groups)
    sentences = []
    alone = np.flatnonzero(~components.touched)
    if len(alone):
        sentences.append(f"no residual touches {variable_names(layout, alone)}: fix them, remove them, or measure them")
    has_residual = np.zeros(components.count, dtype=np.bool_)
    np.logical_or.at(has_residual, components.label, components.touched)
    loose = np.flatnonzero(~components.anchored & has_residual)
    if len(loose):
        order = np.argsort(components.label, kind="stable")
        bounds = np.searchsorted(components.label[order], np.stack([loose, loose + 1]))
        for begin, end in bounds.T[:_SENTENCES]:
            names = variable_names(layout, np.sort(order[begin:end]))
            sentences.append(
                f"nothing ties {names} to the world: where the whole lies is arbitrary (fix one of them, or add a prior)"
            )
        if len(loose) > _SENTENCES:
            sentences.append(f"the same holds for {len(loose) - _SENTENCES} more groups of variables that share residuals")
    return sentences


def describe_null_space(problem: LeastSquares, space: NullSpace) -> list[str]:
    """A sentence for every way in which the variables can move freely."""
    sentences = describe_own(problem, space.own)
    for shared in space.shared:
        sentences += describe_shared(problem, shared, space.own)
    if len(sentences) > _SENTENCES:
        sentences = [*sentences[:_SENTENCES], f"and {len(sentences) - _SENTENCES} more free motions"]
    return sentences


def explain_singularity(problem: LeastSquares, error: NotPositiveDefinite | None = None, space: NullSpace | None = None) -> str:
    """What is free at the accepted point: which variables it moves, how, and which residuals see them.

    Args:
        error: that the factorisation raised, for where no direction turns out to be free.
        space: the null space, where it is known already.
    """
    sentences = describe_null_space(problem, space if space is not None else find_null_space(problem))
    if not sentences and error is not None:
        sentences = [
            f"the matrix is not positive definite at {problem.layout.describe(error.block)} (pivot {error.pivot:.3g}), though no "
            "direction is free: the problem is badly scaled; use Levenberg-Marquardt"
        ]
    return "the problem does not determine its variables: " + "; ".join(sentences)


def refuse_singular(problem: LeastSquares) -> None:
    """Refuse a system that was factorised without damping and that only rounding keeps from being singular.

    A solve with a random right-hand side goes along the weakest direction; its curvature comes for the price of that solve.

    Raises:
        SingularProblemError: an unobservable direction was found.
    """
    scale = np.sqrt(problem.system.diagonal)
    right = scale * np.random.default_rng(0).standard_normal(len(scale))
    x = problem.system.solve(right)
    _refuse_if_weak(problem, x, inner(x, right))


def refuse_free_step(problem: LeastSquares, delta: NDArray[np.float64]) -> None:
    """Refuse an undamped step that goes along a direction which only rounding keeps H from being singular in.

    The curvature of a Gauss-Newton step is −gᵀδ, so that the test costs nothing where it passes.

    Raises:
        SingularProblemError: δ (dof,) is such a step.
    """
    _refuse_if_weak(problem, delta, -inner(problem.system.gradient, delta))


def _refuse_if_weak(problem: LeastSquares, direction: NDArray[np.float64], curvature: float) -> None:
    length = inner(direction, problem.system.diagonal * direction)
    if length == 0.0 or curvature > _SUSPICIOUS * length:
        return
    space = find_null_space(problem)
    if not space.is_empty:
        raise SingularProblemError(explain_singularity(problem, space=space))
