"""What a seed stands for: world, motion, sensors, mounting, fault, and how the recording reaches the odometry."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from draw_filter import Filtered
from imu_grades import IMU_GRADES, draw_imu
from numpy.typing import NDArray

from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, RosetteLidar, Scenario, Simulation, SpinningLidar, faults, mounting
from boxplus.simulation.lidar import LidarModel
from boxplus.simulation.motions import manoeuvres
from lio_campaign import hardly_moving, places, roads, unusual
from lio_campaign.places import DrawMotion, Place, make_motion
from lio_campaign.spoil import FAULT_KINDS, MOUNTING_FAULTS, READER_FAULTS, Setting, deliver, draw_spoiling

SENSORS = ("spinning16", "spinning32", "spinning64", "spinning128", "rosette")
EXTRINSICS = ("given", "recorded", "absent")

# What sensors of these kinds deliver: columns a turn by channels (the common modes of such sensors), points a second.
_COLUMNS = {16: 900, 32: 512, 64: 512, 128: 512}
_ROSETTE_POINTS_S = 200_000.0
FAULTY_SHARE = 0.5
_BAG_SHARE = 0.25
_IMU_RATES_HZ = (100.0, 125.0, 200.0, 250.0, 400.0)
_SHAKEN = ("vibration", "hover")  # by motors


@dataclass(frozen=True)
class Kinds(Filtered):
    """What a seed is about, without its worlds and motions: cheap.

    Attributes:
        world, motion, sensor, imu: kinds.
        extrinsic: "given" as an option, "recorded" in the recording, or "absent".
        fault: "none" is a sound recording.
        bag: "true" when it goes through a file.
        nuisance: what real recordings have besides (nuisances.py), joined by "+"; "none" without `rough`.
    """

    world: str
    motion: str
    sensor: str
    imu: str
    extrinsic: str
    fault: str
    bag: str
    nuisance: str = "none"


@dataclass(frozen=True)
class Draw:
    """One random recording.

    Attributes:
        seed: everything below follows from it.
        kinds: for tables and filters.
        detail: the parameters of the fault, in words.
        featureless: the world gives the LiDAR little to see.
        file_format: of the bag, where there is one.
        scenario: world, motion, sensors and true mounting.
        duration_s: length [s].
        spoiled: what happens to the stream of events and to the declared mounting.
        recording_options, T_imu_lidar: what the user says on the command line.
    """

    seed: int
    kinds: Kinds
    detail: str
    featureless: bool
    file_format: str
    scenario: Scenario
    duration_s: float
    spoiled: Fault
    recording_options: dict[str, Any] = field(default_factory=dict)
    T_imu_lidar: NDArray[np.float64] | None = None

    def truth(self) -> Simulation:
        """The recording before anything is spoilt, and its exact motion."""
        return _CastOnce(self.scenario, self.seed, self.duration_s)


class _CastOnce(Simulation):
    """A simulation that keeps its scans: an odometry reads the beginning of a recording several times."""

    def __init__(self, scenario: Scenario, seed: int, duration_s: float) -> None:
        super().__init__(scenario, seed, duration_s)
        self._scans: dict[int, Scan] = {}

    def scan(self, index: int) -> Scan:
        if index not in self._scans:
            self._scans[index] = super().scan(index)
        return self._scans[index]


def draw_kinds(seed: int, variety: str = "usual") -> Kinds:
    """The kinds of a seed, of one of `VARIETIES`."""
    of = VARIETIES[variety]
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    motion = str(random.choice(list(of.motions)))
    world = str(random.choice(of.motions[motion]))
    sensor = str(random.choice(of.sensors))
    imu = str(random.choice(list(IMU_GRADES)))
    extrinsic = str(random.choice(EXTRINSICS, p=(0.4, 0.4, 0.2)))
    fault = str(random.choice(FAULT_KINDS)) if random.uniform() < FAULTY_SHARE else "none"
    chance = random.uniform()
    bag = chance < _BAG_SHARE or fault == "option" or (fault in READER_FAULTS and chance < 0.7)
    if fault in MOUNTING_FAULTS and extrinsic == "absent":
        extrinsic = "recorded"
    return Kinds(world, motion, sensor, imu, extrinsic, fault, str(bag).lower())


def draw(seed: int, variety: str = "usual") -> Draw:
    """Everything about a seed, of one of `VARIETIES`."""
    of, kinds = VARIETIES[variety], draw_kinds(seed, variety)
    random = np.random.Generator(np.random.PCG64([seed, 2]))
    place = of.places[kinds.world](random)
    lidar, duration_s = of.lidar(kinds.sensor, random)
    trajectory = make_motion(of.motion, kinds.motion, kinds.world, place, duration_s, random)
    duration_s = min(duration_s, trajectory.duration_s)
    imu = draw_imu(kinds.imu, of.imu_rates_hz, random)
    if kinds.motion in _SHAKEN:
        strength, hz = random.uniform(0.7, 1.3), random.uniform(55.0, 90.0)
        imu = imu.model_copy(update={"accel_vibration": strength, "gyro_vibration": 0.02 * strength, "vibration_hz": hz})
    T_imu_lidar = of.mounting(kinds.extrinsic == "absent", random)
    scenario = Scenario(f"campaign {seed}", place.world, trajectory, lidar, imu, T_imu_lidar)
    bag, file_format = kinds.bag == "true", str(random.choice(("ros2", "ros1")))
    begin_s = float(random.uniform(4.0, 0.6 * duration_s))
    other = _other_body(scenario, place, seed, duration_s)
    spoiling = draw_spoiling(kinds.fault, Setting(begin_s, bag, T_imu_lidar, other.imu_samples), random)
    fault = spoiling.fault
    if kinds.fault == "other_lidar" and fault is not None:
        # The declared mounting is that of the first LiDAR, the points come from the second one.
        second = fault.declared_extrinsic(T_imu_lidar)
        assert second is not None
        scenario, fault = replace(scenario, T_imu_lidar=second), faults.declare(T_imu_lidar)
    spoiled, option = deliver(kinds.extrinsic, fault, scenario.T_imu_lidar)
    return Draw(
        seed=seed,
        kinds=kinds,
        detail=spoiling.detail,
        featureless=place.featureless,
        file_format=file_format,
        scenario=scenario,
        duration_s=duration_s,
        spoiled=spoiled,
        recording_options=spoiling.recording_options,
        T_imu_lidar=option,
    )


def _other_body(scenario: Scenario, place: Place, seed: int, duration_s: float) -> Simulation:
    """Somebody else in the same place, with the same kind of IMU."""
    other = manoeuvres.handheld(duration_s + 1.0, place.low, place.high, 1.0, 1.2, 2.0, seed=seed + 1)
    return Simulation(replace(scenario, trajectory=other), seed + 1, duration_s)


def _lidar(sensor: str, random: np.random.Generator) -> tuple[LidarModel, float]:
    """The sensor and how long to record [s]: fewer seconds at the higher rate."""
    fast = bool(random.uniform() < 0.35)
    rate = 20.0 if fast else 10.0
    duration_s = float(random.uniform(12.0, 15.0) if fast else random.uniform(14.0, 25.0))
    sigma, reach = float(random.uniform(0.01, 0.03)), float(random.uniform(60.0, 120.0))
    if sensor == "rosette":
        fov = float(random.uniform(60.0, 90.0))
        count = int(_ROSETTE_POINTS_S / rate)
        rosette = RosetteLidar(rate_hz=rate, range_sigma_m=sigma, max_range=reach, points_per_scan=count, fov_deg=fov)
        return rosette, duration_s
    channels = int(sensor.removeprefix("spinning"))
    fov = {16: (-15.0, 15.0), 32: (-25.0, 15.0), 64: (-22.5, 22.5), 128: (-45.0, 45.0)}[channels]
    steps = _COLUMNS[channels]
    spinning = SpinningLidar(
        rate_hz=rate, range_sigma_m=sigma, max_range=reach, channels=channels, azimuth_steps=steps, vertical_fov_deg=fov
    )
    return spinning, duration_s


def _mounting(near: bool, random: np.random.Generator) -> NDArray[np.float64]:
    """A LiDAR near the IMU (within a hand-held device) or farther away, turned about the vertical at will, tilted a little."""
    reach = 0.08 if near else float(random.choice((0.08, 0.3)))
    yaw = random.uniform(-180.0, 180.0) if random.uniform() < 0.7 else random.uniform(-10.0, 10.0)
    roll, pitch = random.uniform(-8.0, 8.0, 2)
    return mounting(roll, pitch, yaw, tuple(random.uniform(-reach, reach, 3)))


@dataclass(frozen=True)
class Variety:
    """What one kind of campaign draws from.

    Attributes:
        what: in words.
        motions: the worlds that suit each motion.
        places: of the worlds.
        motion: draws one, which may be longer than asked for.
        sensors, lidar: names, and what draws one, with the length of its recording [s].
        imu_rates_hz: of the IMU.
        mounting: draws T_imu_lidar (4, 4), near the IMU or anywhere.
    """

    what: str
    motions: Mapping[str, tuple[str, ...]]
    places: Mapping[str, Callable[[np.random.Generator], Place]]
    motion: DrawMotion
    sensors: tuple[str, ...] = SENSORS
    lidar: Callable[[str, np.random.Generator], tuple[LidarModel, float]] = _lidar
    imu_rates_hz: tuple[float, ...] = _IMU_RATES_HZ
    mounting: Callable[[bool, np.random.Generator], NDArray[np.float64]] = _mounting


_USUAL = Variety("the usual", places.MOTIONS, places.PLACES, places.usual_motion)
VARIETIES = {
    "usual": _USUAL,
    "fast": Variety("on roads, at up to 33 m/s", roads.MOTIONS, roads.PLACES, roads.fast_motion),
    "still": Variety(
        "platforms that sway, hover, creep, float, pan, or stop again and again",
        hardly_moving.MOTIONS,
        places.PLACES,
        hardly_moving.hardly_moving,
    ),
    "odd": replace(
        _USUAL,
        what="with other LiDARs, mountings and rates of the IMU",
        sensors=unusual.SENSORS,
        lidar=unusual.lidar,
        imu_rates_hz=unusual.IMU_RATES_HZ,
        mounting=unusual.any_mounting,
    ),
}
"""What a campaign may draw from."""
