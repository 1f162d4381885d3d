"""About which axes a path shows how the LiDAR turns: a cone of view full of one wall does not show a turn about its normal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.gyro_attitude import GyroAttitude
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

KNOWN_RAD = 0.02  # standard deviation of an attitude that is known
_BY_GYROSCOPE_RAD = 0.015  # the same of one that a gyroscope has carried on, on average over a second at a bias of 0.03 rad/s
_FORETOLD_M = 0.5  # standard deviation: what says less of a position is noise, and would take attitudes with it


def shown_turns(path: LidarPath) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The axes about which most poses of the newest segment know the attitude, and the others, (3, K) and (3, 3 − K).

    Unit vectors in columns, orthogonal, LiDAR frame. A path of a single pose knows none.
    """
    poses = np.flatnonzero(path.segment == path.segment[-1])[1:]
    if not len(poses):
        return np.zeros((3, 0)), np.eye(3)
    values, vectors = np.linalg.eigh(_of_attitude(path.information[poses]))
    # As far as each is known, 0 to 1: no pose makes up for another that knows nothing.
    share = np.clip(values * KNOWN_RAD**2, 0.0, 1.0)
    shares, axes = np.linalg.eigh(np.einsum("nij,nj,nkj->ik", vectors, share, vectors) / len(poses))
    known = shares > 0.5
    return axes[:, known], axes[:, ~known]


def turned_by_gyroscope(
    path: LidarPath, imu: ImuSamples, R_imu_lidar: NDArray[np.float64], bias: NDArray[np.float64]
) -> LidarPath:
    """The path with the turns about an axis that its poses do not show taken from the gyroscope, and known as well as by that.

    One axis, as the normal of a wall that fills the view: where poses show fewer than two, nothing holds the gyroscope against
    the LiDAR, and the path is returned as it is.

    Args:
        path: of one segment, a second or two long.
        imu: samples that cover it.
        R_imu_lidar: (3, 3) mounting.
        bias: (3,) of the gyroscope [rad/s], IMU frame.
    """
    shown, not_shown = shown_turns(path)
    if shown.shape[1] != 2:
        return path
    at = GyroAttitude(imu.time_ns, imu.gyro - bias).at(path.time_ns) @ R_imu_lidar
    R = path.R_path_lidar
    steps, by_gyroscope = (so3.log(np.swapaxes(M[:-1], 1, 2) @ M[1:]) for M in (R, at))
    steps += (by_gyroscope - steps) @ not_shown @ not_shown.T
    turned = [R[0]]
    for step in so3.exp(steps):
        turned.append(turned[-1] @ step)
    information = path.information.copy()
    information[1:, :3, :3] += not_shown @ not_shown.T / _BY_GYROSCOPE_RAD**2
    return replace(path, R_path_lidar=np.array(turned), information=information)


def _of_attitude(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3) what (n, 6, 6) say of the attitude, with the position known as well as a motion can be foretold."""
    about, both, position = information[:, :3, :3], information[:, :3, 3:], information[:, 3:, 3:]
    foretold = np.eye(3) / _FORETOLD_M**2
    found: NDArray[np.float64] = about - both @ np.linalg.solve(position + foretold, np.swapaxes(both, 1, 2))
    return found
