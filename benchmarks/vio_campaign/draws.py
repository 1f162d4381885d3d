"""What a seed stands for: world, motion, light, cameras, IMU and fault."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from draw_filter import Filtered
from imu_grades import IMU_GRADES, draw_imu

from boxplus.simulation import faults as imu_faults
from boxplus.simulation.cameras import (
    CameraFault,
    CameraRig,
    CameraScenario,
    CameraSimulation,
    Exposure,
    Light,
    make_camera_fault,
    make_camera_scenario,
    make_rig,
    write_camera_recording,
)
from boxplus.simulation.cameras import faults as camera_faults
from boxplus.simulation.cameras.scenarios import ROOM_HIGH, ROOM_LOW
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import Trajectory

MOTIONS = {
    "handheld": ("room", "warehouse"),
    "moving_start": ("room", "warehouse"),
    "drone": ("hall",),
    "climb": ("stairs",),
}
RIGS, LENSES = ("stereo", "mono"), ("radtan", "equidistant", "pinhole")
FAULTY_SHARE = 0.6
STEREO_FAULTS = ("swapped_cameras", "wrong_baseline", "bent_rig", "wrong_second_focal_length")
ROOM_FAULTS = ("rotation_at_start", "constant_velocity_start", "bare_walls")
"""Faults that bring their own motion or world, which belongs into a room."""
FAULT_KINDS = (
    "covered_lens", "darkness", "drop_frames", "swapped_cameras", "wrong_baseline", "bent_rig", "inverted_extrinsic",
    "imu_clock_offset", "other_imu", "rolling_shutter", *ROOM_FAULTS, "moving_object", "drop_imu", "imu_in_g", "gyro_in_deg",
    "flip_gyro",
)  # fmt: skip
"""That seeds draw from; what came later is asked for by name, so that a seed stays what it was."""
_SPANS = {
    "room": (ROOM_LOW, ROOM_HIGH),
    "warehouse": (np.array([-12.0, -1.0, 1.2]), np.array([12.0, 1.0, 2.2])),
}
_IMU_RATES_HZ = (100.0, 200.0, 400.0)


@dataclass(frozen=True)
class Kinds(Filtered):
    """What a seed is about, without its worlds and motions: cheap."""

    world: str
    motion: str
    rig: str
    lens: str
    light: str
    imu: str
    fault: str


@dataclass(frozen=True)
class Draw:
    """One random recording.

    Attributes:
        seed: everything below follows from it.
        kinds: for tables and filters.
        scenario: world, motion, light and sensors, without the fault.
        duration_s: length [s].
        fault: or None in a sound recording.
    """

    seed: int
    kinds: Kinds
    scenario: CameraScenario
    duration_s: float
    fault: CameraFault | None

    def truth(self) -> CameraSimulation:
        """The recording before anything is spoilt."""
        return CameraSimulation(self.scenario, self.seed, self.duration_s)

    def write(self, path: Path) -> Path:
        """The spoilt recording as a EuRoC folder, with images that need no library."""
        return write_camera_recording(self.truth(), path, "euroc", self.fault, images="pgm")


def draw_kinds(seed: int) -> Kinds:
    """The kinds of a seed."""
    random = np.random.Generator(np.random.PCG64([seed, 21]))
    motion = str(random.choice(list(MOTIONS)))
    world = str(random.choice(MOTIONS[motion]))
    rig, lens = str(random.choice(RIGS, p=(0.65, 0.35))), str(random.choice(LENSES, p=(0.6, 0.25, 0.15)))
    light = str(random.choice(("steady", "swinging", "jumping"), p=(0.6, 0.25, 0.15)))
    imu = str(random.choice(list(IMU_GRADES)))
    fault = str(random.choice(FAULT_KINDS)) if random.uniform() < FAULTY_SHARE else "none"
    return with_fault(Kinds(world, motion, rig, lens, light, imu, "none"), fault)


def with_fault(kinds: Kinds, fault: str) -> Kinds:
    """The same with this fault, and with the cameras, world and motion that it needs."""
    if fault in STEREO_FAULTS:
        kinds = replace(kinds, rig="stereo")
    if fault in ROOM_FAULTS:
        kinds = replace(kinds, world="room", motion="handheld")
    return replace(kinds, fault=fault)


def draw(seed: int, fault: str | None = None) -> Draw:
    """Everything about a seed, with a fault of another name where one is given."""
    kinds = draw_kinds(seed)
    return draw_of(seed, kinds if fault is None else with_fault(kinds, fault))


def draw_of(seed: int, kinds: Kinds) -> Draw:
    """Everything about a seed that is of these kinds."""
    random = np.random.Generator(np.random.PCG64([seed, 22]))
    duration_s = float(random.uniform(10.0, 14.0))
    rig = _rig(kinds, random)
    scenario = make_camera_scenario(kinds.world, seed, rig)
    light = Light(swing=float(random.uniform(0.2, 0.5)), period_s=float(random.uniform(3.0, 8.0)))
    scenario = replace(
        scenario,
        name=f"campaign {seed}",
        trajectory=_motion(kinds, scenario, duration_s, seed, random),
        imu=draw_imu(kinds.imu, _IMU_RATES_HZ, random),
        light=light if kinds.light == "swinging" else Light(),
    )
    begin_s = float(random.uniform(3.0, 0.5 * duration_s))
    return Draw(seed, kinds, scenario, duration_s, make_fault(kinds, begin_s, random))


def make_fault(kinds: Kinds, begin_s: float, random: np.random.Generator) -> CameraFault | None:
    """The fault of these kinds, with parameters of its own; what begins does so at `begin_s`."""
    return None if kinds.fault == "none" else _FAULTS.get(kinds.fault, _plain(kinds.fault))(begin_s, random, kinds)


def _rig(kinds: Kinds, random: np.random.Generator) -> CameraRig:
    rig = make_rig(kinds.rig, kinds.lens, float(random.choice((0.35, 0.5))), float(random.choice((10.0, 15.0, 20.0))))  # type: ignore[arg-type]
    changes = {"noise": float(random.uniform(0.5, 2.0)), "vignetting": float(random.uniform(0.0, 0.4)), "blur_samples": 5}
    cameras = tuple(camera.model_copy(update={"sensor": camera.sensor.model_copy(update=changes)}) for camera in rig.cameras)
    jumps = 0.3 if kinds.light == "jumping" else 0.0
    return rig.model_copy(update={"cameras": cameras, "exposure": Exposure(jumps=jumps)})


def _motion(kinds: Kinds, scenario: CameraScenario, duration_s: float, seed: int, random: np.random.Generator) -> Trajectory:
    length = duration_s + 1.0
    rest = float(random.uniform(0.5, 2.0))
    if kinds.motion == "drone":
        speed = float(random.uniform(1.0, 3.0))
        return manoeuvres.drone_within(length, (-9.0, -5.0, 1.5), (9.0, 5.0, 5.0), speed=speed, standstill_s=rest, seed=seed)
    if kinds.motion == "climb":
        return scenario.trajectory
    low, high = _SPANS[kinds.world]
    rest = 0.0 if kinds.motion == "moving_start" else rest
    speed, rate = float(random.uniform(0.6, 1.5)), float(random.uniform(0.5, 1.2))
    return manoeuvres.handheld(length, low, high, speed=speed, rate=rate, standstill_s=rest, seed=seed)


Maker = Callable[[float, np.random.Generator, Kinds], CameraFault]


def _plain(name: str) -> Maker:
    return lambda begin_s, random, kinds: make_camera_fault(name)


def _covered(begin_s: float, random: np.random.Generator, kinds: Kinds) -> CameraFault:
    camera = int(random.integers(0, 2)) if kinds.rig == "stereo" else 0
    return camera_faults.covered_lens(camera, begin_s, float(random.uniform(0.6, 4.0)))


def off_by(random: np.random.Generator, least: float, most: float) -> float:
    """Between `least` and `most`, of either sign."""
    return float(random.choice((-1.0, 1.0)) * random.uniform(least, most))


_FAULTS: dict[str, Maker] = {
    "covered_lens": _covered,
    "darkness": lambda begin, random, _: camera_faults.darkness(begin, float(random.uniform(0.6, 4.0))),
    "drop_frames": lambda begin, random, _: camera_faults.drop_frames(begin, float(random.uniform(0.4, 2.0))),
    "wrong_baseline": lambda _, random, __: camera_faults.wrong_baseline(float(np.exp(off_by(random, 0.1, 0.5)))),
    "bent_rig": lambda _, random, __: camera_faults.bent_rig(off_by(random, 0.7, 3.0)),
    "wrong_focal_length": lambda _, random, __: camera_faults.wrong_focal_length(float(np.exp(off_by(random, 0.04, 0.25)))),
    "wrong_second_focal_length": lambda _, random, __: camera_faults.wrong_focal_length(
        float(np.exp(off_by(random, 0.04, 0.25))), camera=1
    ),
    "imu_clock_offset": lambda _, random, __: camera_faults.imu_clock_offset(off_by(random, 0.02, 0.12)),
    "other_imu": lambda _, random, __: camera_faults.other_imu(int(random.integers(1000, 2000))),
    "rolling_shutter": lambda _, random, __: camera_faults.rolling_shutter(float(random.uniform(0.012, 0.03))),
    "moving_object": lambda begin, random, _: camera_faults.moving_object(begin, float(random.uniform(2.0, 6.0))),
    "drop_imu": lambda begin, random, _: camera_faults.of_imu(
        imu_faults.drop_imu(begin, float(random.uniform(0.3, 2.0))), ("missing", "gap")
    ),
}
