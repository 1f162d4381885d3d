"""What the tests of refinement share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.refinement.collecting import OdometryRows
from boxplus.systems.refinement.finished_run import FinishedRun
from boxplus.systems.refinement.refinement import Refinement
from tests.systems.slam.drives import ate


@dataclass(frozen=True)
class Case:
    events: list[Scan | ImuSamples]
    rows: OdometryRows
    config: LioConfig
    simulation: Simulation
    T_true: NDArray[np.float64]  # of the rows
    run: FinishedRun
    refined: Refinement

    def error(self, T: NDArray[np.float64]) -> float:
        return ate(T[self.run.is_end][:, 4:], self.T_true[:, 4:])
