"""Run the odometry on the simulator, with or without a fault, and compare with the exact ground truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, ImuModel, Scenario, Simulation, SpinningLidar, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

SPARSE = SpinningLidar(azimuth_steps=600)
"""A third of the usual points: enough for every failure, and quick."""


@dataclass(frozen=True)
class Run:
    """What a run gave.

    Attributes:
        time_s: (n,) seconds since the start of the simulation; position_error: (n, 3) [m] in the simulated world;
            rotation_error_deg: (n,). The first pose is exact by definition.
    """

    simulation: Simulation
    odometry: LidarInertialOdometry
    estimates: list[Estimate]
    time_s: NDArray[np.float64]
    position_error: NDArray[np.float64]
    rotation_error_deg: NDArray[np.float64]

    @property
    def distance(self) -> NDArray[np.float64]:
        """(n,) length of the position error [m]."""
        return np.asarray(np.linalg.norm(self.position_error, axis=1))

    @property
    def status(self) -> Counter[str]:
        """How many scans ended with which status."""
        return Counter(estimate.status for estimate in self.estimates)

    @property
    def warnings(self) -> list[str]:
        """All warnings, in order."""
        return [text for estimate in self.estimates for text in estimate.warnings]

    def between(self, begin_s: float, end_s: float) -> list[int]:
        """Indices of the scans that end within [begin_s, end_s)."""
        return [int(i) for i in np.flatnonzero((self.time_s >= begin_s) & (self.time_s < end_s))]


def run(
    scenario: str | Scenario,
    duration_s: float | None = None,
    fault: Fault | None = None,
    lidar: SpinningLidar | None = None,
    imu: ImuModel | None = None,
    seed: int = 0,
    calibrated: bool = False,
) -> Run:
    """Push a simulation through the odometry, sample block by scan, as a driver would; `calibrated`: told that the gyroscope is.

    Raises:
        InputError: what the odometry raises.
    """
    simulation = simulate(scenario, seed, duration_s=duration_s, lidar=lidar, imu=imu)
    T_imu_lidar = simulation.T_imu_lidar if fault is None else fault.declared_extrinsic(simulation.T_imu_lidar)
    config = LioConfig(T_imu_lidar=T_imu_lidar.tolist())
    odometry = LidarInertialOdometry(config.model_copy(update={"gyro_scale_noise": 0.0}) if calibrated else config)
    estimates: list[Estimate] = []
    for event in simulation.events() if fault is None else fault.events(simulation.events()):
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    estimates += odometry.flush()
    time_ns = np.array([estimate.time_ns for estimate in estimates])
    truth = simulation.ground_truth(time_ns)
    R = np.array([estimate.state.R_world_imu for estimate in estimates])
    p = np.array([estimate.state.p_world_imu for estimate in estimates])
    aligned = truth.R_world_imu[0] @ R[0].T
    position_error = (p - p[0]) @ aligned.T + truth.p_world_imu[0] - truth.p_world_imu
    rotation_error = so3.log(np.swapaxes(aligned @ R, 1, 2) @ truth.R_world_imu)
    return Run(
        simulation,
        odometry,
        estimates,
        (time_ns - simulation.start_ns) * 1e-9,
        position_error,
        np.degrees(np.linalg.norm(rotation_error, axis=1)),
    )
