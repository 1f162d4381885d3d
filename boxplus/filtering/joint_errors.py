"""The joint covariances of the errors e, d and u or l of `map_datum`, from scan to scan: its equations, compiled.

`joint` is (2, m + 12, m + 12), of e (m, the pose first), d (6) and u or l (6), with small motions about the IMU along the world's
axes; each of the two is gone on with in place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import P, R
from boxplus.filtering.small_linalg import inverse_root_into, positive_part_into

_ROUNDED = 1e-9  # of the prior's variances, in which rounding is a millionth of that and noise that is none a thousandth


@kernel
def _rigid(x_before: NDArray[np.float64], x: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6, 6): a small motion about the IMU at one state (36,), as one about where it is at the next."""
    move, sx, sy, sz = np.eye(6), x[P] - x_before[P], x[P + 1] - x_before[P + 1], x[P + 2] - x_before[P + 2]
    move[3, 1], move[3, 2], move[4, 0], move[4, 2], move[5, 0], move[5, 1] = sz, -sy, -sz, sx, sy, -sx
    return move


@kernel
def move_map(x_before: NDArray[np.float64], x: NDArray[np.float64], joint: NDArray[np.float64]) -> None:
    """The errors d and l of the map, about where the IMU is now: joint (2, m + 12, m + 12), in place."""
    move, n = _rigid(x_before, x), joint.shape[1]
    for k in range(2):
        C = joint[k]
        for block in (n - 12, n - 6):
            for i in range(3):
                for j in range(n):
                    C[block + 3 + i, j] += (
                        move[3 + i, 0] * C[block, j] + move[3 + i, 1] * C[block + 1, j] + move[3 + i, 2] * C[block + 2, j]
                    )
            for i in range(3):
                for j in range(n):
                    C[j, block + 3 + i] += (
                        move[3 + i, 0] * C[j, block] + move[3 + i, 1] * C[j, block + 1] + move[3 + i, 2] * C[j, block + 2]
                    )


@kernel
def predict(
    x_before: NDArray[np.float64],
    x: NDArray[np.float64],
    transition: NDArray[np.float64],
    cov_prior: NDArray[np.float64],
    before: NDArray[np.float64],
    laid: bool,
    deskewed: float,
    joint: NDArray[np.float64],
) -> None:
    """The joint covariances (2, m + 12, m + 12), in place, from the last scan to the points of this one.

    Args:
        x_before, x: (36,) states after both scans.
        transition: Φ (m, m), or (0, 0) where it is not known; cov_prior: (m, m). Both as the filter has them.
        before: (m, m) covariance of the filter after the last scan, along the world's axes.
        laid: whether the third block is l, which goes on where there are no points; deskewed: how much of u points share.
    """
    m, known = cov_prior.shape[0], transition.shape[0] > 0
    step, prior, rest = np.zeros((m + 12, m + 12)), np.empty((m, m)), np.empty((m, m))
    if known:
        turn_into(transition, x[R : R + 9], x_before[R : R + 9], step)
    else:
        for i in range(m):
            step[i, i] = 1.0
    move = _rigid(x_before, x)
    for i in range(6):
        step[m + i, m + i] = 1.0
        if laid:
            step[m + 6 + i, m + 6 + i] = 1.0
        if not known:
            for j in range(6):
                step[i, j] = move[i, j]
    turn_into(cov_prior, x[R : R + 9], x[R : R + 9], prior)
    _congruence(step, before, np.empty((m, m)), rest)
    added = prior - rest
    for i in range(m):
        rest[i, i] = added[i, i] + _ROUNDED * prior[i, i]
        for j in range(i):
            rest[i, j] = added[i, j]
    if not inverse_root_into(rest, np.empty((m, m))):  # not all of it is noise: the filter has gone on in another way
        positive_part_into(added)
    if not laid:
        for i in range(6):
            for j in range(m):
                step[m + 6 + i, j] = 0.5 * deskewed * (step[i, j] - (move[i, j] if j < 6 else 0.0))
    moved, work = np.empty((m + 12, m + 12)), np.empty((m + 12, m + 12))
    for k in range(2):
        _congruence(step, joint[k], work, moved)
        for i in range(m):
            for j in range(m):
                moved[i, j] += added[i, j]
        if not laid:
            for i in range(6):
                for j in range(6):
                    moved[m + 6 + i, m + 6 + j] += deskewed * deskewed * added[i, j] / 3.0
            for i in range(m):
                for j in range(6):
                    moved[i, m + 6 + j] += 0.5 * deskewed * added[i, j]
                    moved[m + 6 + j, i] += 0.5 * deskewed * added[i, j]
        joint[k] = moved


@kernel
def correct(x: NDArray[np.float64], gain: NDArray[np.float64], noise: NDArray[np.float64], joint: NDArray[np.float64]) -> None:
    """The scan pulls the state at x (36,) to the map, e ← e − G (E e − u − d − v); joint (2, m + 12, m + 12), in place.

    Args:
        gain: (m, 6) G; noise: (m, m) covariance of G v. Both about the IMU's axes.
    """
    m, n = gain.shape[0], joint.shape[1]
    pull, random, apart = np.empty((m, 6)), np.empty((m, m)), np.empty((6, n))
    turn_into(gain, x[R : R + 9], x[R : R + 9], pull)
    turn_into(noise, x[R : R + 9], x[R : R + 9], random)
    for k in range(2):
        C = joint[k]
        for side in range(2):
            for i in range(6):
                for j in range(n):
                    if side == 0:
                        apart[i, j] = C[i, j] - C[m + i, j] - C[m + 6 + i, j]
                    else:
                        apart[i, j] = C[j, i] - C[j, m + i] - C[j, m + 6 + i]
            for i in range(m):
                for j in range(n):
                    total = 0.0
                    for l in range(6):
                        total += pull[i, l] * apart[l, j]
                    if side == 0:
                        C[i, j] -= total
                    else:
                        C[j, i] -= total
        for i in range(n):
            for j in range(i + 1):
                mean = 0.5 * (C[i, j] + C[j, i])
                if i < m:
                    mean += 0.5 * (random[i, j] + random[j, i])
                C[i, j] = C[j, i] = mean


@kernel
def lay_down(joint: NDArray[np.float64]) -> None:
    """The points go where the estimate says: u becomes l = E e − u; joint (2, m + 12, m + 12), in place."""
    n = joint.shape[1]
    m = n - 12
    for k in range(2):
        C = joint[k]
        for i in range(6):
            for j in range(n):
                C[m + 6 + i, j] = C[i, j] - C[m + 6 + i, j]
        for i in range(6):
            for j in range(n):
                C[j, m + 6 + i] = C[j, i] - C[j, m + 6 + i]


@kernel
def renew(x: NDArray[np.float64], share: NDArray[np.float64], placed: NDArray[np.float64], joint: NDArray[np.float64]) -> None:
    """What a scan at x (36,) sees of the map is in part that of the scan before, d ← d + F (l − d) + F n: joint, in place.

    Args:
        share: (6, 6) F; placed: (6, 6) covariance of F n. Both about the IMU's axes.
    """
    n = joint.shape[1]
    m = n - 12
    F, noise, seen = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, n))
    turn_into(share, x[R : R + 9], x[R : R + 9], F)
    turn_into(placed, x[R : R + 9], x[R : R + 9], noise)
    for c in range(2):
        D = joint[c]
        for side in range(2):
            for i in range(6):
                for j in range(n):
                    total = 0.0
                    for k in range(6):  # so added up, nothing is left of d where F is 1: after a gap it is thousands of metres
                        d, l = (D[m + k, j], D[m + 6 + k, j]) if side == 0 else (D[j, m + k], D[j, m + 6 + k])
                        total += ((1.0 if i == k else 0.0) - F[i, k]) * d + F[i, k] * l
                    seen[i, j] = total
            for i in range(6):
                for j in range(n):
                    if side == 0:
                        D[m + i, j] = seen[i, j]
                    else:
                        D[j, m + i] = seen[i, j]
        for i in range(6):
            for j in range(6):
                D[m + i, m + j] += noise[i, j]


@kernel
def _congruence(T: NDArray[np.float64], M: NDArray[np.float64], work: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """out = T M Tᵀ, (r, r), for symmetric M, of which the first n rows count, as of T the first r and n; work: (r, n)."""
    r, n = work.shape
    for i in range(r):
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += T[i, k] * M[k, j]
            work[i, j] = total
    for i in range(r):
        for j in range(i + 1):
            total = 0.0
            for k in range(n):
                total += work[i, k] * T[j, k]
            out[i, j] = total
            out[j, i] = total


@kernel
def turn_into(M: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """M (r, c), whose first three rows and columns are along the IMU's axes, with these along the world's; rotations (9,)."""
    r, c = M.shape
    for i in range(r):
        for j in range(3, c):
            out[i, j] = M[i, j]
        for j in range(3):
            out[i, j] = columns[3 * j] * M[i, 0] + columns[3 * j + 1] * M[i, 1] + columns[3 * j + 2] * M[i, 2]
    for j in range(c):
        a, b, d = out[0, j], out[1, j], out[2, j]
        for i in range(3):
            out[i, j] = rows[3 * i] * a + rows[3 * i + 1] * b + rows[3 * i + 2] * d
