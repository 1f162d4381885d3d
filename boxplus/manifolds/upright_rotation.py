"""The rotation that sets a direction upright."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3


def upright_rotation(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The shortest rotation (3, 3) that takes a direction (3,) to +z; half a turn about x for −z.

    Rodrigues' formula about up × z (docs/lidar_inertial_odometry.md, section 10).

    Example:
        >>> np.round(upright_rotation(np.array([0.0, 2.0, 0.0])) @ [0.0, 1.0, 0.0], 6).tolist()
        [0.0, 0.0, 1.0]
    """
    up = up / np.linalg.norm(up)
    if up[2] < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    K = so3.hat(np.array([up[1], -up[0], 0.0]))
    rotation: NDArray[np.float64] = np.eye(3) + K + K @ K / (1.0 + up[2])
    return rotation
