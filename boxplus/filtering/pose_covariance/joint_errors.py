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

_ROUNDED = 1e-9  # of the prior's variances: noise may be negative by so much


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
        for block in (n - 12, n - 6):
            _move_rows(move, block, joint[k])
            _move_rows(move, block, joint[k].T)


@kernel
def _move_rows(move: NDArray[np.float64], block: int, C: NDArray[np.float64]) -> None:
    """Of the six rows of C (n, n) from `block` on, the last three go along with the first three."""
    for i in range(3):
        for j in range(C.shape[1]):
            C[block + 3 + i, j] += (
                move[3 + i, 0] * C[block, j] + move[3 + i, 1] * C[block + 1, j] + move[3 + i, 2] * C[block + 2, j]
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
    pull, random = np.empty((m, 6)), np.empty((m, m))
    turn_into(gain, x[R : R + 9], x[R : R + 9], pull)
    turn_into(noise, x[R : R + 9], x[R : R + 9], random)
    for k in range(2):
        C = joint[k]
        _pull_rows(pull, C)
        _pull_rows(pull, C.T)
        for i in range(n):
            for j in range(i + 1):
                mean = 0.5 * (C[i, j] + C[j, i])
                if i < m:
                    mean += 0.5 * (random[i, j] + random[j, i])
                C[i, j] = C[j, i] = mean


@kernel
def _pull_rows(pull: NDArray[np.float64], C: NDArray[np.float64]) -> None:
    """The rows of e in C (n, n) less G (m, 6) of those of E e − u − d."""
    m, n = pull.shape[0], C.shape[1]
    apart = np.empty((6, n))
    for i in range(6):
        for j in range(n):
            apart[i, j] = C[i, j] - C[m + i, j] - C[m + 6 + i, j]
    for i in range(m):
        for j in range(n):
            total = 0.0
            for l in range(6):
                total += pull[i, l] * apart[l, j]
            C[i, j] -= total


@kernel
def lay_down(joint: NDArray[np.float64]) -> None:
    """The points go where the estimate says: u becomes l = E e − u; joint (2, m + 12, m + 12), in place."""
    for k in range(2):
        _lay_rows(joint[k])
        _lay_rows(joint[k].T)


@kernel
def _lay_rows(C: NDArray[np.float64]) -> None:
    """The rows of u in C (n, n) become those of the pose less them."""
    n = C.shape[1]
    for i in range(6):
        for j in range(n):
            C[n - 6 + i, j] = C[i, j] - C[n - 6 + i, j]


@kernel
def renew(x: NDArray[np.float64], share: NDArray[np.float64], placed: NDArray[np.float64], joint: NDArray[np.float64]) -> None:
    """What a scan at x (36,) sees of the map is in part that of the scan before, d ← d + F (l − d) + F n: joint, in place.

    Args:
        share: (6, 6) F; placed: (6, 6) covariance of F n. Both about the IMU's axes.
    """
    m = joint.shape[1] - 12
    F, noise = np.empty((6, 6)), np.empty((6, 6))
    turn_into(share, x[R : R + 9], x[R : R + 9], F)
    turn_into(placed, x[R : R + 9], x[R : R + 9], noise)
    for k in range(2):
        C = joint[k]
        _renew_rows(F, C)
        _renew_rows(F, C.T)
        for i in range(6):
            for j in range(6):
                C[m + i, m + j] += noise[i, j]


@kernel
def _renew_rows(F: NDArray[np.float64], C: NDArray[np.float64]) -> None:
    """The rows of d in C (n, n) become (I − F) d + F l; so added up, kilometres of d leave nothing behind where F is 1."""
    n = C.shape[1]
    m, seen = n - 12, np.empty((6, n))
    for i in range(6):
        for j in range(n):
            total = 0.0
            for k in range(6):
                total += ((1.0 if i == k else 0.0) - F[i, k]) * C[m + k, j] + F[i, k] * C[m + 6 + k, j]
            seen[i, j] = total
    for i in range(6):
        for j in range(n):
            C[m + i, j] = seen[i, j]


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
