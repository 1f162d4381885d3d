"""Says why a problem does not determine its variables: from its structure before solving, from its null space after."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.cholesky import NotPositiveDefinite
from boxplus.optimization.group import Group
from boxplus.optimization.layout import Layout, connected_numbers
from boxplus.optimization.least_squares import LeastSquares
from boxplus.optimization.variables import Variables

_LISTED = 5  # variables named before the rest is counted
# A direction is unobservable when its curvature, scaled to a unit diagonal, is below this.
_NULL = 1e-10
_SUBSPACE = 12  # directions searched for at once
_ROUNDS = 4


def structural_defects(blocks: Sequence[Variables], groups: Sequence[Group]) -> list[str]:
    """Sentences about free variables that no residual touches, and connected components that nothing ties to the world."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    layout = Layout(blocks)
    count = len(layout.sizes)
    touched = np.zeros(count, dtype=np.bool_)
    anchored = np.zeros(count, dtype=np.bool_)
    edges: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for group in groups:
        numbers = connected_numbers(layout, group)
        any_fixed = np.any([number < 0 for number in numbers], axis=0)
        for number in numbers:
            free = number >= 0
            touched[number[free]] = True
            anchored[number[free & (any_fixed | group.residual.fixes_gauge)]] = True
        for a, b in pairwise(numbers):
            both = (a >= 0) & (b >= 0)
            edges.append((a[both], b[both]))
        if len(numbers) > 2:
            both = (numbers[0] >= 0) & (numbers[-1] >= 0)
            edges.append((numbers[0][both], numbers[-1][both]))
    sentences = []
    alone = np.flatnonzero(~touched)
    if len(alone):
        sentences.append(f"no residual touches {_name(layout, alone)}: fix them, remove them, or measure them")
    if count:
        rows = np.concatenate([a for a, _ in edges]) if edges else np.zeros(0, dtype=np.int64)
        columns = np.concatenate([b for _, b in edges]) if edges else np.zeros(0, dtype=np.int64)
        graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(count, count))
        components, label = connected_components(graph, directed=False)
        has_anchor = np.zeros(components, dtype=np.bool_)
        np.logical_or.at(has_anchor, label, anchored)
        has_residual = np.zeros(components, dtype=np.bool_)
        np.logical_or.at(has_residual, label, touched)
        for component in np.flatnonzero(~has_anchor & has_residual):
            members = np.flatnonzero(label == component)
            sentences.append(
                f"nothing ties {_name(layout, members)} to the world, only to each other: "
                "fix one of them or add a prior, else where the whole lies is arbitrary"
            )
    return sentences


def explain_singularity(problem: LeastSquares, error: NotPositiveDefinite | None = None) -> str:
    """A sentence for every unobservable direction at the accepted point: which variables it moves, and how."""
    layout = problem.layout
    sentences = structural_defects(layout.blocks, problem.groups)
    directions, curvature = null_space(problem)
    for k in range(directions.shape[1]):
        sentences.append(_describe(layout, directions[:, k], float(curvature[k])))
    if not sentences and error is not None:
        sentences.append(
            f"the matrix is not positive definite at {layout.describe(error.block)} (pivot {error.pivot:.3g}), though no "
            "direction is free: the problem is badly scaled; use Levenberg-Marquardt"
        )
    return "the problem does not determine its variables: " + "; ".join(sentences)


def null_space(problem: LeastSquares) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unobservable directions at the accepted point.

    Found by inverse iteration on H scaled to a unit diagonal, with a small multiple of the identity added.

    Returns:
        (dof, m) directions in the tangent space, of unit length when scaled by √diag(H); (m,) their scaled curvatures.
    """
    problem.linearize(problem.values)
    diagonal = problem.system.diagonal
    largest = float(diagonal.max(initial=0.0))
    scale = np.sqrt(np.maximum(diagonal, 1e-12 * largest if largest > 0.0 else 1.0))
    width = min(_SUBSPACE, len(scale))
    basis = np.linalg.qr(np.random.default_rng(0).standard_normal((len(scale), width)))[0]
    problem.system.factorize(1e-9 * scale * scale)
    for _ in range(_ROUNDS):
        basis = np.column_stack([scale * problem.system.solve(scale * basis[:, k]) for k in range(width)])
        basis = np.linalg.qr(basis)[0]
    products = [problem.product(basis[:, k] / scale) for k in range(width)]
    curvature, rotation = np.linalg.eigh(np.array([[float(a @ b) for b in products] for a in products]))
    free = curvature < _NULL
    return (basis @ rotation[:, free]) / scale[:, None], curvature[free]


def _describe(layout: Layout, direction: NDArray[np.float64], curvature: float) -> str:
    """`rotation z [rad] of poses[3], poses[4] … is unconstrained`."""
    share = np.abs(direction) / np.abs(direction).max()
    variable = np.repeat(np.arange(len(layout.sizes)), layout.sizes)
    moved = np.unique(variable[share > 0.1])
    names: dict[str, float] = {}
    for block, numbers in zip(layout.blocks, layout.number, strict=True):
        own = np.flatnonzero(numbers >= 0)
        if not len(own):
            continue
        begin = layout.start[numbers[own[0]]]
        part = direction[begin : begin + len(own) * block.manifold.dof].reshape(len(own), -1)
        for axis, name in enumerate(block.manifold.tangent_names):
            weight = float(np.abs(part[:, axis]).max() / np.abs(direction).max())
            if weight > 0.1:
                sign = float(np.sign(part[np.argmax(np.abs(part[:, axis])), axis]))
                names[f"{name} of {block.name}"] = sign * weight
    how = ", ".join(f"{weight:+.2f} {name}" for name, weight in sorted(names.items(), key=lambda item: -abs(item[1])))
    return f"{_name(layout, moved)} can move freely along ({how}), curvature {curvature:.1e} of its scale"


def _name(layout: Layout, numbers: NDArray[np.int64]) -> str:
    named = ", ".join(layout.describe(int(number)) for number in numbers[:_LISTED])
    return named if len(numbers) <= _LISTED else f"{named} and {len(numbers) - _LISTED} more variables"
