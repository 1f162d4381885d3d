"""What figures over time need of a run, whatever its sensors."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from boxplus.runs.storage.row_log import RowLog


class Timeline(Protocol):
    """N estimates of a run."""

    @property
    def seconds(self) -> NDArray[np.float64]:
        """(N,) since the first one [s]."""

    @property
    def position(self) -> NDArray[np.float64]:
        """(N, 3) of the IMU in the world [m]."""

    @property
    def sigma(self) -> NDArray[np.float64]:
        """(N, 6) standard deviations of the pose: rotation [rad], position [m]."""

    @property
    def status(self) -> NDArray[np.str_]:
        """(N,) ok, weak or lost."""

    @property
    def log(self) -> RowLog:
        """Everything else, with the columns velocity, bias_gyro, bias_accel, their sigmas, total_ms, and timing_ms."""

    @property
    def map_points(self) -> NDArray[np.float32]:
        """(M, 3) a thinned map, world frame [m]."""
