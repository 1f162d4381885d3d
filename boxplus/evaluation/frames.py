"""Trajectories in other frames: moved from the left and the right, and laid into a plane."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion

Plane = Literal["xy", "xz", "yz"]

_NORMAL = {"xy": 2, "xz": 1, "yz": 0}


def transformed(trajectory: Trajectory, *, left: ArrayLike | None = None, right: ArrayLike | None = None) -> Trajectory:
    """The poses left · T_world_body · right, as those of another world and another body frame.

    Args:
        trajectory: poses T_world_body.
        left: (4, 4) T_other_world, or None.
        right: (4, 4) T_body_other: the pose of the other body frame in the one of the trajectory, or None.

    Returns:
        The moved trajectory; covariances are dropped, because they belong to the frames before.
    """
    if left is None and right is None:
        return trajectory
    R, p = trajectory.R, trajectory.p
    if right is not None:
        T = np.asarray(right, dtype=np.float64)
        R, p = R @ T[:3, :3], p + R @ T[:3, 3]
    if left is not None:
        T = np.asarray(left, dtype=np.float64)
        R, p = T[:3, :3] @ R, p @ T[:3, :3].T + T[:3, 3]
    return replace(trajectory, p=p, q_wxyz=quaternion.from_matrix(R), matrices=R, covariance=None, lines=None)


def projected(trajectory: Trajectory, plane: Plane | None) -> Trajectory:
    """The trajectory laid into a plane of its world: the third coordinate is zero, and so are turns out of the plane.

    The angle that stays is, in xy, the heading of the body's x axis (yaw); in xz the direction of its x axis; in yz the roll.
    Covariances are dropped.
    """
    if plane is None:
        return trajectory
    R, normal = trajectory.R, _NORMAL[plane]
    sine, cosine = {"xy": (R[:, 1, 0], R[:, 0, 0]), "xz": (-R[:, 2, 0], R[:, 0, 0]), "yz": (R[:, 2, 1], R[:, 2, 2])}[plane]
    half = 0.5 * np.arctan2(sine, cosine)
    q_wxyz = np.zeros((len(trajectory), 4))
    q_wxyz[:, 0], q_wxyz[:, 1 + normal] = np.cos(half), np.sin(half)
    p = trajectory.p.copy()
    p[:, normal] = 0.0
    return replace(trajectory, p=p, q_wxyz=q_wxyz, matrices=None, covariance=None, lines=None)
