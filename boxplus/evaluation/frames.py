"""Trajectories in other frames: moved from the left and the right, and laid into a plane."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from boxplus.errors import InputError
from boxplus.formats.trajectory import QUATERNION_TOLERANCE, Trajectory
from boxplus.manifolds import quaternion

Plane = Literal["xy", "xz", "yz"]

_KEYS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_FORMS = "'x,y,z' or 'x,y,z,qx,qy,qz,qw' [m], or a file with these as JSON, or with a 3×4 or 4×4 matrix"
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


def read_transform(given: str) -> NDArray[np.float64]:
    """A rigid transform from a command line: `x,y,z`, `x,y,z,qx,qy,qz,qw`, or the name of a file.

    A file holds these seven as JSON (as the field's tools have it), or the numbers of a 3×4 or 4×4 matrix row by row.

    Returns:
        (4, 4).

    Raises:
        InputError: none of these forms, a quaternion that is not of unit length, or a matrix that is no rigid transform.

    Example:
        >>> read_transform("0,0,1.5")[:3, 3].tolist()
        [0.0, 0.0, 1.5]
    """
    numbers = _numbers(given)
    T = np.eye(4)
    if len(numbers) in (12, 16):
        T[: len(numbers) // 4] = np.reshape(numbers, (-1, 4))
        off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
        if off > QUATERNION_TOLERANCE or np.linalg.det(T[:3, :3]) < 0.0 or T[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise InputError(
                "a rigid transform, a rotation matrix in it", f"one that is {off:.3g} off ({given})", "check the file"
            )
        T[:3, :3] = quaternion.to_matrix(quaternion.from_matrix(T[None, :3, :3]))[0]
        return T
    if len(numbers) not in (3, 7) or not np.isfinite(numbers).all():
        raise InputError(f"a transform: {_FORMS}", f"{given!r}", "correct it")
    T[:3, 3] = numbers[:3]
    if len(numbers) == 7:
        q_wxyz = np.array(numbers[3:])[[3, 0, 1, 2]]
        length = float(np.linalg.norm(q_wxyz))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            raise InputError("a unit quaternion qx,qy,qz,qw", f"length {length:.6g} ({given})", "check the order of the numbers")
        T[:3, :3] = quaternion.to_matrix(q_wxyz[None] / length)[0]
    return T


def _numbers(given: str) -> list[float]:
    """What a command line or the file that it names holds; none where it is neither."""
    path = Path(given)
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else given
        if text.lstrip().startswith("{"):
            content = json.loads(text)
            if content.get("scale", 1.0) != 1.0:
                raise InputError(
                    "a rigid transform", f"one with the scale {content['scale']} ({given})", "compare with --align sim3"
                )
            return [float(content[key]) for key in _KEYS]
        return [float(word) for word in text.replace(",", " ").split()]
    except (OSError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        return []
