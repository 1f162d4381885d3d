"""The rows of residuals that leave a problem, packed for the kernels, and which variables they leave to."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.group import Group
from boxplus.optimization.marginalization.orthogonal_kernels import OWN, STEPS, TOGETHER, add_rows, eliminate_columns
from boxplus.optimization.removal import Masks
from boxplus.optimization.variables import Variables
from boxplus.sparse.counting_sort import order_by

_RANK = 1e-10  # share of a column's length: what is left of it below this is rounding
_NONE = -1
Places = list[NDArray[np.int64]]


@dataclass(frozen=True, slots=True)
class Columns:
    """Which variables the leaving residuals touch, and their columns [leaving together | staying].

    Attributes:
        place: for every block (n,) the column at which each variable begins; −1 where it is held or not touched, OWN for a
            landmark: a leaving variable that shares no residual with another one, and goes alone.
        landmark: for every block (n,) the number of each landmark, −1 for others.
        own: (landmarks,) degrees of freedom of each.
        leaving: columns of the variables that leave together.
        width: of all columns.
        staying: for every block the rows of variables that stay, in the order of their columns.
    """

    place: Places
    landmark: Places
    own: NDArray[np.int64]
    leaving: int
    width: int
    staying: list[NDArray[np.intp]]

    @classmethod
    def of(cls, blocks: Sequence[Variables], groups: Sequence[Group], touched: Masks, gone: Masks) -> Columns:
        """From the residuals `touched` of every group and the variables `gone` of every block."""
        met = [np.zeros(len(block), dtype=np.bool_) for block in blocks]
        for group, chosen in zip(groups, touched, strict=True):
            if chosen.any():
                for c in group.connections:
                    met[c.block.number][c.rows if chosen.all() else c.rows[chosen]] = True
        for block in blocks:
            met[block.number] &= ~block.is_fixed
        alone = _independent(blocks, groups, touched, [m & g for m, g in zip(met, gone, strict=True)])
        place = [np.full(len(block), _NONE) for block in blocks]
        landmark = [np.full(len(block), _NONE) for block in blocks]
        own, end = [np.zeros(0, dtype=np.int64)], 0
        count = 0
        for block, single in zip(blocks, alone, strict=True):
            rows = np.flatnonzero(single)
            place[block.number][rows] = OWN
            landmark[block.number][rows] = count + np.arange(len(rows))
            own.append(np.full(len(rows), block.manifold.dof))
            count += len(rows)
        leaving = 0
        staying = []
        for leaves in (True, False):
            for block in blocks:
                chosen = met[block.number] & (gone[block.number] == leaves) & ~alone[block.number]
                rows = np.flatnonzero(chosen)
                place[block.number][rows] = end + np.arange(len(rows)) * block.manifold.dof
                end += len(rows) * block.manifold.dof
                if not leaves:
                    staying.append(rows)
            leaving = end if leaves else leaving
        return cls(place, landmark, np.concatenate(own), leaving, end, staying)


def _independent(blocks: Sequence[Variables], groups: Sequence[Group], touched: Masks, leaving: Masks) -> Masks:
    """For every block which of its leaving variables share no residual with another such variable, most of them first."""
    alone = [np.zeros(len(block), dtype=np.bool_) for block in blocks]
    for block in sorted(blocks, key=lambda b: -int(leaving[b.number].sum()) * b.manifold.dof):
        candidates = leaving[block.number].copy()
        alone[block.number] = candidates
        for group, chosen in zip(groups, touched, strict=True):
            is_met = any(c.block is block for c in group.connections)
            if is_met and len(group.connections) > 1 and candidates.any() and chosen.any():
                hits = [alone[c.block.number][c.rows] for c in group.connections]
                shared = (np.sum(hits, axis=0) > 1) & chosen
                for c in group.connections:
                    if c.block is block:
                        candidates[c.rows[shared]] = False
    return alone


def _pack(group: Group, chosen: NDArray[np.bool_], columns: Columns, data: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """[J, r] of the chosen residuals into `data`; of each: dim, slots, size, landmark, first column, columns."""
    rows = np.flatnonzero(chosen)
    count = len(rows)
    dofs = np.array([c.block.manifold.dof for c in group.connections])
    packed = data.reshape(count, group.residual.dim, -1)
    end = 0
    for J in group.jacobians:
        packed[:, :, end : end + J.shape[2]] = J if count == len(chosen) else J[rows]
        end += J.shape[2]
    packed[:, :, end] = group.r if count == len(chosen) else group.r[rows]
    at = [c.rows if count == len(chosen) else c.rows[rows] for c in group.connections]
    column = np.stack([columns.place[c.block.number][k] for c, k in zip(group.connections, at, strict=True)], axis=1)
    own = [columns.landmark[c.block.number][k] for c, k in zip(group.connections, at, strict=True) if len(columns.own)]
    landmark = functools.reduce(np.maximum, own, np.full(count, _NONE))
    first = np.where(column >= 0, column, columns.width).min(axis=1)
    return [
        np.full(count, group.residual.dim),
        np.full(count, len(dofs)),
        np.full(count, packed[0].size),
        landmark,
        first,
        np.full(count, dofs.sum()),
        column.reshape(-1),
        np.tile(dofs, count),
    ]


def triangle_of(groups: Sequence[Group], touched: Masks, columns: Columns) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R (w, w + 1) of all rows without their landmarks, residuals in the last column, and (w,) the lengths of the columns."""
    leaving = [(group, chosen) for group, chosen in zip(groups, touched, strict=True) if chosen.any()]
    triangle, squares = np.zeros((columns.width, columns.width + 1)), np.zeros(columns.width)
    if leaving and columns.width:
        sizes = [int(chosen.sum()) * group.residual.dim * (group.tangents + 1) for group, chosen in leaving]
        ends = np.cumsum(sizes)
        data = np.empty(int(ends[-1]))
        parts = [
            _pack(group, chosen, columns, data[end - size : end])
            for (group, chosen), size, end in zip(leaving, sizes, ends, strict=True)
        ]
        dim, slots, size, landmark, first, width, column, dof = (np.concatenate(a) for a in zip(*parts, strict=True))
        # Residuals without a landmark follow the landmarks, each alone.
        single = np.flatnonzero(landmark < 0)
        landmark[single] = len(columns.own) + np.arange(len(single))
        own = np.concatenate([columns.own, np.zeros(len(single), dtype=np.int64)])
        slot = np.concatenate([[0], np.cumsum(slots)])
        step = np.minimum(first * STEPS // columns.width, STEPS - 1)
        residual = order_by(landmark * STEPS + (STEPS - 1 - step), len(own) * STEPS)[0].astype(np.int64)
        begin = np.concatenate([[0], np.cumsum(np.bincount(landmark, minlength=len(own)))])
        rows = np.bincount(landmark, weights=dim, minlength=len(own))
        reach = np.bincount(landmark, weights=width, minlength=len(own))
        work = np.empty(int((rows * (np.minimum(reach, columns.width) + own + 1)).max()))
        at = np.cumsum(size) - size
        add_rows(data, at, dim, slot, column, dof, step, residual, begin, own, _RANK, work, squares, triangle)
    return triangle, np.sqrt(squares)


def prior_of(
    triangle: NDArray[np.float64], lengths: NDArray[np.float64], leaving: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(J, r₀) of the staying columns after the first `leaving` are minimised over; as many rows as there is information."""
    W = np.empty((TOGETHER, len(lengths) + 1))
    A, X = np.ascontiguousarray(triangle[:, :leaving].T), triangle[:, leaving:].copy()
    order = np.empty(len(lengths), dtype=np.int64)
    rank = eliminate_columns(A, X, *X.shape, lengths[:leaving].copy(), _RANK, order, W)
    A, r0 = np.ascontiguousarray(X[rank:, :-1].T), X[rank:, -1:].copy()
    # Against what was measured, so that what cancelled does not come back as information.
    rank = eliminate_columns(A, r0, *r0.shape, lengths[leaving:].copy(), _RANK, order, W)
    J = np.zeros((rank, len(A)))
    J[:, order[: len(A)]] = np.triu(A[:, :rank].T)
    return J, r0[:rank, 0].copy()
