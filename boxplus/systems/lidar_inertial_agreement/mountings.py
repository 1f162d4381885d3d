"""How the LiDAR is mounted, by many stretches of a recording together.

A stretch of four seconds may know the mounting to a degree and a half, and five degrees are within what chance and the lag of
registrations make of that. They turn the same way in every stretch, chance does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.agreement import LAG_RAD, ROTATION_KNOWN_RAD
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.rotation import RotationFit

FEWEST_TURNS = 2
_DEVIATIONS = 3.0

Turn = tuple[NDArray[np.float64], NDArray[Any]]


def turn_from(fit: RotationFit, R_imu_lidar: NDArray[np.float64]) -> Turn:
    """The rotation (3,) from a mounting to the one that a stretch shows, about the IMU's axes, and its information (3, 3)."""
    return so3.log(fit.R_imu_lidar @ R_imu_lidar.T), np.linalg.inv(fit.covariance[:3, :3])


def mounting_of_many(turns: Sequence[Turn]) -> Finding | None:
    """Whether stretches that do not overlap show another mounting than the one that was given.

    Args:
        turns: of each, from `turn_from`.
    """
    if len(turns) < FEWEST_TURNS:
        return None
    information = sum((known for _, known in turns), np.zeros((3, 3)))
    theta = np.linalg.solve(information, sum((known @ turn for turn, known in turns), np.zeros(3)))
    # Stretches that differ by more than they say know less than they say.
    scatter = sum(float((turn - theta) @ known @ (turn - theta)) for turn, known in turns) / (3.0 * (len(turns) - 1))
    variance, axes = np.linalg.eigh(np.linalg.inv(information))
    std = np.sqrt(variance * max(scatter, 1.0))
    seen = std < ROTATION_KNOWN_RAD
    angle, sigma = float(np.linalg.norm((axes.T @ theta)[seen])), float(np.linalg.norm(std[seen]))
    if angle < LAG_RAD + _DEVIATIONS * sigma:
        return None
    return Finding(
        "extrinsic",
        f"in {len(turns)} stretches together gyroscope and LiDAR turn about axes {np.degrees(angle):.0f} deg apart under the "
        f"given T_imu_lidar (known to {np.degrees(sigma):.1f} deg); check it, and that the topics are those of this mounting",
    )
