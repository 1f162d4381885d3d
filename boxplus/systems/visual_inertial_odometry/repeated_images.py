"""Images that a driver or a recording delivers again, with a new stamp.

No two images that a sensor takes of something with contrast are the same to the bit: its noise is not. Taken for new ones they
say that nothing moves, and the odometry would stop while its IMU goes on. A source without noise (rendered, or coded by what
changed) has equal images at rest as well, and those are true: so equal images count as repeated only while the IMU moves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STRIDE = 16  # rows that are compared first
_LEAST_CONTRAST = 5.0  # standard deviation of grey values as recorded, below which there is nothing to see
_TURN_RAD_S, _FORCE = 0.1, 0.5  # rad/s; m/s², off from gravity: more than at rest, whatever the biases
_SPEED, _WAY, _TURN_PX = 0.05, 0.01, 0.5  # m/s, m, px: of a motion that is known

Floats = NDArray[np.float64]


class RepeatedImages:
    """Remembers the last image of each camera that was new."""

    def __init__(self) -> None:
        self._last: dict[int, NDArray[Any]] = {}

    def among(self, images: dict[int, NDArray[Any]]) -> set[int]:
        """The cameras whose image (H, W) is the one before."""
        return {camera for camera, image in images.items() if _same(image, self._last.get(camera))}

    def keep(self, images: dict[int, NDArray[Any]]) -> None:
        """These were new, or taken for new."""
        self._last.update(images)


def _same(image: NDArray[Any], before: NDArray[Any] | None) -> bool:
    if before is None or not np.array_equal(image[::_STRIDE], before[::_STRIDE]) or not np.array_equal(image, before):
        return False
    return float(image[::_STRIDE].std()) > _LEAST_CONTRAST


def imu_moves(gyro: Floats, accel: Floats, gravity: float) -> bool:
    """Whether samples (n, 3) [rad/s], [m/s²] were taken in motion, as far as that shows without their biases."""
    if not len(gyro):
        return False
    turn, force = np.linalg.norm(gyro.mean(axis=0)), np.linalg.norm(accel.mean(axis=0))
    return bool(turn > _TURN_RAD_S or abs(force - gravity) > _FORCE)


def is_motion(angle: float, way: Floats, velocity: Floats, focal_px: float) -> bool:
    """Whether a camera that turned by an angle [rad] and went a way (3,) [m], with a velocity (3,) [m/s] by now, moves."""
    return bool(focal_px * angle > _TURN_PX or np.linalg.norm(way) > _WAY or np.linalg.norm(velocity) > _SPEED)
