"""Does a path speak against what was taken for up? Who moves on the ground moves in a level plane, or along a line of it.

Surfaces tell up within 45° of the LiDAR's z axis. One that is mounted on its side is given a wall for a floor: its path then lies
in an upright plane, through which it goes up and down as it went to and fro.
"""

from __future__ import annotations

import numpy as np

from boxplus.systems.slam.loop import Floats

_FEWEST = 4  # positions
_WIDE, _THIN = 0.2, 0.1  # its second extent of its first, at least, and its third of its second, at most: a plane, and no line
_STEEP = np.cos(np.deg2rad(45.0))  # of the plane's normal against up, at most
_LEAST_M = 2.0  # up and down: less is a step


def climb_within_upright_plane(p: Floats) -> float | None:
    """How far positions (n, 3), z up, go up and down [m] where they lie in one upright plane; None where they do not.

    Example:
        >>> angle = np.linspace(0.0, 6.0, 12)
        >>> climb_within_upright_plane(np.column_stack([8 * np.cos(angle), 0 * angle, 5 * np.sin(angle)])) > 9.0
        True
    """
    if len(p) < _FEWEST:
        return None
    _, extent, axes = np.linalg.svd(p - p.mean(axis=0), full_matrices=False)
    is_plane = extent[1] >= _WIDE * extent[0] and extent[2] <= _THIN * extent[1]
    climb = float(np.ptp(p[:, 2]))
    return climb if is_plane and abs(axes[2, 2]) < _STEEP and climb >= _LEAST_M else None
