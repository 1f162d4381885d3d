"""Whether a map has the lengths that are seen: one in another unit, or by a LiDAR whose ranges are off by a factor, is followed.

Now and then a scan that is registered says by what factor the map is longer, up to what the map's surfaces are off
(`compare_lengths`). Scans nearby see the same surfaces: they count as one, and what is left of their mean is asked over the way
that was driven.
"""

from __future__ import annotations

import math

from boxplus.systems.slam.lengths import Lengths

OTHER_LENGTHS = 0.006  # of log lengths, by which they have to differ: docs/localization.md says what sound maps come to
_SIGMAS = 3.5
_FEWEST = 5  # scans
_PLACE_M = 5.0  # m of way after which other surfaces are seen
_EVERY_M = 1.0  # m of way between two comparisons: one costs as much as a registration and a half


class MapLengths:
    """What the scans of a run say of the lengths of the map."""

    def __init__(self) -> None:
        self._weight = self._sum = self._way = 0.0
        self._count = 0
        self.begin()

    def begin(self) -> None:
        """A place is searched for: what was gone since a scan was compared is no way among the map's surfaces."""
        self._since_seen = 0.0
        self._since_asked = math.inf

    def walk(self, metres: float) -> None:
        """The odometry moved by so many metres. However far: one scan sees the surfaces of one place."""
        self._since_seen = min(self._since_seen + metres, _PLACE_M)
        self._since_asked += metres

    @property
    def is_due(self) -> bool:
        """Whether to compare the next scan."""
        return self._since_asked >= _EVERY_M

    def see(self, lengths: Lengths | None) -> None:
        """Take what a scan says; None where it was compared and told nothing."""
        self._since_asked = 0.0
        if lengths is None:
            return
        weight = lengths.sigma**-2
        self._weight += weight
        self._sum += weight * lengths.log_ratio
        self._way += self._since_seen if self._count else 0.0
        self._since_seen = 0.0
        self._count += 1

    @property
    def log_ratio(self) -> tuple[float, float]:
        """Logarithm of the map's lengths over those seen, and its standard deviation; (0, inf) where no scan said anything."""
        if not self._count:
            return 0.0, math.inf
        places = min(1.0 + self._way / _PLACE_M, self._count)
        return self._sum / self._weight, math.sqrt(self._count / self._weight / places)

    @property
    def doubt(self) -> str | None:
        """Why the map's lengths are not to be trusted; None where nothing speaks against them."""
        log_ratio, sigma = self.log_ratio
        if self._count < _FEWEST or abs(log_ratio) < max(OTHER_LENGTHS, _SIGMAS * sigma):
            return None
        ratio = math.exp(log_ratio)
        return (
            f"lengths in the map are {ratio:.4f} times those that are seen (± {ratio * sigma:.4f}): one of the two is not in "
            "metres, or the ranges of one LiDAR are off by a factor; poses lie among what the map has around, but ways are as "
            "long as it says"
        )
