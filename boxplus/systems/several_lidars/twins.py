"""Is one LiDAR given twice? Its points come under another name then, and count twice as if they had been measured twice.

Two LiDARs never measure the same points, neither each in its own frame nor all in that of the first one: the noise of ranges
alone is a centimetre. A topic that repeats another one, cut or thinned out, has none but the other's: as they are, or moved to
another frame (that of the body), which comes out at the same place where it is declared.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan

_SAME_M = 1e-3  # apart, points are one
_SHARE = 0.9  # of its points, that another LiDAR has too
_LOOKED = 5  # scans in which both have points
_POINTS = 200  # of a LiDAR, in each


class Twins:
    """Compares the LiDARs of the first merged scans.

    Args:
        T_first_lidar: (4, 4) of each LiDAR, the first one first, as declared.
    """

    def __init__(self, T_first_lidar: Sequence[NDArray[np.float64]]) -> None:
        self._T = T_first_lidar
        self._looked = np.zeros((len(T_first_lidar), len(T_first_lidar)), dtype=np.int64)
        self._same = np.zeros_like(self._looked)

    def add(self, scan: Scan) -> None:
        """Look at a merged scan; at two LiDARs of which enough has been seen together no more."""
        from scipy.spatial import cKDTree

        if scan.lidar is None:
            return
        seen = np.unique(scan.lidar).tolist()
        ask = [(number, earlier) for earlier, number in combinations(seen, 2) if self._looked[number, earlier] < _LOOKED]
        shares = np.zeros_like(self._same, dtype=np.float64)
        for points_of in (self._own, _of_first):
            points = {number: points_of(scan, number) for number in {number for pair in ask for number in pair}}
            trees = {earlier: cKDTree(points[earlier]) for earlier in {earlier for _, earlier in ask}}
            for number, earlier in ask:
                some = points[number][:: -(-len(points[number]) // _POINTS)]
                distance, _ = trees[earlier].query(some, distance_upper_bound=_SAME_M)
                shares[number, earlier] = max(shares[number, earlier], float(np.isfinite(distance).mean()))
        for number, earlier in ask:
            self._looked[number, earlier] += 1
            self._same[number, earlier] += shares[number, earlier] >= _SHARE

    def of(self, number: int) -> int | None:
        """The LiDAR before it that this one repeats, in all of the scans that were looked at; None if there is none."""
        same = np.flatnonzero(self._same[number] == _LOOKED)
        return int(same[0]) if len(same) else None

    def _own(self, scan: Scan, number: int) -> NDArray[np.float64]:
        """(n, 3) points of one LiDAR in its own frame."""
        T = self._T[number]
        own: NDArray[np.float64] = (scan.p_lidar[scan.lidar == number].astype(np.float64) - T[:3, 3]) @ T[:3, :3]
        return own


def _of_first(scan: Scan, number: int) -> NDArray[np.float64]:
    """(n, 3) points of one LiDAR in the frame of the first one."""
    own: NDArray[np.float64] = scan.p_lidar[scan.lidar == number].astype(np.float64)
    return own
