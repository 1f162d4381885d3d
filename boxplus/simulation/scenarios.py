"""The built-in scenarios: a world, a motion through it, and the sensors on board."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from boxplus._settings import suggestion
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.simulation.imu import ImuModel
from boxplus.simulation.lidar import LidarModel, OmniLidar, RosetteLidar, SpinningLidar
from boxplus.simulation.motions import trajectories
from boxplus.simulation.motions.spline import SplineTrajectory, Trajectory
from boxplus.simulation.worlds import worlds
from boxplus.simulation.worlds.world import World


def mounting(roll_deg: float, pitch_deg: float, yaw_deg: float, p_imu_lidar: tuple[float, float, float]) -> NDArray[np.float64]:
    """T_imu_lidar (4, 4) of a LiDAR turned by yaw, pitch and roll (about z, y, x, in this order) at `p_imu_lidar` [m]."""
    T_imu_lidar = np.eye(4)
    for axis, angle in ((2, yaw_deg), (1, pitch_deg), (0, roll_deg)):
        T_imu_lidar[:3, :3] = T_imu_lidar[:3, :3] @ so3.exp(np.deg2rad(angle) * np.eye(3)[axis])
    T_imu_lidar[:3, 3] = p_imu_lidar
    return T_imu_lidar


@dataclass(frozen=True, slots=True)
class Scenario:
    """Everything a simulation is made from.

    Attributes:
        name: short name.
        world: what there is to see.
        trajectory: motion of the IMU.
        lidar, imu: the sensors.
        T_imu_lidar: (4, 4) LiDAR coordinates to IMU coordinates.
    """

    name: str
    world: World
    trajectory: Trajectory
    lidar: SpinningLidar | RosetteLidar | OmniLidar = field(default_factory=SpinningLidar)
    imu: ImuModel = field(default_factory=ImuModel)
    T_imu_lidar: NDArray[np.float64] = field(default_factory=lambda: mounting(1.5, -2.0, 25.0, (0.06, -0.03, 0.11)))


_WALK_ROUTE = ((48.0, 0.0), (120.0, 0.0), (120.0, 21.0))
_WALK_ARCADES = ((62.0, -3.0, 116.8, 3.0), (117.0, 3.2, 123.0, 50.0))
_BELLY = mounting(0.0, 90.0, 0.0, (0.03, 0.01, -0.08))
_LIVOX = RosetteLidar(max_range=120.0)


def _walk(seed: int) -> Scenario:
    # From an open square (a large map) through a covered alley (few points a scan) and across a crossing.
    world = worlds.city(2, 2, pitch=60.0, street=6.0, squares={(0, 0), (0, -1)}, arcades=_WALK_ARCADES, seed=seed)
    return Scenario("walk", world, trajectories.walk(_WALK_ROUTE, seed=seed), SpinningLidar())


def _walk_livox(seed: int) -> Scenario:
    return replace(_walk(seed), name="walk_livox", lidar=_LIVOX)


def _drive(seed: int) -> Scenario:
    world = worlds.city(4, 3, pitch=75.0, seed=seed)
    lidar = SpinningLidar(channels=32, azimuth_steps=1200, vertical_fov_deg=(-25.0, 15.0), max_range=120.0)
    T_imu_lidar = mounting(-1.0, 2.0, -15.0, (0.6, 0.1, 0.4))
    return Scenario("drive", world, _drive_trajectory(seed), lidar, T_imu_lidar=T_imu_lidar)


def _drive_trajectory(seed: int) -> SplineTrajectory:
    return trajectories.drive(((5.0, -1.8), (223.2, -1.8), (223.2, 148.2), (133.0, 148.2)), seed=seed)


def _moving_start(seed: int) -> Scenario:
    return replace(_drive(seed), name="moving_start", trajectory=_drive_trajectory(seed).starting_at(9.0))


def _drive30(seed: int) -> Scenario:
    count, pitch = 10, 78.0
    world = worlds.city(count, count, pitch=pitch, seed=seed)
    low, high = -1.8, count * pitch - 1.8
    # Every street from west to east or back, going north; then every street from north to south or back, going west.
    route: list[tuple[float, float]] = []
    for row in range(count + 1):
        y = row * pitch - 1.8
        route += [(low, y), (high, y)] if row % 2 == 0 else [(high, y), (low, y)]
    for column in range(count + 1):
        x = high - column * pitch
        route += [(x, high), (x, low)] if column % 2 == 0 else [(x, low), (x, high)]
    route = [corner for corner, before in zip(route, [None, *route], strict=False) if corner != before]
    base = _drive(seed)
    lidar = base.lidar.model_copy(update={"channels": 16})
    return replace(base, name="drive30", world=world, trajectory=trajectories.drive(route, seed=seed), lidar=lidar)


def _corridor(seed: int) -> Scenario:
    walk = trajectories.walk(((-30.0, 0.0), (30.0, 0.0)), seed=seed)
    return Scenario("corridor", worlds.corridor(), walk)


def _spin(seed: int) -> Scenario:
    return Scenario("spin", worlds.room(seed=seed), trajectories.spin_in_place())


def _stress_flips(seed: int) -> Scenario:
    world = worlds.room((14.0, 11.0, 5.0), seed=seed)
    return Scenario(
        "stress_flips", world, trajectories.flips(p_world_imu=(0.0, 0.0, 2.6)), T_imu_lidar=mounting(0, 0, 0, (0.03, 0.0, 0.05))
    )


def _stress_fast(seed: int) -> Scenario:
    return Scenario("stress_fast", worlds.hall(seed=seed), trajectories.fast())


def _stress_drone(seed: int) -> Scenario:
    return Scenario("stress_drone", worlds.yard(seed=seed), trajectories.drone(), _LIVOX, T_imu_lidar=_BELLY)


def _at_rest(seed: int) -> Scenario:
    return Scenario("at_rest", worlds.room(seed=seed), trajectories.at_rest())


SCENARIOS: dict[str, tuple[str, Callable[[int], Scenario]]] = {
    "walk": ("90 m on foot through a city, 16 channels at 10 Hz, IMU at 200 Hz", _walk),
    "walk_livox": ("the same walk with a non-repetitive LiDAR of 70 degrees", _walk_livox),
    "drive": ("450 m by car through streets, 32 channels", _drive),
    "drive30": ("more than 30 minutes by car, always new streets, 16 channels", _drive30),
    "moving_start": ("the drive without its standstill: recording begins at speed", _moving_start),
    "corridor": ("60 m through a smooth corridor: motion along it cannot be measured", _corridor),
    "spin": ("turning at 90 deg/s on the spot in a room", _spin),
    "stress_flips": ("flips at 1000 deg/s in a room", _stress_flips),
    "stress_fast": ("7 m/s with swings of 100 deg/s in a hall", _stress_fast),
    "stress_drone": ("a drone over a cargo yard, a small-field LiDAR looking down", _stress_drone),
    "at_rest": ("no motion, in a room", _at_rest),
}
"""Name → description and maker (from a seed)."""


def make_scenario(name: str, seed: int = 0) -> Scenario:
    """A built-in scenario.

    Raises:
        InputError: no scenario of that name.
    """
    if name not in SCENARIOS:
        raise InputError("the name of a scenario", repr(name), suggestion(name, SCENARIOS, "scenario"))
    return SCENARIOS[name][1](seed)


__all__ = ["SCENARIOS", "LidarModel", "Scenario", "make_scenario", "mounting"]
