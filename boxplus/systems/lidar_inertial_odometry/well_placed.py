"""Which points of a scan go into the map while the platform is where it began: those that lie where they seem to.

A rotation that is known to σ places a point at the range r to r σ. Where the surroundings leave the rotation open, as a field
does to a sensor at rest, a quarter of a degree is 20 cm at 45 m, and the same for all points of a scan: rings of neighbouring
scans come to lie beside each other at heights that differ by that, and planes through both stand steeply on level ground. They
are false, look certain, and turn the platform as soon as it moves.

Near where it began nothing is lost without such points: the first scans hold what is to be seen from there. Elsewhere all points
go in. On the way the rotation against the first pose is ever less known, about the vertical above all, while that against the
last scans is; a map that took nothing in for it would run dry, and what could tell the rotation would never come into it.

Derivation: docs/lidar_inertial_odometry.md, section 9.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import NavState

NEAR_M = 3.0  # of where the odometry began
LARGEST_SIGMA_M = 0.1  # what the tilt of a plane is taken to be worth of a map point (`filtering.plane_information`)


def well_placed(
    p_world: NDArray[np.float64], state: NavState, cov: NDArray[np.float64], p_began: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Points (m, 3) whose place the uncertainty of the rotation moves by no more than `LARGEST_SIGMA_M`; `NEAR_M` away, all.

    That of the position moves all points of a scan alike, and bends none of its planes.

    Args:
        p_world: (n, 3) points at the estimated pose, world frame [m].
        state: by which they came there.
        cov: (24, 24) its covariance, with the mounting known: one that is not moves the IMU, and not what the LiDAR sees.
        p_began: (3,) where the odometry began [m].

    Returns:
        The same array where all of them are, as in nearly every scan.

    Example:
        >>> p_world = np.array([[10.0, 0.0, 0.0], [60.0, 0.0, 0.0]])
        >>> state, cov = NavState.identity(), np.zeros((24, 24))
        >>> cov[:3, :3] = np.deg2rad(0.2) ** 2 * np.eye(3)
        >>> well_placed(p_world, state, cov, np.zeros(3))
        array([[10.,  0.,  0.]])
    """
    if math.dist(state.p_world_imu.tolist(), p_began.tolist()) > NEAR_M:
        return p_world
    placed = np.empty(len(p_world), np.bool_)
    turn = state.R_world_imu @ cov[:3, :3] @ state.R_world_imu.T
    count = _are_placed(np.ascontiguousarray(p_world), state.p_world_imu, turn, placed)
    return p_world if count == len(p_world) else p_world[placed]


@kernel
def _are_placed(
    p_world: NDArray[np.float64], center: NDArray[np.float64], turn: NDArray[np.float64], placed: NDArray[np.bool_]
) -> int:
    """Which points (m, 3) a rotation about `center` of covariance `turn` (3, 3) moves by so little; how many."""
    total, count = turn[0, 0] + turn[1, 1] + turn[2, 2], 0
    for n in range(len(p_world)):
        x, y, z = p_world[n, 0] - center[0], p_world[n, 1] - center[1], p_world[n, 2] - center[2]
        along = turn[0, 0] * x * x + turn[1, 1] * y * y + turn[2, 2] * z * z
        along += 2.0 * (turn[0, 1] * x * y + turn[0, 2] * x * z + turn[1, 2] * y * z)
        placed[n] = total * (x * x + y * y + z * z) - along <= LARGEST_SIGMA_M**2  # of θ × r, over all three axes
        count += placed[n]
    return count
