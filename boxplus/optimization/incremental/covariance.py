"""Covariances of variables of a Bayes tree, in the tangents at the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.incremental.bayes_tree import BayesTree
from boxplus.optimization.incremental.variables import GrowingVariables
from boxplus.optimization.terms.variables import VariableRows


def blocks(tree: BayesTree, rows: VariableRows) -> NDArray[np.float64]:
    """(k, dof, dof) covariance of each variable; zero where it is fixed."""
    ids, change = _to_estimate(tree, rows)
    found = np.zeros_like(change)
    for k in np.flatnonzero(ids >= 0):
        found[k] = tree.inverse_columns(int(ids[k]), ids[k : k + 1])
    found = change @ found @ np.swapaxes(change, 1, 2)
    return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))


def joint(tree: BayesTree, selected: Sequence[VariableRows]) -> NDArray[np.float64]:
    """(D, D) covariance of all variables together, in the order given."""
    parts = [_to_estimate(tree, rows) for rows in selected]
    ids = np.concatenate([own for own, _ in parts])
    change = [one for _, own in parts for one in own]
    begin = np.cumsum([0, *(len(one) for one in change)])
    matrix = np.zeros((int(begin[-1]), int(begin[-1])))
    free = np.flatnonzero(ids >= 0)
    places = np.concatenate([np.arange(begin[k], begin[k + 1]) for k in free] or [np.zeros(0, np.int64)])
    for k in free:
        matrix[places, begin[k] : begin[k + 1]] = tree.inverse_columns(int(ids[k]), ids[free])
    for first, one in zip(begin, change, strict=False):
        here = slice(int(first), int(first) + len(one))
        matrix[here] = one @ matrix[here]
        matrix[:, here] = matrix[:, here] @ one.T
    return np.asarray(0.5 * (matrix + matrix.T))


def _to_estimate(tree: BayesTree, rows: VariableRows) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Numbers in the tree, and (k, dof, dof) from the tangents where variables are linearised to those at their estimates."""
    block = cast(GrowingVariables, rows.block)
    ids, dof = block.numbers[rows.rows], block.manifold.dof
    delta = np.zeros((len(rows), dof))
    delta[ids >= 0] = tree.delta[tree.start[ids[ids >= 0]][:, None] + np.arange(dof)]
    return ids, np.asarray(block.manifold.boxplus_jacobian(block.points[rows.rows], delta))
