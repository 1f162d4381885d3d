"""In which tangent the solver moves a pose: its own, or another one in which the problem is far better conditioned.

A pose T_camera_world that turns about the origin of the world, while everything measured lies a million metres from there, moves
what it measures by a million metres times the angle, which its translation has to take back: H loses the digits of the square of
that. The same pose turned about itself has no such trouble. All updates of a pose are related by matrices of determinant one
(`manifolds.tangents.change`), so that by Hadamard's inequality, det H ≤ Π Hᵢᵢ, the tangent with the smallest product of the
diagonal is the best conditioned. The one that the variables were given stays, unless another is better by far; what the user sees
(values, covariances) does not depend on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.manifolds.body_pose import BodyPose
from boxplus.manifolds.manifold import Manifold
from boxplus.manifolds.product import Product
from boxplus.manifolds.se3 import SE3, SE3Left
from boxplus.manifolds.tangents.change import POSES, tangent_change
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.layout import Layout

_GAIN = math.log(1e6)  # of the product of the diagonal, on average over the variables; a lever of about ten
# A rotation about the other frame's axes turns the same lever: `CameraPose` is as well conditioned as `BodyPose`.
_WAYS: tuple[Manifold, ...] = (SE3, SE3Left, BodyPose)
_SAMPLE = 1024  # residuals of a group looked at


def best_tangents(layout: Layout, groups: Sequence[Group], values: Sequence[NDArray[np.float64]]) -> tuple[Manifold, ...]:
    """The manifold by whose ⊞ each block is to be moved, from the current linearisation of the groups at `values`."""
    best = list(layout.tangents)
    for number, current in enumerate(layout.tangents):
        others = [manifold for manifold in _alternatives(current) if manifold != current]
        if not others or layout.blocks[number].is_held is not None:  # components are held in the block's own tangent
            continue
        samples = _samples(layout, groups, number)
        own = _log_diagonal(layout, values[number], number, current, samples)
        gains = [own - _log_diagonal(layout, values[number], number, other, samples) for other in others]
        if max(gains) > _GAIN:
            best[number] = others[int(np.argmax(gains))]
    return tuple(best)


def to_own_tangent(layout: Layout, number: int, x: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """∂δ_own/∂δ_solver (n, dof, dof) at points x (n, size) of a block; None where both are the same."""
    own, tangent = layout.blocks[number].manifold, layout.tangents[number]
    change = tangent_change(own, tangent)
    if change is None:
        return None
    J = np.tile(np.eye(own.dof), (len(x), 1, 1))
    change(0, len(x), np.ascontiguousarray(x), np.arange(len(x), dtype=np.uint32), J)
    return J


def _alternatives(manifold: Manifold) -> list[Manifold]:
    """The same points with every pose moved in each of three ways; none where there is no pose."""
    if manifold in POSES:
        return list(_WAYS)
    if isinstance(manifold, Product) and any(component in POSES for component in manifold.components):
        return [Product(*(pose if part in POSES else part for part in manifold.components)) for pose in _WAYS]
    return []


def _samples(
    layout: Layout, groups: Sequence[Group], number: int
) -> list[tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.uint32]]]:
    """Jacobians for a block, some of the residuals that count, and the variables that these are connected to."""
    block = layout.blocks[number]
    samples = []
    for group in groups:
        for connection, jacobian in zip(group.connections, group.jacobians, strict=True):
            if connection.block is block:
                rows = np.flatnonzero(group.valid & (layout.numbers(connection) >= 0))
                rows = rows[:: max(1, len(rows) // _SAMPLE)]
                samples.append((jacobian, rows, connection.rows[rows]))
    return samples


def _log_diagonal(
    layout: Layout,
    x: NDArray[np.float64],
    number: int,
    tangent: Manifold,
    samples: Sequence[tuple[NDArray[np.float64], NDArray[np.intp], NDArray[np.uint32]]],
) -> float:
    """Mean over the variables of Σ log Hᵢᵢ of their own blocks, were they moved by the ⊞ of `tangent`."""
    diagonal = np.zeros((len(x), tangent.dof))
    change = tangent_change(layout.tangents[number], tangent)
    for jacobian, rows, at in samples:
        J = jacobian[rows]
        if change is not None:
            change(0, len(rows), x, at, J)
        _add_squares(J, at, diagonal)
    able = (diagonal > 0.0).all(axis=1)
    return float(np.log(diagonal[able]).sum(axis=1).mean()) if able.any() else 0.0


@kernel
def _add_squares(J: NDArray[np.float64], at: NDArray[np.uint32], diagonal: NDArray[np.float64]) -> None:
    """diagonal[at[n]] += the squares of the columns of J[n]."""
    for n in range(np.uint64(J.shape[0])):
        k = at[n]
        for row in range(np.uint64(J.shape[1])):
            for c in range(np.uint64(J.shape[2])):
                diagonal[k, c] += J[n, row, c] * J[n, row, c]
