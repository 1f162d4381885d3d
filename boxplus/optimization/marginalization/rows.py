"""The rows of residuals that leave a problem, packed for the kernels, and which variables they leave to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.marginalization.orthogonal_kernels import OWN, STEPS, TOGETHER, add_rows, copy_rows, eliminate_columns
from boxplus.optimization.terms.group import Group
from boxplus.optimization.terms.removal import Masks
from boxplus.optimization.terms.variables import Variables
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
        has_landmarks: for every block whether any of its variables are landmarks.
    """

    place: Places
    landmark: Places
    own: NDArray[np.int64]
    leaving: int
    width: int
    staying: list[NDArray[np.intp]]
    has_landmarks: list[bool]

    @classmethod
    def of(cls, blocks: Sequence[Variables], groups: Sequence[Group], touched: Masks, gone: Masks) -> Columns:
        """From the residuals `touched` of every group and the variables `gone` of every block."""
        met = [np.zeros(len(block), dtype=np.bool_) for block in blocks]
        for group, chosen in zip(groups, touched, strict=True):
            if chosen.any():
                every = chosen.all()
                for c in group.connections:
                    met[c.block.number][c.rows if every else c.rows[chosen]] = True
        for block in blocks:
            met[block.number] &= ~block.is_fixed
        alone = _independent(blocks, groups, touched, [m & g for m, g in zip(met, gone, strict=True)])
        place = [np.full(len(block), _NONE) for block in blocks]
        landmark = [np.full(len(block), _NONE) for block in blocks]
        own, end = [np.zeros(0, dtype=np.int64)], 0
        count = 0
        # The many first: what the few others leave, velocities among them, may reach further across the columns.
        for block in sorted(blocks, key=lambda b: -int(np.count_nonzero(alone[b.number]))):
            rows = np.flatnonzero(alone[block.number])
            place[block.number][rows] = OWN
            landmark[block.number][rows] = count + np.arange(len(rows))
            own.append(np.full(len(rows), block.manifold.dof))
            count += len(rows)
        leaving = 0
        staying = []
        has_landmarks = [bool(single.any()) for single in alone]
        for leaves in (True, False):
            for block in blocks:
                chosen = met[block.number] & (gone[block.number] == leaves) & ~alone[block.number]
                rows = np.flatnonzero(chosen)
                place[block.number][rows] = end + np.arange(len(rows)) * block.manifold.dof
                end += len(rows) * block.manifold.dof
                if not leaves:
                    staying.append(rows)
            leaving = end if leaves else leaving
        return cls(place, landmark, np.concatenate(own), leaving, end, staying, has_landmarks)


def _independent(blocks: Sequence[Variables], groups: Sequence[Group], touched: Masks, leaving: Masks) -> Masks:
    """For every block which of its leaving variables share no residual with another such variable, most of them first."""
    alone = [np.zeros(len(block), dtype=np.bool_) for block in blocks]
    single = [False] * len(blocks)  # whether any of the block are candidates
    for block in sorted(blocks, key=lambda b: -int(leaving[b.number].sum()) * b.manifold.dof):
        if not leaving[block.number].any():
            continue
        candidates = leaving[block.number].copy()
        alone[block.number] = candidates
        single[block.number] = True
        for group, chosen in zip(groups, touched, strict=True):
            if not any(c.block is block for c in group.connections):
                continue
            hits = [alone[c.block.number][c.rows] for c in group.connections if single[c.block.number]]
            if len(hits) > 1 and chosen.any():
                before, shared = hits[0].copy(), np.zeros(len(chosen), dtype=np.bool_)
                for hit in hits[1:]:
                    shared |= before & hit
                    before |= hit
                shared &= chosen
                for c in group.connections:
                    if c.block is block:
                        candidates[c.rows[shared]] = False
    return alone


def _pack(
    group: Group, chosen: NDArray[np.bool_], columns: Columns, data: NDArray[np.float64], column: NDArray[np.int64]
) -> NDArray[np.int64]:
    """[J, r] of the chosen residuals into `data` and the columns (n, slots) of their variables; (n,) their landmarks."""
    every = len(column) == len(chosen)
    rows = np.flatnonzero(chosen)
    packed = data.reshape(len(rows), group.residual.dim, -1)
    end = 0
    for J in group.jacobians:
        copy_rows(J, rows, end, packed)
        end += J.shape[2]
    packed[:, :, end] = group.r if every else group.r[rows]
    landmark = np.full(len(rows), _NONE)
    for slot, c in enumerate(group.connections):
        at = c.rows if every else c.rows[rows]
        column[:, slot] = columns.place[c.block.number][at]
        if columns.has_landmarks[c.block.number]:
            np.maximum(landmark, columns.landmark[c.block.number][at], out=landmark)
    return landmark


def triangle_of(groups: Sequence[Group], touched: Masks, columns: Columns) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R (w, w + 1) of all rows without their landmarks, residuals in the last column, and (w,) the lengths of the columns."""
    leaving = [(group, chosen, int(np.count_nonzero(chosen))) for group, chosen in zip(groups, touched, strict=True)]
    leaving = [part for part in leaving if part[2]]
    triangle, squares = np.zeros((columns.width, columns.width + 1)), np.zeros(columns.width)
    if leaving and columns.width:
        count = np.array([n for *_, n in leaving])
        dims = np.array([group.residual.dim for group, *_ in leaving])
        dofs = [np.array([c.block.manifold.dof for c in group.connections]) for group, *_ in leaving]
        widths = np.array([dof.sum() for dof in dofs])
        dim, width, slots = np.repeat(dims, count), np.repeat(widths, count), np.repeat([len(dof) for dof in dofs], count)
        size = dim * (width + 1)
        at, slot = np.cumsum(size) - size, np.concatenate([[0], np.cumsum(slots)])
        dof = np.concatenate([np.tile(own, n) for own, n in zip(dofs, count, strict=True)])
        data, column = np.empty(int(size.sum())), np.empty(len(dof), dtype=np.int64)
        landmark, first = np.empty(len(dim), dtype=np.int64), np.empty(len(dim), dtype=np.int64)
        n = 0
        for (group, chosen, own_count), own in zip(leaving, dofs, strict=True):
            begin, n = n, n + own_count
            place = column[slot[begin] : slot[n]].reshape(own_count, len(own))
            landmark[begin:n] = _pack(group, chosen, columns, data[at[begin] : at[n - 1] + size[n - 1]], place)
            first[begin:n] = columns.width
            for slot_place in place.T.view(np.uint64):  # what has no column is negative, and without a sign larger than any
                np.minimum(first[begin:n], slot_place, out=first[begin:n], casting="unsafe")
        # Residuals without a landmark follow the landmarks, each alone.
        single = np.flatnonzero(landmark < 0)
        landmark[single] = len(columns.own) + np.arange(len(single))
        own = np.concatenate([columns.own, np.zeros(len(single), dtype=np.int64)])
        step = np.minimum(first * STEPS // columns.width, STEPS - 1)
        residual, starts = order_by(landmark * STEPS + (STEPS - 1 - step), len(own) * STEPS)
        order, begin_of = residual.astype(np.int64), starts[::STEPS]
        rows, reach = (np.bincount(landmark, weights=w, minlength=len(own)) for w in (dim, width))
        work = np.empty(int((rows * (np.minimum(reach, columns.width) + own + 1)).max()))
        add_rows(data, at, dim, slot, column, dof, step, order, begin_of, own, _RANK, work, squares, triangle)
    return triangle, np.sqrt(squares)


def prior_of(
    triangle: NDArray[np.float64], lengths: NDArray[np.float64], leaving: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(J, r₀) of the staying columns after the first `leaving` are minimised over; as many rows as there is information."""
    W = np.empty((TOGETHER, len(lengths) + 1))
    A, X = np.ascontiguousarray(triangle[:, :leaving].T), triangle[:, leaving:].copy()
    order, head = np.empty(len(lengths), dtype=np.int64), np.empty((2, len(lengths)))
    rank = eliminate_columns(A, X, *X.shape, lengths[:leaving].copy(), _RANK, order, head, W)
    A, r0 = np.ascontiguousarray(X[rank:, :-1].T), X[rank:, -1:].copy()
    # Against what was measured, so that what cancelled does not come back as information.
    rank = eliminate_columns(A, r0, *r0.shape, lengths[leaving:].copy(), _RANK, order, head, W)
    J = np.zeros((rank, len(A)))
    J[:, order[: len(A)]] = np.triu(A[:, :rank].T)
    return J, r0[:rank, 0].copy()
