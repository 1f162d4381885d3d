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

_FEWEST_TURNS = 2
_KNOWN_RAD = 0.1  # of an axis, by a stretch alone: what is known coarsely has errors that no number of stretches averages away
_ALIKE = 0.75  # of the stretches, that turn the same way
_DEVIATIONS = 3.0

Turn = tuple[NDArray[np.float64], NDArray[Any]]


def turn_from(fit: RotationFit, R_imu_lidar: NDArray[np.float64]) -> Turn:
    """The rotation (3,) from a mounting to the one that a stretch shows, about the IMU's axes, and its information (3, 3).

    Axes that the stretch does not know by itself have none.
    """
    variance, axes = np.linalg.eigh(fit.covariance[:3, :3])
    known = np.where(variance < _KNOWN_RAD**2, 1.0 / variance, 0.0)
    return so3.log(fit.closest_to(R_imu_lidar) @ R_imu_lidar.T), (axes * known) @ axes.T


def combined(turns: Sequence[Turn]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The mean turn (3,) of stretches, its standard deviations (3,) [rad], ascending, and their axes, one a column (3, 3)."""
    information = sum((known for _, known in turns), 1e-6 * np.eye(3))
    theta = np.linalg.solve(information, sum((known @ turn for turn, known in turns), np.zeros(3)))
    # Stretches that differ by more than they say know less than they say.
    scatter = sum(float((turn - theta) @ known @ (turn - theta)) for turn, known in turns) / (3.0 * max(len(turns) - 1, 1))
    variance, axes = np.linalg.eigh(np.linalg.inv(information))
    std: NDArray[np.float64] = np.sqrt(variance * max(scatter, 1.0))
    return np.asarray(theta, np.float64), std, axes


def least_turn(std: NDArray[np.float64]) -> float:
    """The smallest turn from a given mounting that is named, by the standard deviations of the axes that are known [rad]."""
    return float(LAG_RAD + _DEVIATIONS * np.linalg.norm(std))


def mounting_of_many(turns: Sequence[Turn]) -> Finding | None:
    """Whether stretches that do not overlap show another mounting than the one that was given.

    Args:
        turns: of each, from `turn_from`.
    """
    if len(turns) < _FEWEST_TURNS:
        return None
    theta, std, axes = combined(turns)
    seen = std < ROTATION_KNOWN_RAD
    off = (axes * seen) @ axes.T @ theta
    angle, sigma = float(np.linalg.norm(off)), float(np.linalg.norm(std[seen]))
    alike = np.mean([float(off @ known @ turn) > 0.5 * float(off @ known @ off) for turn, known in turns])
    if angle < least_turn(std[seen]) or alike < _ALIKE:
        return None
    return Finding(
        "extrinsic",
        f"in {len(turns)} stretches together gyroscope and LiDAR turn about axes {np.degrees(angle):.0f} deg apart under the "
        f"given T_imu_lidar (known to {np.degrees(sigma):.1f} deg); check it, and that the topics are those of this mounting",
    )
