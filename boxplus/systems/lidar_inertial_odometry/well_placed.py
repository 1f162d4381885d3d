"""Which points of a scan go into the map: those that lie where they seem to.

A rotation that is known to σ places a point at the range r to r σ. Where the surroundings leave the rotation open, as a field
does to a sensor at rest, a quarter of a degree is 20 cm at 45 m, and the same for all points of a scan: rings of neighbouring
scans come to lie beside each other at heights that differ by that, and planes through both stand steeply on level ground. They
are false, look certain, and turn the platform as soon as it moves. Points near enough go in all the same, and the others once a
scan has told the rotation.

Derivation: docs/lidar_inertial_odometry.md, section 9.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import NavState

LARGEST_SIGMA_M = 0.1  # what the tilt of a plane is taken to be worth of a map point (`filtering.plane_information`)


def well_placed(p_world: NDArray[np.float64], state: NavState, cov: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (m, 3) whose place the uncertainty of the rotation moves by no more than `LARGEST_SIGMA_M`.

    That of the position moves all points of a scan alike, and bends none of its planes.

    Args:
        p_world: (n, 3) points at the estimated pose, world frame [m].
        state: by which they came there.
        cov: (24, 24) its covariance, with the mounting known: one that is not moves the IMU, and not what the LiDAR sees.

    Returns:
        The same array where all of them are, as in nearly every scan.

    Example:
        >>> p_world = np.array([[10.0, 0.0, 0.0], [60.0, 0.0, 0.0]])
        >>> state, cov = NavState.identity(), np.zeros((24, 24))
        >>> cov[:3, :3] = np.deg2rad(0.2) ** 2 * np.eye(3)
        >>> well_placed(p_world, state, cov)
        array([[10.,  0.,  0.]])
    """
    turn = state.R_world_imu @ cov[:3, :3] @ state.R_world_imu.T
    r = p_world - state.p_world_imu
    squared = np.einsum("ni,ni->n", r, r)
    total = float(np.trace(turn))
    if total * float(squared.max(initial=0.0)) <= LARGEST_SIGMA_M**2:
        return p_world
    variance = total * squared - np.einsum("ni,ni->n", r @ turn, r)  # of θ × r, over all three axes
    placed: NDArray[np.float64] = p_world[variance <= LARGEST_SIGMA_M**2]
    return placed
