"""Does a part of the view move along with the camera: an arm of the platform, dirt on the lens, text in the images?

Its corners stand still while others move, though the gyroscope turns the camera by so much that every landmark has to move.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boxplus.recordings.cameras.info import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.sensors.inertial.imu import ImuSamples

Floats = NDArray[np.float64]

_STILL_PX, _MOVED_PX = 0.5, 5.0  # a corner, and what the rotation does to it
_OTHERS = 0.25  # share of the corners that move by more than twice as much as one that is still, or the images stand
_FEWEST = 200  # corners of all images
_MANY = 0.05  # share of the corners; landmarks for which a translation undoes the rotation are far fewer


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """Corners of two images: times [ns], and pixels (N, 2) in both."""

    begin_ns: int
    end_ns: int
    before: Floats
    after: Floats


def check_carried(camera: CameraStream, pairs: list[Followed], imu: ImuSamples) -> list[Evidence]:
    """A finding where much of what a camera shows is fixed to it; none otherwise, or where that cannot be told."""
    if camera.model is None or camera.T_body_camera is None:
        return []
    imu = imu.in_order()
    gyro = imu.gyro @ camera.T_body_camera[:3, :3]
    still = asked = 0
    for pair in pairs:
        first, last = np.searchsorted(imu.time_ns, (pair.begin_ns, pair.end_ns))
        moved = np.linalg.norm(pair.after - pair.before, axis=1)
        if last - first < 2 or not len(moved) or (moved > 2.0 * _STILL_PX).mean() < _OTHERS:
            continue
        rotvec = gyro[first:last].mean(axis=0) * (pair.end_ns - pair.begin_ns) * 1e-9
        rays, known = camera.model.unproject(pair.before)
        turned, seen = camera.model.project(rays @ Rotation.from_rotvec(rotvec).as_matrix())
        by_turn = known & seen & (np.linalg.norm(turned - pair.before, axis=1) > _MOVED_PX)
        asked += int(by_turn.sum())
        still += int((by_turn & (moved < _STILL_PX)).sum())
    if asked < _FEWEST or still < _MANY * asked:
        return []
    text = (
        f"{still} of {asked} corners stand still in the image while the gyroscope turns the camera and others move: a part of "
        "the platform is in view, dirt on the lens, text in the image, or the middle of a circle that the camera moves on"
    )
    return [Evidence(f"{camera.name}_carried", f"{still / asked:.0%}", "warning", text)]
