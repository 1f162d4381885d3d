"""About which axes a path shows how the LiDAR turns: a cone of view full of one wall does not show a turn about its normal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from boxplus.systems.lidar_inertial_agreement.lidar_path.lidar_motion import LidarPath

KNOWN_RAD = 0.02  # standard deviation of an attitude that is known
_BY_GYROSCOPE_RAD = 0.015  # the same of one that a gyroscope carries on over a second: half a second at a bias of 0.03 rad/s
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


def turned_by_gyroscope(path: LidarPath) -> LidarPath:
    """The path with its attitudes as known as a gyroscope makes them, also where the surroundings do not show them.

    For a path of a second or two whose scans were undistorted and foretold with a gyroscope: it keeps what that says about the
    axes that no surface shows.
    """
    information = path.information.copy()
    information[:, :3, :3] += np.eye(3) / _BY_GYROSCOPE_RAD**2
    return replace(path, information=information)


def _of_attitude(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3) what (n, 6, 6) say of the attitude, with the position known as well as a motion can be foretold."""
    about, both, position = information[:, :3, :3], information[:, :3, 3:], information[:, 3:, 3:]
    foretold = np.eye(3) / _FORETOLD_M**2
    found: NDArray[np.float64] = about - both @ np.linalg.solve(position + foretold, np.swapaxes(both, 1, 2))
    return found
