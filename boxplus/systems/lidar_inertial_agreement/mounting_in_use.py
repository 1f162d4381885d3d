"""A mounting that nobody declared, but that an estimator goes on with and corrects: contradicted, and cleared, by one test."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.agreement import ROTATION_KNOWN_RAD, Agreement, apart, apart_allowed
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_agreement.hypotheses import judges_rotation, matrix_text


def mounting_in_use(agreement: Agreement, T_in_use: NDArray[np.float64]) -> Finding | None:
    """What the rotations contradict of it, as far as they show it; with the axis about which it is off.

    Args:
        agreement: from `compare_sensors`.
        T_in_use: (4, 4) T_imu_lidar, assumed or estimated.
    """
    rotation = agreement.rotation
    if rotation is None or not judges_rotation(agreement):
        return None
    angle, seen = apart(rotation, T_in_use[:3, :3])
    if not seen.any() or angle < apart_allowed(rotation):
        return None
    known = rotation.rotation_std[1][:, seen]
    found = rotation.closest_to(T_in_use[:3, :3])
    x, y, z = known @ known.T @ so3.log(found @ T_in_use[:3, :3].T) / angle
    return Finding(
        "extrinsic",
        f"gyroscope and LiDAR turn about axes {np.degrees(angle):.0f} deg apart under the mounting in use, which nobody gave: it "
        f"began too far from the right one; give --T-imu-lidar (found: R_imu_lidar = {matrix_text(found)})",
        (float(x), float(y), float(z)),
    )


def shows_about(agreement: Agreement, axis: tuple[float, float, float]) -> bool:
    """Whether rotations show the mounting about an axis of the IMU: then it is right about it where they do not contradict it."""
    rotation, a = agreement.rotation, np.array(axis)
    if rotation is None or not judges_rotation(agreement):
        return False
    return float(a @ rotation.covariance[:3, :3] @ a) < ROTATION_KNOWN_RAD**2
