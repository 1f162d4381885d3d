"""The rows of residuals that leave a problem, packed for the kernels, and which variables they leave to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.optimization.marginalization.orthogonal_kernels import OWN, STEPS, TOGETHER, add_rows, eliminate_columns
from boxplus.optimization.marginalization.packing import begin_group, copy_residuals, keys_of, mark, pack_variable, unmark_shared
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
            for c in group.connections:
                mark(c.rows, chosen, met[c.block.number])
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
            leaving_slots = [c for c in group.connections if single[c.block.number]]
            if len(leaving_slots) > 1 and any(c.block is block for c in leaving_slots):
                meetings = np.zeros(len(chosen), dtype=np.int64)
                for c in leaving_slots:
                    meetings += alone[c.block.number][c.rows]
                for c in leaving_slots:
                    if c.block is block:
                        unmark_shared(c.rows, chosen, meetings, candidates)
    return alone


def triangle_of(groups: Sequence[Group], touched: Masks, columns: Columns) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """R (w, w + 1) of all rows without their landmarks, residuals in the last column, and (w,) the lengths of the columns."""
    leaving = [(group, np.flatnonzero(chosen)) for group, chosen in zip(groups, touched, strict=True)]
    leaving = [(group, rows) for group, rows in leaving if len(rows)]
    triangle, squares = np.zeros((columns.width, columns.width + 1)), np.zeros(columns.width)
    if leaving and columns.width:
        # Of every group: how many residuals, rows, numbers in a row, variables.
        shapes = [(len(rows), g.residual.dim, g.tangents + 1, len(g.connections)) for g, rows in leaving]
        count = sum(n for n, *_ in shapes)
        data = np.empty(sum(n * dim * width for n, dim, width, _ in shapes))
        column, dof = np.empty((2, sum(n * slots for n, *_, slots in shapes)), dtype=np.int64)
        at, dim, slot = (np.empty(count + 1, dtype=np.int64) for _ in range(3))
        landmark, first = np.empty((2, count), dtype=np.int64)
        n, size, k = 0, 0, 0
        for (group, rows), (own_count, own_dim, width, slots) in zip(leaving, shapes, strict=True):
            part = slice(n, n + own_count)
            begin_group(
                own_dim, width, slots, size, k, columns.width, dim[part], at[part], slot[part], landmark[part], first[part]
            )
            packed = data[size : size + own_count * own_dim * width].reshape(own_count, own_dim, width)
            end = 0
            for number, (c, J) in enumerate(zip(group.connections, group.jacobians, strict=True)):
                block = c.block.number
                pack_variable(
                    J, rows, c.rows, columns.place[block], columns.landmark[block], end, number, k, slots,
                    packed, column, dof, landmark[part], first[part],
                )  # fmt: skip
                end += J.shape[2]
            copy_residuals(group.r, rows, packed)
            n, size, k = n + own_count, size + packed.size, k + own_count * slots
        slot[count] = k
        # Residuals without a landmark follow the landmarks, each alone.
        own, key = np.zeros(len(columns.own) + count, dtype=np.int64), np.empty(count, dtype=np.int64)
        own[: len(columns.own)] = columns.own
        alone, work = keys_of(landmark, first, dim, at, len(data), columns.width, own, len(columns.own), key)
        own = own[: len(columns.own) + alone]
        order, starts = order_by(key, len(own) * STEPS)
        step = STEPS - 1 - key % STEPS
        add_rows(
            data, at, dim, slot, column, dof, step, order.astype(np.int64), starts[::STEPS], own, _RANK,
            np.empty(work), squares, triangle,
        )  # fmt: skip
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
