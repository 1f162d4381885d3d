"""What registrations hold back of a motion that is no larger than their own error.

A map of noisy planes goes along with a platform that sways by a centimetre or half a degree, and a part of the motion is lost,
as regression dilutes what it is read off (Fuller, Measurement Error Models, 1987, section 1.1), however small the misfit. Sound
sensors that swayed once a second in a room came to these factors, 1 being right:

    accelerations of the LiDAR, by the accelerometer's   0.5 to 0.6 at 0.7 cm, 0.65 to 0.77 at 1.4, 0.7 to 0.85 at 2.8, 0.97 at 6
    turns of the gyroscope, by the LiDAR's               1.0 to 1.3 at 1 deg (n 0.3 to 0.6 deg), 1.00 to 1.07 at 2.3 deg

each said to be known to 0.01 to 0.08 by its noise alone. What may be lost, n² / (n² + s²), is a standard deviation of such a
factor beside: s the rms of positions or turns about their mean, n what a turn is known to, and 1 cm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath

_SHIFT_M = 0.01


def shifts_held_back(excursion_m: float) -> float:
    """The part that may be lost, 0 to 1, by the rms of the positions about their mean [m]."""
    return _diluted(_SHIFT_M**2, excursion_m**2)


def turns_held_back(path: LidarPath) -> float:
    """The same of the turns of a path about their mean, by what its registrations know of them."""
    turned = so3.log(path.R_path_lidar)
    known = np.linalg.pinv(path.information[1:, :3, :3], hermitian=True).trace(axis1=1, axis2=2) / 3.0
    return _diluted(float(np.median(known)), rms_about_mean(turned) ** 2)


def rms_about_mean(vectors: NDArray[np.float64]) -> float:
    """Of vectors (N, 3)."""
    return float(np.sqrt(((vectors - vectors.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _diluted(error_squared: float, signal_squared: float) -> float:
    return error_squared / max(error_squared + signal_squared, 1e-12)
