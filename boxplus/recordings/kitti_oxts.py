"""One file of the OXTS a sample: inertial measurements and positions (dataformat.txt of the KITTI raw data development kit)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.satellites.gnss import NO_FIX, GnssFixes

_COLUMNS = 30
_ACCEL, _GYRO = slice(11, 14), slice(17, 20)
_POSITION_ACCURACY, _POSITION_MODE = 23, 27
# Position modes (OxTS, NCOM Data Format, measurement modes). None, searching, no data, blanked; and velocities only, live and
# processed later (PP, gx, ix): the position is dead reckoning.
_WITHOUT_SATELLITES = (0, 1, 2, 10, 11, 12, 20, 25)
_DIFFERENTIAL = (4, 5, 6, 14, 15, 16, 22, 23, 24, 27, 28, 29)  # with a base station: DGPS, RTK float and integer, in all of these
_HEIGHT_FACTOR = 2.0  # what satellites tell of heights, against what they tell of places


def read_oxts(file: Path) -> NDArray[np.float64] | str:
    """Angular velocity [rad/s] and specific force [m/s²] (6,) of one file, along the IMU's axes; or why there is none."""
    values = _columns(file)
    return values if isinstance(values, str) else np.concatenate([values[_GYRO], values[_ACCEL]])


def oxts_fixes(files: Sequence[Path], time_ns: NDArray[np.int64]) -> GnssFixes:
    """The positions of these files; the accuracy they state holds for both horizontal axes, twice of it for the height."""
    positions, covariances, states = np.full((len(files), 3), np.nan), np.full((len(files), 3, 3), np.nan), []
    for row, file in enumerate(files):
        values = _columns(file)
        if isinstance(values, str):
            states.append(0)  # without a number it counts as not finite
            continue
        positions[row] = values[:3]
        sigma = float(values[_POSITION_ACCURACY])
        if sigma > 0.0:
            covariances[row] = sigma**2 * np.diag([1.0, 1.0, _HEIGHT_FACTOR**2])
        mode = values[_POSITION_MODE]  # NaN is none of these
        states.append(NO_FIX if mode in _WITHOUT_SATELLITES else 2 if mode in _DIFFERENTIAL else 0)
    return GnssFixes.from_arrays(time_ns, positions, covariances, np.array(states, np.int8))


def _columns(file: Path) -> NDArray[np.float64] | str:
    try:
        values = np.array(file.read_text(errors="replace").split(), dtype=np.float64)
    except (OSError, ValueError):
        return "unreadable oxts file"
    return values if len(values) >= _COLUMNS else f"oxts file without its {_COLUMNS} columns"
