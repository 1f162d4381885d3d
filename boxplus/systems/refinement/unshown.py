"""What a run was not shown, planes do not show a refinement either, whatever they seem to say.

Along a corridor nothing tells how far one has come: the filter says so, scan by scan, and its covariance grows there. By the
planes that are found in all scans together, edges and corners among them, the direction seems measured, to millimetres: the path
stays metres off, and its covariance says that it is not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_MOST = 0.5  # share of the scans that may be weak or lost


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
