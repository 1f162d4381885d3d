"""How far corners creep along while they are followed, and what that makes of their weight.

Optical flow finds a corner of the image before, so that its errors add up: a corner walks away from its point, and what a
keyframe says of it errs by nearly the same as the keyframe before. Taken for independent, n sightings by c cameras look as if
they told n c times as much as one. Let a corner walk by a variance q from keyframe to keyframe. The slope over n keyframes, what
decides how fast the window's poses run away, then has (n² + 1)/10 · q/σ² times the variance that independent errors σ give it,
and once more c times, as the other cameras look for the corner where the first one has it:

    factor² = 1 + c (n² + 1)/10 · q/σ²

q is told from the residuals r of the window while it runs. Independent errors make residuals two keyframes apart no more
different than those one keyframe apart; a walk adds q for each step. Landmark and poses take most of it; `_LEFT` of it stays:

    q = (E[(r_{k+2} − r_k)²] − E[(r_{k+1} − r_k)²]) / _LEFT

What neighbouring keyframes say of each other a walk leaves nearly as sharp as it was, and σ · factor would distrust it beside the
IMU. So the window counts with σ · √factor, and the covariance that comes out is taken times factor. Where mountings are refined
it counts with σ, and the covariance is taken times factor².

Source: docs/visual_inertial_odometry.md, "What corners err by".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FEWEST = 5  # keyframes that saw a corner, for its residuals to tell
_ENOUGH = 60  # pairs of residuals
_MEMORY = 0.9  # of the sums, per keyframe
_LEFT = 0.5

Floats = NDArray[np.float64]


class CornerCreep:
    """Tells from residuals how much more than `pixel_sigma` a sighting has to count with.

    Args:
        weigh: whether the window counts with it; not where mountings are refined, which corners that count less leave to drift.

    Attributes:
        factor: 1 or more, of the standard deviation of what the window finds.
    """

    def __init__(self, *, weigh: bool = True) -> None:
        self._weigh = weigh
        self.factor = 1.0
        self._sums = np.zeros(4)  # of squares one and two keyframes apart, and how many
        self._most = np.zeros(2)  # sums of n² + 1, and of how many corners

    @property
    def weight(self) -> float:
        """By what `pixel_sigma` is multiplied in the window."""
        return float(np.sqrt(self.factor)) if self._weigh else 1.0

    @property
    def spread(self) -> float:
        """By what the window's covariance is multiplied: factor² less what the weight has done."""
        return (self.factor / self.weight) ** 2

    def note(self, residuals: Floats, landmark: NDArray[np.int64], keyframe: NDArray[np.int64], cameras: int) -> None:
        """Take the window's residuals of the first camera, all keyframes of it.

        Args:
            residuals: (m, 2) by `pixel_sigma`, whatever the factor.
            landmark, keyframe: (m,) their ids.
            cameras: that see the corners.
        """
        _, of, count = np.unique(landmark, return_inverse=True, return_counts=True)
        long = count[of] >= _FEWEST
        order = np.lexsort((keyframe[long], of[long]))
        r, of = residuals[long][order], of[long][order]
        sums = []
        for apart in (1, 2):
            step = (r[apart:] - r[:-apart])[of[apart:] == of[:-apart]]
            sums += [float((step * step).sum()), step.size]
        n = count[count >= _FEWEST].astype(np.float64)
        self._sums = _MEMORY * self._sums + sums
        self._most = _MEMORY * self._most + [(n * n + 1.0).sum(), len(n)]
        one, pairs, two, others = self._sums
        if min(pairs, others) >= 2 * _ENOUGH:
            near, far = one / pairs, two / others
            # Less twice what chance gives: independent errors are not to be taken for a walk by what one window happens to show.
            by_chance = 2.0 * float(np.sqrt(2.0 * near**2 / max(sums[1], 1) + 2.0 * far**2 / max(sums[3], 1)))
            q = max(far - near - by_chance, 0.0) / _LEFT
            self.factor = float(np.sqrt(1.0 + cameras * self._most[0] / self._most[1] / 10.0 * q))
