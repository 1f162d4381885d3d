"""Planes on which a direction of the pose hangs are to be borne out by more of the map than they were laid through.

Five points, or fifteen, of two scan lines always lie on some plane: the line on the ground and the one on a wall, for instance.
Such a plane moves with the sensor and holds it back. Among a thousand true planes it does no harm; where few of them measure a
direction, a handful of false ones decides it.

Least squares call the influence of a row on its own prediction its leverage, ℓ = w hᵀ A⁻¹ h; over all rows it sums up to the
number of unknowns. A row whose leverage is far above the mean is to be looked at before it is believed (Belsley, Kuh, Welsch,
Regression Diagnostics, 1980, section 2.1; Rousseeuw and van Zomeren, JASA 1990). Here that means: where the map's points are
sparser than its cells would have them, so that the lines of the scans show through, twenty-five neighbours have to lie on it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import PL, RL, P, R
from boxplus.filtering.plane_information import UNCONFIRMED, USED, pose_row
from boxplus.maps.ikd_tree.search import IkdView, copy_found, has_within, knn
from boxplus.maps.plane_matching import WEIGHT

CONFIRMING = 25
LEVERAGE = 3.0  # times the mean: about one plane in twenty exceeds it
# On a surface whose cells are all filled, the 25th neighbour of a point lies 2.8 cells away; 4 cells are half as dense.
DENSE_CELLS = 4.0


@kernel(inline=True)
def leverage_into(
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    plane: NDArray[np.float64],
    covariance: NDArray[np.float64],
    h: NDArray[np.float64],
    y: NDArray[np.float64],
) -> float:
    """The leverage of a plane with its weight, given the covariance (6, 6) of the pose.

    Args:
        x: (36,) state; p_lidar: (3,) the point, LiDAR frame; plane: (PLANE,).
        h: (12,) receives the row of the point, y: (3,) where it lies in the world.
    """
    lidar = (np.float64(p_lidar[0]), np.float64(p_lidar[1]), np.float64(p_lidar[2]))
    sx = x[RL] * lidar[0] + x[RL + 1] * lidar[1] + x[RL + 2] * lidar[2] + x[PL]
    sy = x[RL + 3] * lidar[0] + x[RL + 4] * lidar[1] + x[RL + 5] * lidar[2] + x[PL + 1]
    sz = x[RL + 6] * lidar[0] + x[RL + 7] * lidar[1] + x[RL + 8] * lidar[2] + x[PL + 2]
    pose_row(x, lidar, (sx, sy, sz), (plane[0], plane[1], plane[2]), False, h)
    half = 0.0
    for i in range(6):
        column = 0.5 * covariance[i, i] * h[i]
        for j in range(i):
            column += covariance[i, j] * h[j]
        half += column * h[i]
    y[0] = x[R] * sx + x[R + 1] * sy + x[R + 2] * sz + x[P]
    y[1] = x[R + 3] * sx + x[R + 4] * sy + x[R + 5] * sz + x[P + 1]
    y[2] = x[R + 6] * sx + x[R + 7] * sy + x[R + 8] * sz + x[P + 2]
    leverage: float = 2.0 * plane[WEIGHT] * half
    return leverage


@kernel
def confirm_planes(
    view: IkdView,
    origin: NDArray[np.float64],
    x: NDArray[np.float64],
    p_lidar: NDArray[np.float32],
    covariance: NDArray[np.float64],
    most_leverage: float,
    max_distance_sq: float,
    dense_sq: float,
    plane_threshold: float,
    planes: NDArray[np.float64],
    fate: NDArray[np.uint8],
    found_sq: NDArray[np.float32],
    stack: NDArray[np.void],
) -> int:
    """Refuse planes of high leverage that the map around them does not bear out; returns how many.

    Args:
        view, origin: the map; its coordinates are relative to `origin` (3,).
        x: (36,) state at which the planes were weighed.
        p_lidar: (n, 3) deskewed points, LiDAR frame.
        covariance: (6, 6) of the pose [θ, p] from all planes.
        most_leverage: of a plane that is believed without being looked at.
        max_distance_sq: squared distance within which neighbours are looked for [m²].
        dense_sq: squared distance of the last one up to which the map counts as filled there [m²].
        plane_threshold: largest distance of a neighbour from the plane [m].
        planes: (n, PLANE) records, with their weights.
        fate: (n,); planes that are refused change from USED to UNCONFIRMED.
        found_sq: (CONFIRMING,), stack: (STACK_DEPTH + CONFIRMING,), scratch.
    """
    wanted = len(found_sq)
    near = np.empty((wanted, 3), dtype=np.float32)
    h, y = np.zeros(12), np.empty(3)
    refused = 0
    for n in range(len(fate)):
        if fate[n] != USED:
            continue
        plane = planes[n]
        u = (plane[0], plane[1], plane[2])
        if not leverage_into(x, p_lidar[n], plane, covariance, h, y) > most_leverage:
            continue
        yx, yy, yz = np.float32(y[0] - origin[0]), np.float32(y[1] - origin[1]), np.float32(y[2] - origin[2])
        if has_within(view, yx, yy, yz, np.float32(dense_sq), wanted, stack):
            continue
        found = knn(view, yx, yy, yz, np.float32(max_distance_sq), found_sq, stack)
        copy_found(view, stack, wanted, found, near)
        offset = plane[3] - (u[0] * origin[0] + u[1] * origin[1] + u[2] * origin[2])
        for i in range(found):
            if not abs(u[0] * near[i, 0] + u[1] * near[i, 1] + u[2] * near[i, 2] - offset) <= plane_threshold:
                fate[n] = UNCONFIRMED
                refused += 1
                break
    return refused
