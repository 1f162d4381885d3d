"""New segments in an image: straight in space, long enough, and none that is followed already.

Source: Grompone von Gioi et al., LSD, TPAMI 2010, in OpenCV.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras.model import CameraModel

_SHORTEST_PX, _SHORTEST_SHARE = 20.0, 0.053  # of the width of the image
_SAME = 2.0  # px: two segments on one line
_GAP = 0.25  # of the length of a segment, up to which one on the same line goes on where it ends
_NEAR = 7.0  # px: two segments beside each other, such as the edges of a frame, show one line

_MOST_PIECES = 150

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Grey = NDArray[np.uint8]


def shortest_px(width: int) -> float:
    """Length of a segment worth following, in images of this width [px]: 40 of 752."""
    return max(_SHORTEST_PX, _SHORTEST_SHARE * width)


def new_segments(cv2: Any, detector: Any, grey: Grey, model: CameraModel, known: Floats, most: int) -> Floats:
    """Segments [x, y, x, y] of rays (n, 4), the longest first, that are not beside those `known` (k, 4); at most so many.

    Args:
        cv2: the module; detector: what `createLineSegmentDetector` made.
        grey: (H, W), of which half the resolution is looked at: places are refined later.
    """
    shortest = shortest_px(grey.shape[1])
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = detector.detect(half)[0]
    if found is None or most <= 0:
        return np.zeros((0, 4))
    pixels = 2.0 * np.asarray(found, dtype=np.float64).reshape(-1, 2, 2) + 0.5
    # Pieces: a lens bends a line, and noise breaks it.
    pixels = pixels[np.linalg.norm(pixels[:, 1] - pixels[:, 0], axis=1) >= 0.4 * shortest]
    rays, seen = model.unproject(pixels.reshape(-1, 2))
    pieces = rays[:, :2].reshape(-1, 4)[seen.reshape(-1, 2).all(axis=1)]
    focal = float(np.sqrt(model.fx * model.fy))
    pieces = pieces[np.argsort(-_length(pieces))][:_MOST_PIECES]
    chosen = known
    taken = np.zeros(len(pieces), dtype=np.bool_)
    for k in range(len(pieces)):
        if taken[k] or len(chosen) - len(known) >= most:
            continue
        goes_on = ~taken & _goes_on(pieces[k], pieces, focal)
        goes_on[k] = True
        taken |= goes_on
        whole = _joined(pieces[k], pieces[goes_on])
        is_long = focal * float(_length(whole[None])[0]) >= shortest
        if is_long and not _is_beside(whole, chosen, focal).any():
            chosen = np.concatenate([chosen, whole[None]])
    return chosen[len(known) :]


def _length(segments: Floats) -> Floats:
    return np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])


def _in_frame_of(segments: Floats, others: Floats) -> tuple[Floats, Floats, Floats]:
    """Along and across segments, the ends of other ones (n, 2), (n, 2), and the segments' lengths (n,)."""
    d = segments[:, 2:] - segments[:, :2]
    length = np.maximum(np.linalg.norm(d, axis=1), 1e-12)
    d = d / length[:, None]
    away = others.reshape(-1, 2, 2) - segments[:, None, :2]
    return np.einsum("nki,ni->nk", away, d), away[..., 1] * d[:, None, 0] - away[..., 0] * d[:, None, 1], length


def _goes_on(segment: Floats, others: Floats, focal: float) -> Flags:
    """Which other segments (n, 4) lie on the same line, in the same direction, and begin about where this one (4,) ends."""
    along, across, length = _in_frame_of(np.broadcast_to(segment, others.shape), others)
    gap = np.maximum(along.min(axis=1) - length, -along.max(axis=1))
    straight = (focal * np.abs(across) < _SAME).all(axis=1)
    return np.asarray((along[:, 1] > along[:, 0]) & straight & (gap < _GAP * length))


def _joined(segment: Floats, pieces: Floats) -> Floats:
    """From the first to the last end of pieces (n, 4) of a segment (4,)."""
    ends = pieces.reshape(-1, 2)
    along = ends @ (segment[2:] - segment[:2])
    return np.concatenate([ends[np.argmin(along)], ends[np.argmax(along)]])


def _is_beside(segment: Floats, others: Floats, focal: float) -> Flags:
    """Which other segments (n, 4) a segment (4,) runs along, for half its length or more."""
    along, across, length = _in_frame_of(others, np.broadcast_to(segment, others.shape))
    common = np.minimum(along.max(axis=1), length) - np.maximum(along.min(axis=1), 0.0)
    return np.asarray((focal * np.abs(across) < _NEAR).all(axis=1) & (common > 0.5 * np.ptp(along, axis=1)))
