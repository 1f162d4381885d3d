"""Small fast simulated platforms to compare LiDAR and IMU of."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.faults import Event
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.simulation.motions.trajectories import START_NS, control_times
from boxplus.simulation.scenarios import mounting
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath, Twist
from boxplus.systems.lidar_inertial_odometry.config import LioConfig

CONFIG = LioConfig()  # type: ignore[call-arg]
LIDAR = SpinningLidar(channels=12, azimuth_steps=150)
FINE = SpinningLidar(channels=32, azimuth_steps=400)
LOW, HIGH = (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5)

Data = tuple[list[Scan], ImuSamples]


@lru_cache(maxsize=8)
def handheld(seed: int, seconds: float = 6.0, speed: float = 1.0, rate: float = 1.5, lidar: SpinningLidar = LIDAR) -> Simulation:
    """A hand that swings and carries a LiDAR through a room of 12 x 9 x 4 m, mounted anyhow."""
    random = np.random.default_rng(seed)
    T = mounting(*random.uniform(-180.0, 180.0, 3), tuple(random.uniform(-0.2, 0.2, 3)))
    motion = manoeuvres.handheld(seconds, LOW, HIGH, speed, rate, standstill_s=0.0, seed=seed)
    return Simulation(Scenario("handheld", worlds.room(seed=seed), motion, lidar, ImuModel(), T), seed, seconds)


def swaying(
    seed: int, p_mean: tuple[float, float, float], shift_m: float, turn_rad: float, seconds: float = 4.5
) -> SplineTrajectory:
    """Along some direction and about some axis, once a second, as a hand that holds still does."""
    random, time_s = np.random.default_rng(seed), control_times(seconds, 0.05)
    along, about = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    swing = [np.sin(2.0 * np.pi * time_s + phase)[:, None] for phase in random.uniform(0.0, 2.0 * np.pi, 2)]
    p = np.array(p_mean) + shift_m * swing[0] * along
    return SplineTrajectory(START_NS, 0.05, so3.exp(turn_rad * swing[1] * about), p)


def data(simulation: Simulation, fault: Fault | None = None) -> Data:
    """Scans and samples, spoilt by a fault."""
    events = list(simulation.events() if fault is None else fault.events(simulation.events()))
    blocks = [event for event in events if isinstance(event, ImuSamples)]
    joined = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("time_ns", "gyro", "accel"))
    return [event for event in events if isinstance(event, Scan)], ImuSamples(*joined)


def corrected(simulation: Simulation, end: bool) -> Fault:
    """Points as the LiDAR would have seen them at the end of their scan, or its beginning, with the times they had."""

    def events(incoming: Iterable[Event]) -> Iterator[Event]:
        for event in incoming:
            if isinstance(event, Scan):
                time_ns = np.append(event.time_ns, event.end_ns if end else event.start_ns)
                R, p = true_poses(simulation, np.clip(time_ns, simulation.start_ns, simulation.end_ns))
                p_world = np.einsum("nij,nj->ni", R[:-1], event.p_lidar) + p[:-1]
                event = replace(event, p_lidar=((p_world - p[-1]) @ R[-1]).astype(np.float32))
            yield event

    return Fault("corrected", f"points corrected to the {'end' if end else 'beginning'} of their scan", events)


def true_poses(simulation: Simulation, time_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    motion, T = simulation.ground_truth(time_ns), simulation.T_imu_lidar
    R = motion.R_world_imu @ T[:3, :3]
    return R, motion.p_world_imu + motion.R_world_imu @ T[:3, 3]


def true_path(simulation: Simulation, scans: list[Scan]) -> LidarPath:
    time_ns = np.array([(scan.start_ns + scan.end_ns) // 2 for scan in scans])
    R, p = true_poses(simulation, time_ns)
    K = len(scans)
    flags, zeros = np.zeros(K, dtype=bool), np.zeros(K, dtype=np.int64)
    return LidarPath(time_ns, R, p, np.tile(1e6 * np.eye(6), (K, 1, 1)), zeros, flags, np.zeros(K), np.zeros(K), 0)


def true_twists(simulation: Simulation, scans: list[Scan], factor: float = 1.0) -> list[Twist]:
    found = []
    for scan in scans:
        R, p = true_poses(simulation, np.array([scan.start_ns, scan.end_ns]))
        seconds = (scan.end_ns - scan.start_ns) * 1e-9
        found.append((factor * so3.log(R[0].T @ R[1]) / seconds, factor * R[1].T @ (p[1] - p[0]) / seconds))
    return found


def turned(T: NDArray[np.float64], degrees: float, seed: int) -> NDArray[np.float64]:
    """A mounting (4, 4) that is off by an angle about a random axis."""
    axis = np.random.default_rng(seed).normal(size=3)
    wrong = T.copy()
    wrong[:3, :3] = so3.exp(np.deg2rad(degrees) * axis / np.linalg.norm(axis)) @ T[:3, :3]
    return wrong
