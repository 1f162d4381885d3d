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
from boxplus.filtering.plane_information import UNCONFIRMED, USED
from boxplus.filtering.triples import Rotation, Triple, cross, placed, rotation_of, triple_of, turned_back
from boxplus.maps.ikd_tree.search import IkdView, copy_found, has_within, knn
from boxplus.maps.plane_matching import WEIGHT

CONFIRMING = 25
LEVERAGE = 3.0  # times the mean: about one plane in twenty exceeds it
# On a surface whose cells are all filled, the 25th neighbour of a point lies 2.8 cells away; 4 cells are half as dense.
DENSE_CELLS = 4.0


@kernel(inline=True, fastmath=True)
def leverage_of(weight: float, s: Triple, u: Triple, rotation: Rotation, covariance: NDArray[np.float64]) -> float:
    """The leverage w hᵀ P h of a plane, given the covariance P (6, 6) of the pose.

    Args:
        s: the point on it, IMU frame; u: its normal, world; rotation: R_world_imu.
    """
    turn = cross(s, turned_back(rotation, u))  # h = [s × Rᵀu, u] (docs/lidar_inertial_odometry.md, section 6)
    total = 0.0
    for i in range(3):
        of_turn = covariance[i, 0] * turn[0] + covariance[i, 1] * turn[1] + covariance[i, 2] * turn[2]
        of_place = covariance[3 + i, 3] * u[0] + covariance[3 + i, 4] * u[1] + covariance[3 + i, 5] * u[2]
        between = covariance[i, 3] * u[0] + covariance[i, 4] * u[1] + covariance[i, 5] * u[2]
        total += turn[i] * (of_turn + 2.0 * between) + u[i] * of_place
    return weight * total


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
    rotation, mounting, place, lever = rotation_of(x, R), rotation_of(x, RL), triple_of(x, P), triple_of(x, PL)
    refused = 0
    for n in range(len(fate)):
        if fate[n] != USED:
            continue
        plane = planes[n]
        u, s = triple_of(plane, 0), placed(mounting, lever, triple_of(p_lidar[n], 0))
        if not leverage_of(plane[WEIGHT], s, u, rotation, covariance) > most_leverage:
            continue
        y = placed(rotation, place, s)
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
