"""Whether cameras and IMU move: images that come again (`sensors.images.repeated_images`) are true at rest only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TURN_RAD_S, _FORCE = 0.1, 0.5  # rad/s; m/s², off from gravity: more than at rest, with the biases of a sensor in order
_SPEED, _WAY, _TURN_PX = 0.05, 0.01, 0.5  # m/s, m, px: of a motion that is known

Floats = NDArray[np.float64]


def imu_moves(gyro: Floats, accel: Floats, gravity: float) -> bool:
    """Whether samples (n, 3) [rad/s], [m/s²] were taken in motion, as far as that shows without their biases."""
    if not len(gyro):
        return False
    turn, force = np.linalg.norm(gyro.mean(axis=0)), np.linalg.norm(accel.mean(axis=0))
    return bool(turn > _TURN_RAD_S or abs(force - gravity) > _FORCE)


def is_motion(angle: float, way: Floats, velocity: Floats, focal_px: float) -> bool:
    """Whether a camera that turned by an angle [rad] and went a way (3,) [m], with a velocity (3,) [m/s] by now, moves."""
    return bool(focal_px * angle > _TURN_PX or np.linalg.norm(way) > _WAY or np.linalg.norm(velocity) > _SPEED)
