"""What leaves a problem, laid out for `orthogonal_kernels.add_rows`: row after row, with the columns of its variables.

A window marginalises a few thousand residuals in a few milliseconds, of which passes of NumPy over arrays of their number, one
for each thing there is to know of them, would take half.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.optimization.marginalization.orthogonal_kernels import STEPS

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@kernel
def mark(rows: NDArray[np.uint32], chosen: NDArray[np.bool_], marked: NDArray[np.bool_]) -> None:
    """marked[rows[n]] = True for the chosen n."""
    for n in range(np.uint64(len(rows))):
        if chosen[n]:
            marked[rows[n]] = True


@kernel
def unmark_shared(
    rows: NDArray[np.uint32], chosen: NDArray[np.bool_], meetings: NDArray[np.int64], marked: NDArray[np.bool_]
) -> None:
    """marked[rows[n]] = False for the chosen n that meet more than one."""
    for n in range(np.uint64(len(rows))):
        if chosen[n] and meetings[n] > 1:
            marked[rows[n]] = False


@kernel
def begin_group(
    rows: int,
    numbers: int,
    slots: int,
    size: int,
    before: int,
    columns: int,
    dim: Ints,
    at: Ints,
    slot: Ints,
    landmark: Ints,
    first: Ints,
) -> None:
    """Shape and place of a group's residuals (n,): `rows` of `numbers` each, from `size` in the data, `before` in the slots."""
    for n in range(np.uint64(len(first))):
        dim[n], at[n], slot[n] = rows, size, before
        landmark[n], first[n] = -1, columns
        size += rows * numbers
        before += slots


@kernel
def pack_variable(
    J: Floats,
    rows: NDArray[np.int64],
    variable: NDArray[np.uint32],
    place: Ints,
    landmark_of: Ints,
    end: int,
    number: int,
    begin: int,
    slots: int,
    packed: Floats,
    column: Ints,
    dof: Ints,
    landmark: Ints,
    first: Ints,
) -> None:
    """What the residuals `rows` (n,) of a group say of one of their variables.

    Args:
        J: (N, d, k) of all residuals of the group; variable: (N,) rows in their block.
        place, landmark_of: of every variable of the block, see `Columns`.
        end, number: where the variable begins in the rows, and among the variables of the group.
        begin, slots: where the first residual begins in `column` and `dof`, and how many variables each has.
        packed: (n, d, more than k) receives J; column, dof: column and degrees of freedom of the variable.
        landmark, first: (n,) of every residual its landmark and the least column so far.
    """
    d, k = np.uint64(J.shape[1]), np.uint64(J.shape[2])
    for n in range(np.uint64(len(rows))):
        row = np.uint64(rows[n])
        for i in range(d):
            for j in range(k):
                packed[n, i, np.uint64(end) + j] = J[row, i, j]
        which = variable[row]
        to = place[which]
        s = np.uint64(begin + number) + n * np.uint64(slots)
        column[s], dof[s] = to, k
        landmark[n] = max(landmark[n], landmark_of[which])
        if to >= 0:
            first[n] = min(first[n], to)


@kernel
def copy_residuals(r: Floats, rows: NDArray[np.int64], packed: Floats) -> None:
    """packed[:, :, -1] = r[rows]."""
    last = np.uint64(packed.shape[2] - 1)
    for n in range(np.uint64(len(rows))):
        for i in range(np.uint64(r.shape[1])):
            packed[n, i, last] = r[np.uint64(rows[n]), i]


@kernel
def keys_of(
    landmark: Ints, first: Ints, dim: Ints, at: Ints, end: int, width: int, own: Ints, landmarks: int, key: Ints
) -> tuple[int, int]:
    """By what residuals are sorted, landmark by landmark with the steps of each descending.

    Args:
        landmark, first, dim, at: (n,) see `pack_variable` and `add_rows`; those without a landmark get numbers after the others.
        end: of the numbers of all residuals.
        width: of all columns.
        own: (landmarks + n,) degrees of freedom of each landmark, 0 for residuals without one.
        key: (n,) receives landmark · STEPS + (STEPS − 1 − step).

    Returns:
        Residuals without a landmark, and as many numbers as the largest landmark has rows times columns.
    """
    count = len(key)
    rows, reach = np.zeros(len(own), dtype=np.int64), np.zeros(len(own), dtype=np.int64)
    alone = 0
    for n in range(count):
        m = landmark[n]
        if m < 0:
            m = landmarks + alone
            alone += 1
        key[n] = m * STEPS + STEPS - 1 - min(first[n] * STEPS // width, STEPS - 1)
        rows[m] += dim[n]
        after = at[n + 1] if n + 1 < count else end
        reach[m] += (after - at[n]) // dim[n] - 1
    work = 0
    for m in range(landmarks + alone):
        work = max(work, rows[m] * (min(reach[m], width) + own[m] + 1))
    return alone, work
