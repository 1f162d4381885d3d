"""What a run was not shown, planes do not show a refinement either, whatever they seem to say.

Along a corridor nothing tells how far one has come: the filter says so, scan by scan, and its covariance grows there. By the
planes that are found in all scans together, edges and corners among them, the direction seems measured, to millimetres: the path
stays metres off, and its covariance says that it is not.

So along such a direction a refinement keeps the steps of the run, which are those of its IMU, and moves all others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.manifolds import quaternion, se3, so3
from boxplus.residuals.relative_pose import RelativePose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_MOST = 0.5  # share of the scans that may be weak or lost
_WINDOW = 10  # scans of a spell over which its covariance tells the direction
_LEAST_M = 2e-3  # standard deviation by which a position must have become less sure for a direction to count as open
_AS_OPEN = 0.25  # of the variance that grows most: so much of it in another direction, and that is open as well
_HELD_M = 1e-5  # standard deviation of a step along what is open


def after_unshown(status: ArrayLike) -> NDArray[np.bool_]:
    """(N,) scans from the first one on that was not `ok`: errors along what it was not shown stay in all later poses.

    Args:
        status: (N,) text, of the scans of a run in order of time.

    Example:
        >>> after_unshown(["ok", "weak", "ok"]).tolist()
        [False, True, True]
    """
    return np.logical_or.accumulate(np.asarray(status) != "ok")


def is_mostly_unshown(status: ArrayLike) -> bool:
    """Whether so many scans of a run were not `ok` that there is nothing to refine it by.

    Example:
        >>> is_mostly_unshown(["ok", "weak", "weak"])
        True
    """
    return float(np.mean(np.asarray(status) != "ok")) > _MOST


def open_steps(status: ArrayLike, T_world_imu: Floats, covariance: Floats, unmeasured: Floats) -> Floats:
    """(N, 3, 3) projectors, in the world, on the directions that the step to each scan leaves open; zero where it is shown.

    These are, of the directions that scans of a spell left open, those in which the covariance of the run grows over it, beyond
    what is known of the turns before: where scans are weak in rotation alone, it grows by what they did measure, and no step is
    open. Over a lost scan nothing is placed, and nothing claims to show anything.

    Args:
        status: (N,) text, of the scans of a run in order of time.
        T_world_imu: (N, 7) poses; covariance: (N, 6, 6) of them, [θ, p], relative to the first one.
        unmeasured: (N, 3, 3) of each scan, as in `OdometryRows`.

    Example:
        >>> T = np.tile([1.0, 0, 0, 0, 0, 0, 0], (3, 1))
        >>> P = np.stack([np.diag([0.0, 0, 0, x, 1e-6, 1e-6]) for x in (0.0, 1e-4, 0.04)])
        >>> along_x = np.stack([np.zeros((3, 3)), np.zeros((3, 3)), np.diag([1.0, 0, 0])])
        >>> np.diagonal(open_steps(["ok", "ok", "weak"], T, P, along_x), axis1=1, axis2=2).tolist()
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    weak, R = np.asarray(status) == "weak", quaternion.to_matrix(T_world_imu[:, :4])
    found = np.zeros((len(weak), 3, 3))
    begin = 0  # of the spell
    for k in np.flatnonzero(weak).tolist():
        begin = begin if k and weak[k - 1] else k
        first = max(begin - 1, k - _WINDOW, 0)
        J = np.hstack([-so3.hat(T_world_imu[k, 4:] - T_world_imu[first, 4:]) @ R[first], np.eye(3)])
        said, axes = np.linalg.eigh(unmeasured[first : k + 1].sum(axis=0))
        axes = axes[:, said > _AS_OPEN * said[-1]]
        if not axes.size:
            continue
        growth, within = np.linalg.eigh(axes.T @ (covariance[k, 3:, 3:] - J @ covariance[first] @ J.T) @ axes)
        open_ = axes @ within[:, (growth > _AS_OPEN * growth[-1]) & (growth[-1] > _LEAST_M**2)]
        found[k] = open_ @ open_.T
    return found


def kept_steps(T: Floats, first: Ints, second: Ints, open_: Floats) -> RelativePose:
    """Steps from scans (M,) to later ones (M,), held as poses (N, 7) have them along what (M, 3, 3) projectors say is open."""
    R = quaternion.to_matrix(T[second, :4])
    information = np.zeros((len(first), 6, 6))
    information[:, 3:, 3:] = np.swapaxes(R, 1, 2) @ open_ @ R / _HELD_M**2
    return RelativePose(se3.compose(se3.inverse(T[first]), T[second]), information=information)


def between(scans: Ints, open_: Floats) -> tuple[Ints, Floats]:
    """Numbers (M,) of successive pairs of chosen scans (K,) with an open step between them, and projectors (M, 3, 3) on that."""
    sums = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(open_, axis=0)])
    total = sums[scans[1:] + 1] - sums[scans[:-1] + 1]
    pairs = np.flatnonzero(np.einsum("kii->k", total) > 0.0)
    values, vectors = np.linalg.eigh(total[pairs])
    chosen = vectors * (values > _AS_OPEN * values[:, -1:])[:, None, :]
    return pairs, chosen @ np.swapaxes(chosen, 1, 2)
