"""Short simulated recordings with few rays, and the odometry run over them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.downsampling import VoxelFilter
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame, Sequencer
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar, simulate
from boxplus.simulation.motions import trajectories
from boxplus.simulation.worlds import sites, worlds
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

LIDAR = SpinningLidar(channels=16, azimuth_steps=150, vertical_fov_deg=(-30.0, 30.0))


def room_walk(duration_s: float = 5.0, seed: int = 0, imu: ImuModel | None = None) -> Simulation:
    """At rest for a moment, then on foot through a furnished room."""
    path = trajectories.walk(((-2.5, 0.5), (1.0, 0.5), (1.0, -2.5)), seed=seed)
    return simulate(Scenario("room_walk", worlds.room(seed=seed), path, LIDAR), seed, duration_s=duration_s, imu=imu)


def config(simulation: Simulation, **settings: object) -> LioConfig:
    """The default settings with the simulation's extrinsic."""
    T_imu_lidar = tuple(tuple(float(value) for value in row) for row in simulation.T_imu_lidar)
    return LioConfig.model_validate({"T_imu_lidar": T_imu_lidar, **settings})


def run(odometry: LidarInertialOdometry, events: Iterable[Scan | ImuSamples]) -> list[Estimate]:
    """Push everything, then flush."""
    estimates: list[Estimate] = []
    for event in events:
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    return estimates + odometry.flush()


def frames(events: Iterable[Scan | ImuSamples]) -> list[Frame]:
    """The frames of a recording."""
    sequencer = Sequencer()
    for event in events:
        if isinstance(event, Scan):
            sequencer.add_scan(event)
        else:
            sequencer.add_imu(event)
    return sequencer.frames(flush=True)


def position_errors(simulation: Simulation, estimates: list[Estimate]) -> np.ndarray:
    """Distances (N,) from the truth, with the first estimate laid on it (heading and position) [m]."""
    errors: np.ndarray = np.linalg.norm(_errors_world(simulation, estimates), axis=1)
    return errors


def deviations(simulation: Simulation, estimates: list[Estimate]) -> np.ndarray:
    """The same distances (N,) in standard deviations of the stated covariance along the error; 0 at the first, the datum."""
    errors = _errors_world(simulation, estimates)[1:]
    P = np.array([estimate.pose_covariance[3:, 3:] for estimate in estimates[1:]])
    return np.concatenate([[0.0], np.sqrt(np.einsum("ni,ni->n", errors, np.linalg.solve(P, errors[:, :, None])[:, :, 0]))])


def _errors_world(simulation: Simulation, estimates: list[Estimate]) -> np.ndarray:
    """(N, 3) in the world of the estimates [m]."""
    truth = simulation.ground_truth(np.array([e.time_ns for e in estimates]))
    R_align = estimates[0].state.R_world_imu @ truth.R_world_imu[0].T
    p = np.stack([e.state.p_world_imu for e in estimates])
    errors: np.ndarray = p - p[0] - (truth.p_world_imu - truth.p_world_imu[0]) @ R_align.T
    return errors


def before_a_wall(reach_m: float) -> tuple[list[Frame], LioConfig]:
    """At rest, with a cone of view that is full of one wall: a few dozen cells of 25 cm, each with hundreds of points."""
    lidar = RosetteLidar(points_per_scan=4000, rate_hz=10.0, fov_deg=80.0)
    motion = trajectories.at_rest(2.0, (1.6 - reach_m, -2.2, 1.3))
    simulation = simulate(Scenario("wall", sites.stairwell(), motion, lidar, T_imu_lidar=np.eye(4)), duration_s=1.6)
    first = frames(simulation.events())
    assert len(VoxelFilter(0.25)(first[0].scan.p_lidar)[0]) < 100
    return first, config(simulation)


def turning_by(seen: list[Frame], rate: np.ndarray) -> list[Frame]:
    """The frames with a gyroscope that turns by (3,) [rad/s] more."""
    return [replace(f, imu=ImuSamples(f.imu.time_ns, f.imu.gyro + rate, f.imu.accel)) for f in seen]
