"""Corners that the camera carries along: dirt on its lens, text in its images, an arm or the bow of its own platform in view.

They stand still in the image while the camera turns, and look like landmarks far away on a platform that does not turn. By the
gyroscope a landmark moves, by the rotation alone, from pixel p to π(R m). For it to stay, a translation has to undo that, at its
own depth and in every image. Over a turn of some degrees that happens on a circle around a landmark only, on which the camera
looks at it all the time: what is within two hundredths of the radius from the middle of one that is flown well is let go too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CARRIED = "moves along with the camera"
"""The reason for which such a corner is let go."""

_STILL_PX = 1.0  # from where it was first seen
_TURNED_PX, _TURNED = 20.0, 0.1  # by which rotations would have moved a corner, in pixels and in focal lengths
_LEAST_PX = 2.0  # of one image's rotation that counts
_OTHERS, _OTHERS_PX = 0.25, 1.0  # share of the corners that move, and by how much: else the images stand, or the gyroscope errs
_FEWEST = 10
_FORGOTTEN = 20.0  # rad of turning after which a place has to show again that it is carried along


class CarriedCorners:
    """Which corners the camera carries along, and where in its image these were.

    Args:
        focal_length: of the camera [px].

    Attributes:
        places: (m, 2) pixels at which no corner is to be looked for.
    """

    def __init__(self, focal_length: float) -> None:
        self._focal_length = focal_length
        self._ids = np.zeros(0, np.int64)
        self._first, self._turned_px = np.zeros((0, 2)), np.zeros(0)
        self._turned = 0.0  # rad, by all images so far
        self.places, self._found_at = np.zeros((0, 2)), np.zeros(0)

    def find(
        self, ids: NDArray[np.int64], before: Floats, by_turn: Floats, now: Floats, kept: NDArray[np.bool_], angle: float
    ) -> NDArray[np.bool_]:
        """The corners that were followed into the next image: which of them the camera carries along (n,).

        Args:
            ids: (n,) ascending.
            before, now: (n, 2) where they were and are [px].
            by_turn: (n, 2) where the rotation alone would have put them [px]; NaN where it is not known.
            kept: (n,) which of them were found.
            angle: by which the camera has turned [rad].
        """
        self._turned += angle
        first, turned_px = before.copy(), np.zeros(len(ids))
        _, mine, theirs = np.intersect1d(ids, self._ids, assume_unique=True, return_indices=True)
        first[mine], turned_px[mine] = self._first[theirs], self._turned_px[theirs]
        step = np.nan_to_num(np.linalg.norm(by_turn - before, axis=1))
        others = np.linalg.norm(now[kept] - before[kept], axis=1) > _OTHERS_PX
        if len(others) >= _FEWEST and others.mean() >= _OTHERS:
            turned_px += np.where(step >= _LEAST_PX, step, 0.0)
        moved = ~(np.linalg.norm(now - first, axis=1) < _STILL_PX)
        first[moved], turned_px[moved] = now[moved], 0.0
        carried = kept & (turned_px >= max(_TURNED_PX, _TURNED * self._focal_length))
        left = kept & ~carried
        self._ids, self._first, self._turned_px = ids[left].copy(), first[left], turned_px[left]
        known = self._turned - self._found_at < _FORGOTTEN
        self.places = np.concatenate([self.places[known], now[carried]])
        self._found_at = np.concatenate([self._found_at[known], np.full(int(carried.sum()), self._turned)])
        return carried
