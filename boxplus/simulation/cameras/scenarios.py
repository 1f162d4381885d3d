"""Recordings of cameras: a world and what its surfaces look like, a motion through it, the light, and a rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._settings import Settings, suggestion
from boxplus.errors import InputError
from boxplus.simulation import scenarios
from boxplus.simulation.cameras.sensor import CameraRig, make_rig
from boxplus.simulation.imu import ImuModel
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import Solid, World

Movers = Callable[[float, NDArray[np.float64], NDArray[np.float64]], Sequence[Solid]]
"""From the time since the start [s] and the IMU's pose R_world_imu (3, 3), p_world_imu (3,) to what else is in the world then."""


class Light(Settings):
    """How bright the world is over time; 1 is day."""

    swing: float = Field(0.0, ge=0, lt=1, description="the light rises and falls by this share")
    period_s: float = Field(6.0, gt=0, description="of the swing [s]")
    dark_from_s: float = Field(np.inf, ge=0, description="when the light goes out [s]")
    dark_for_s: float = Field(2.0, ge=0, description="for how long [s]")
    dark_level: float = Field(5e-4, ge=0, le=1, description="what is left of the light then")

    def at(self, since_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Brightness (N,) at times (N,) since the start [s]."""
        light = 1.0 + self.swing * np.sin(2.0 * np.pi * since_s / self.period_s)
        dark = (since_s >= self.dark_from_s) & (since_s < self.dark_from_s + self.dark_for_s)
        return np.where(dark, self.dark_level * light, light)


@dataclass(frozen=True, slots=True)
class CameraScenario:
    """Everything a simulated recording of cameras is made from.

    Attributes:
        name: short name.
        world: what there is to see; a LiDAR sees the same.
        trajectory: motion of the body, that of the IMU.
        rig: the cameras.
        imu: the inertial sensor.
        pixel_m: side of a pixel of the pictures on the surfaces [m].
        contrast: of these pictures, 1 as usual, 0 for bare walls.
        light: over time.
        movers: what moves in the world, or None.
        imu_trajectory: motion of an IMU that is not on the body of the cameras, or None.
    """

    name: str
    world: World
    trajectory: Trajectory
    rig: CameraRig = field(default_factory=make_rig)
    imu: ImuModel = field(default_factory=ImuModel)
    pixel_m: float = 0.005
    contrast: float = 1.0
    light: Light = field(default_factory=Light)
    movers: Movers | None = None
    imu_trajectory: Trajectory | None = None


ROOM_LOW, ROOM_HIGH = np.array([-2.6, -1.9, 1.0]), np.array([2.6, 1.9, 2.1])
"""Corners of the part of `room` in which hand-held cameras move [m]."""
_LENGTH_S = 30.0


def _room(seed: int) -> CameraScenario:
    motion = manoeuvres.handheld(_LENGTH_S, ROOM_LOW, ROOM_HIGH, speed=1.1, rate=0.9, seed=seed)
    return CameraScenario("room", worlds.room((9.0, 7.5, 3.2), seed=seed), motion, pixel_m=0.004)


def _room_moving(seed: int) -> CameraScenario:
    motion = manoeuvres.handheld(_LENGTH_S, ROOM_LOW, ROOM_HIGH, speed=1.1, rate=0.9, standstill_s=0.0, seed=seed)
    return replace(_room(seed), name="room_moving", trajectory=motion)


def _room_light(seed: int) -> CameraScenario:
    light = Light(swing=0.5, period_s=5.0)
    return replace(_room(seed), name="room_light", light=light)


def _hall(seed: int) -> CameraScenario:
    motion = manoeuvres.drone_within(_LENGTH_S, (-9.0, -5.0, 1.5), (9.0, 5.0, 5.0), speed=2.5, seed=seed)
    return CameraScenario("hall", worlds.hall((36.0, 24.0, 9.0), seed=seed), motion, pixel_m=0.01)


def _warehouse(seed: int) -> CameraScenario:
    motion = manoeuvres.handheld(_LENGTH_S, (-12.0, -1.0, 1.2), (12.0, 1.0, 2.2), speed=1.4, rate=0.7, seed=seed)
    return CameraScenario("warehouse", sites.warehouse(seed=seed), motion, pixel_m=0.006)


def _stairs(seed: int) -> CameraScenario:
    return CameraScenario("stairs", sites.stairwell(), manoeuvres.climb(_LENGTH_S, seed=seed), pixel_m=0.003)


CAMERA_SCENARIOS: dict[str, tuple[str, Callable[[int], CameraScenario]]] = {
    "room": ("30 s hand-held in a furnished room, 2 s of rest first", _room),
    "room_moving": ("the same, in full motion from the first image on", _room_moving),
    "room_light": ("the same, while the light rises and falls by a half", _room_light),
    "hall": ("30 s of flight through a factory hall", _hall),
    "warehouse": ("30 s hand-held in an aisle between racks", _warehouse),
    "stairs": ("a climb up a stairwell", _stairs),
}
"""Name → description and maker (from a seed). The scenarios of the LiDAR may be filmed as well."""

_PIXELS_OUTDOORS_M = {
    "walk": 0.01,
    "walk_livox": 0.01,
    "drive": 0.015,
    "drive30": 0.015,
    "moving_start": 0.015,
    "stress_drone": 0.012,
}


def make_camera_scenario(name: str, seed: int = 0, rig: CameraRig | None = None) -> CameraScenario:
    """A built-in scenario, or one of the LiDAR seen with cameras.

    Raises:
        InputError: no scenario of that name.
    """
    if name in CAMERA_SCENARIOS:
        made = CAMERA_SCENARIOS[name][1](seed)
    elif name in scenarios.SCENARIOS:
        filmed = scenarios.make_scenario(name, seed)
        pixel_m = _PIXELS_OUTDOORS_M.get(name, 0.005)
        made = CameraScenario(name, filmed.world, filmed.trajectory, imu=filmed.imu, pixel_m=pixel_m)
    else:
        known = (*CAMERA_SCENARIOS, *scenarios.SCENARIOS)
        raise InputError("the name of a scenario", repr(name), suggestion(name, known, "scenario"))
    return made if rig is None else replace(made, rig=rig)
