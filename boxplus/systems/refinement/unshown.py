"""What a run was not shown, planes do not show a refinement either, whatever they seem to say.

Along a corridor nothing tells how far one has come: the filter says so, scan by scan, and its covariance grows there. By the
planes that are found in all scans together, edges and corners among them, the direction seems measured, to millimetres: the path
stays metres off, and its covariance says that it is not.

So a refinement may move the path along such a direction by what the run was uncertain of it before, and not by more: whether that
is right, nothing tells, and the points that took no part lie as well either way.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

_MOST = 0.5  # share of the scans that may be weak or lost
_FARTHEST = 2.0  # standard deviations, of what the run knew before a spell of weak scans, that the path may move over it
_LEAST_SIGMA_M = 0.002


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


def moved_unshown(status: ArrayLike, p_before: Floats, p_after: Floats, covariance: Floats) -> str | None:
    """A sentence where the path was moved along what a spell of weak or lost scans did not show, by more than was open before it.

    The direction is the one along which the covariance of the run grows most over the spell.

    Args:
        status: (N,) text, of the scans of a run in order of time.
        p_before, p_after: (N, 3) positions of the run, and as they were refined [m].
        covariance: (N, 6, 6) of the run's poses, [θ, p], relative to the first one.

    Example:
        >>> p, far = np.zeros((3, 3)), np.array([[0.0, 0, 0], [0, 0, 0], [0.3, 0, 0]])
        >>> P = np.stack([np.diag([0.0, 0, 0, x, 1e-6, 1e-6]) for x in (0.0, 1e-4, 0.04)])
        >>> moved_unshown(["ok", "ok", "weak"], p, far, P)[:35]
        'over 1 scan that was weak or lost, '
        >>> moved_unshown(["ok", "ok", "ok"], p, far, P)
    """
    for begin, end in _spells(np.asarray(status) != "ok"):
        before, P = max(begin - 1, 0), covariance[:, 3:, 3:]
        axis = np.linalg.eigh(P[end - 1] - P[before])[1][:, -1]
        moved = p_after - p_before
        far = abs(float((moved[end - 1] - moved[before]) @ axis))
        sigma = float(np.sqrt(axis @ P[before] @ axis)) + _LEAST_SIGMA_M
        if far > _FARTHEST * sigma:
            which = "1 scan that was" if end - begin == 1 else f"{end - begin} scans that were"
            return (
                f"over {which} weak or lost, from number {begin} on, it moved the path by {100.0 * far:.1f} cm along what they "
                f"did not show, where the run was sure to {100.0 * sigma:.1f} cm before: nothing tells whether that is right"
            )
    return None


def _spells(marked: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and one past the last of those in a row."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
