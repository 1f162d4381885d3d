"""Whether a map has the lengths that are seen: one in another unit, or by a LiDAR whose ranges are off, fits and is followed.

Each scan that is registered says by what factor the map is longer, up to what the map's surfaces are off (`compare_lengths`).
Scans nearby see the same surfaces: they count as one, and what is left of their mean is asked over the way that was driven.
"""

from __future__ import annotations

import math

from boxplus.systems.slam.lengths import Lengths

OTHER_LENGTHS = 0.006  # share, by which lengths have to differ: docs/localization.md says what sound maps come to
_SIGMAS = 3.5
_FEWEST = 5  # scans
_PLACE_M = 5.0  # m of way after which other surfaces are seen


class MapLengths:
    """What the scans of a run say of the lengths of the map."""

    def __init__(self) -> None:
        self._weight = self._sum = self._way = 0.0
        self._count = 0

    def see(self, lengths: Lengths, way: float) -> None:
        """Take what a scan says, so many metres of way after the one before."""
        weight = lengths.sigma**-2
        self._weight += weight
        self._sum += weight * lengths.log_ratio
        self._way += way
        self._count += 1

    @property
    def ratio(self) -> tuple[float, float]:
        """The map's lengths over those that are seen, and its standard deviation; (1, inf) where no scan said anything."""
        if not self._count:
            return 1.0, math.inf
        places = min(1.0 + self._way / _PLACE_M, self._count)
        sigma = math.sqrt(self._count / self._weight / places)
        ratio = math.exp(self._sum / self._weight)
        return ratio, ratio * sigma

    @property
    def doubt(self) -> str | None:
        """Why the map's lengths are not to be trusted; None where nothing speaks against them."""
        ratio, sigma = self.ratio
        if self._count < _FEWEST or abs(ratio - 1.0) < max(OTHER_LENGTHS, _SIGMAS * sigma):
            return None
        return (
            f"lengths in the map are {ratio:.4f} times those that are seen (± {sigma:.4f}): one of the two is not in metres, or "
            "the ranges of one LiDAR are off; poses lie among what the map has around, but ways are as long as it says"
        )
