"""Where in its window a corner has to be, so that a window that grows or turns is not taken for one that shifts.

Optical flow looks for the shift δ of a window, Σ g gᵀ δ = Σ g (I − T), with the gradients g. Where the image grows by s − 1
about the corner q, I − T is (s − 1) gᵀ (x − q), and the shift found (s − 1) (Σ g gᵀ)⁻¹ Σ g gᵀ (x − q), zero only for the point

    q = (Σ g gᵀ)⁻¹ Σ g gᵀ x

A corner elsewhere creeps: by some hundredths of a pixel in every image while the camera comes nearer, all in one direction.
The same point is the crossing of the edges in the window, which OpenCV's `cornerSubPix` finds.

Source: Förstner and Gülch, ISPRS 1987.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_HALF = 10  # of the window of the optical flow
_STOP = (3, 30, 0.01)
_FARTHEST = 8.0  # px
_SHARE = 0.25  # of a cell: corners are 0.6 of it apart, and two that meet are one
_WEAKER = 0.5  # of the smallest eigenvalue, below which a new place is worse to follow than the old one

Floats = NDArray[np.float64]


def centred(cv2: Any, grey: NDArray[np.uint8], corners: Floats, cell: float = _FARTHEST / _SHARE) -> Floats:
    """Corners (n, 2) [px] drawn to the centre of the gradients around them, where that is a good place to follow.

    Along an edge nothing holds the centre; a corner that would slide along one stays where it is.

    Args:
        cv2: the module.
        grey: (H, W).
        cell: corners are at least 0.6 of it apart [px]; a quarter of it, and 8 pixels, is how far one is drawn at most.
    """
    if not len(corners):
        return corners
    begin = np.array(corners, dtype=np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(grey, begin, (_HALF, _HALF), (-1, -1), _STOP)
    tried = found.reshape(-1, 2).astype(np.float64)
    good = np.isfinite(tried).all(axis=1) & (np.linalg.norm(tried - corners, axis=1) < min(_FARTHEST, _SHARE * cell))
    tried = np.where(good[:, None], tried, corners)
    good &= _strength(grey, tried) >= _WEAKER * _strength(grey, corners)
    return np.where(good[:, None], tried, corners)


def _strength(grey: NDArray[np.uint8], corners: Floats) -> Floats:
    """Smallest eigenvalue (n,) of Σ g gᵀ over windows about the corners."""
    height, width = grey.shape
    middle = np.clip(np.rint(corners).astype(np.int64), _HALF + 1, np.array([width, height]) - _HALF - 2)
    reach = np.arange(-_HALF - 1, _HALF + 2)
    patch = grey[middle[:, 1, None, None] + reach[:, None], middle[:, 0, None, None] + reach].astype(np.float64)
    g = np.stack([patch[:, 1:-1, 2:] - patch[:, 1:-1, :-2], patch[:, 2:, 1:-1] - patch[:, :-2, 1:-1]], axis=-1)
    smallest: Floats = np.linalg.eigvalsh(np.einsum("nvuk,nvul->nkl", g, g))[:, 0]
    return smallest
