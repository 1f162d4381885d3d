"""Does a LiDAR look along the same directions again and again?

Rings, and frames that are drawn line by line, lie where they lay the scan before: what they make of a smooth wall goes along with
them, and passes for a surface that faces the way. A narrow view that is filled by ever other curves draws no such thing twice.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.maps.plane_measurement import sees_one_way
from boxplus.sensors.lidar.scan import Scan

_BEFORE, _POINTS, _FEWEST = (
    4,
    1000,
    200,
)  # scans that the last one is compared with, its points that are asked, and fewer: unknown
_TURNS_RAD = (0.006, 0.024)  # half the distance between rings that are close together, and between those that are not
_FARTHER = 1.25  # times the distance of directions that recur, when they are turned; of those that do not, 1.1
_LEAST_RANGE_M, _CELL = 0.1, 0.01  # m; rad


def recurs(scans: Sequence[Scan]) -> bool:
    """Whether the last of some consecutive scans looks where one of the four before it looked; also where that is not known.

    Directions that recur lie on the earlier ones, and off them when both are turned against each other by half a degree; others
    lie as far from them either way. Asked of sensors that see one way only: among rings whose azimuths come as they like, and
    points that were corrected for motion before, the difference gets lost, as it does of lines that are as close as their points.

    Args:
        scans: as they were measured, LiDAR frame.
    """
    if len(scans) < 2 or not sees_one_way(scans[-1].p_lidar):
        return True
    *before, asked = [_directions(scan) for scan in scans[-_BEFORE - 1 :]]
    if any(len(seen) < _FEWEST for seen in (*before, asked)):
        return True
    asked = asked[:: -(-len(asked) // _POINTS)]
    turned = [asked @ so3.exp(angle * axis) for angle in _TURNS_RAD for axis in np.eye(3)]
    for seen in before:
        tree = IkdTree(seen, cell_size=_CELL)
        as_it_is = _distance(tree, asked)
        if max(_distance(tree, other) for other in turned) > _FARTHER * as_it_is:
            return True
    return False


def _directions(scan: Scan) -> NDArray[np.float64]:
    """Unit vectors (n, 3) towards the points that are not at the sensor itself."""
    ranges = np.linalg.norm(scan.p_lidar.astype(np.float64), axis=1)
    away = ranges > _LEAST_RANGE_M
    return np.asarray(scan.p_lidar[away] / ranges[away, None], dtype=np.float64)


def _distance(tree: IkdTree, directions: NDArray[np.float64]) -> float:
    return float(np.median(tree.nearest(directions, 1).distances))
