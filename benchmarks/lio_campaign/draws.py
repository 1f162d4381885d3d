"""What a seed stands for: world, motion, sensors, mounting, fault, and how the recording reaches the odometry."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.simulation import Fault, ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar, faults, manoeuvres, mounting
from boxplus.simulation.lidar import LidarModel
from lio_campaign.places import MOTIONS, PLACES, Place, make_motion

FAULT_KINDS = (
    "gyro_unit",
    "accel_unit",
    "time_unit",
    "gyro_sign",
    "accel_sign",
    "clock_offset",
    "clock_drift",
    "other_imu",
    "other_lidar",
    "point_scale",
    "option",
    "mirrored",
    "imu_gap",
    "nan_burst",
    "inverted_extrinsic",
    "extrinsic_off",
)
SENSORS = ("spinning16", "spinning32", "spinning64", "spinning128", "rosette")
EXTRINSICS = ("given", "recorded", "absent")

_POINTS = 8000
_FAULTY_SHARE = 0.5
_BAG_SHARE = 0.25
_READER_FAULTS = ("gyro_unit", "accel_unit", "time_unit")
"""Most of these go through a file, where the reader may see through them; in memory nothing stands between."""

# density of gyro [rad/s/√Hz] and accelerometer [m/s²/√Hz], walks of both biases, largest biases [rad/s], [m/s²]
_IMU_GRADES: dict[str, tuple[float, ...]] = {
    "tactical": (3e-5, 3e-4, 2e-6, 3e-5, 1e-3, 0.01),
    "industrial": (1.7e-4, 2e-3, 1.9e-5, 1e-3, 0.01, 0.06),
    "cheap": (4e-4, 4e-3, 5e-5, 2e-3, 0.03, 0.25),
}
_WRONG_OPTIONS = (
    ("gyro_unit", "deg/s"),
    ("accel_unit", "g"),
    ("point_time_unit", "ms"),
    ("point_time_unit", "us"),
    ("point_time_reference", "scan_end"),
)


@dataclass(frozen=True)
class Draw:
    """One random recording.

    Attributes:
        seed: everything below follows from it.
        world, motion, sensor, imu, extrinsic, fault: kinds, for tables and filters; fault "none" is a sound recording.
        detail: the parameters of the fault, in words.
        featureless: the world gives the LiDAR little to see.
        bag: the recording goes through a file.
        file_format: of that file.
        scenario: world, motion, sensors and true mounting.
        duration_s: length [s].
        spoiled: what happens to the stream of events and to the declared mounting.
        recording_options, T_imu_lidar: what the user says on the command line.
    """

    seed: int
    world: str
    motion: str
    sensor: str
    imu: str
    extrinsic: str
    fault: str
    detail: str
    featureless: bool
    bag: bool
    file_format: str
    scenario: Scenario
    duration_s: float
    spoiled: Fault | None
    recording_options: dict[str, Any] = field(default_factory=dict)
    T_imu_lidar: NDArray[np.float64] | None = None

    def kinds(self) -> dict[str, Any]:
        """What filters and tables go by."""
        names = ("world", "motion", "sensor", "imu", "extrinsic", "fault")
        return {name: getattr(self, name) for name in names} | {"bag": str(self.bag).lower()}

    def simulation(self) -> Simulation:
        """The recording before anything is spoilt, and the truth."""
        return Simulation(self.scenario, self.seed, self.duration_s)


@dataclass(frozen=True)
class Kinds:
    """What a seed is about, without its worlds and motions: cheap, for filters."""

    world: str
    motion: str
    sensor: str
    imu: str
    extrinsic: str
    fault: str
    bag: str

    def matches(self, only: dict[str, str]) -> bool:
        """Whether all `only` hold; KeyError names an unknown key."""
        mine = asdict(self)
        return all(mine[key] == value for key, value in only.items())


def draw_kinds(seed: int) -> Kinds:
    """The kinds of a seed."""
    random = np.random.Generator(np.random.PCG64([seed, 1]))
    motion = str(random.choice(list(MOTIONS)))
    world = str(random.choice(MOTIONS[motion]))
    sensor = str(random.choice(SENSORS))
    imu = str(random.choice(list(_IMU_GRADES)))
    extrinsic = str(random.choice(EXTRINSICS, p=(0.4, 0.4, 0.2)))
    fault = str(random.choice(FAULT_KINDS)) if random.uniform() < _FAULTY_SHARE else "none"
    chance = random.uniform()
    bag = chance < _BAG_SHARE or fault == "option" or (fault in _READER_FAULTS and chance < 0.7)
    if fault in ("inverted_extrinsic", "extrinsic_off", "other_lidar") and extrinsic == "absent":
        extrinsic = "recorded"
    return Kinds(world, motion, sensor, imu, extrinsic, fault, str(bag).lower())


def draw(seed: int) -> Draw:
    """Everything about a seed."""
    kinds = draw_kinds(seed)
    random = np.random.Generator(np.random.PCG64([seed, 2]))
    place = PLACES[kinds.world](random)
    lidar, duration_s = _lidar(kinds.sensor, random)
    trajectory = make_motion(kinds.motion, kinds.world, place, duration_s, random)
    duration_s = min(duration_s, trajectory.duration_s)
    imu = _imu(kinds.imu, random)
    if kinds.motion == "vibration":
        strength, hz = random.uniform(0.7, 1.3), random.uniform(55.0, 90.0)
        imu = imu.model_copy(update={"accel_vibration": strength, "gyro_vibration": 0.02 * strength, "vibration_hz": hz})
    T_imu_lidar = _mounting(kinds.extrinsic == "absent", random)
    scenario = Scenario(f"campaign {seed}", place.world, trajectory, lidar, imu, T_imu_lidar)
    made = Draw(
        seed=seed,
        world=kinds.world,
        motion=kinds.motion,
        sensor=kinds.sensor,
        imu=kinds.imu,
        extrinsic=kinds.extrinsic,
        fault=kinds.fault,
        detail="",
        featureless=place.featureless,
        bag=kinds.bag == "true",
        file_format=str(random.choice(("ros2", "ros1"))),
        scenario=scenario,
        duration_s=duration_s,
        spoiled=None,
    )
    return _declared(_spoil(made, place, random))


def _lidar(sensor: str, random: np.random.Generator) -> tuple[LidarModel, float]:
    """The sensor and how long to record [s]: fewer seconds at the higher rate."""
    fast = bool(random.uniform() < 0.35)
    rate = 20.0 if fast else 10.0
    duration_s = float(random.uniform(12.0, 15.0) if fast else random.uniform(14.0, 25.0))
    sigma, reach = float(random.uniform(0.01, 0.03)), float(random.uniform(60.0, 120.0))
    if sensor == "rosette":
        fov = float(random.uniform(60.0, 90.0))
        rosette = RosetteLidar(rate_hz=rate, range_sigma_m=sigma, max_range=reach, points_per_scan=_POINTS, fov_deg=fov)
        return rosette, duration_s
    channels = int(sensor.removeprefix("spinning"))
    fov = {16: (-15.0, 15.0), 32: (-25.0, 15.0), 64: (-22.5, 22.5), 128: (-45.0, 45.0)}[channels]
    steps = _POINTS // channels
    spinning = SpinningLidar(
        rate_hz=rate, range_sigma_m=sigma, max_range=reach, channels=channels, azimuth_steps=steps, vertical_fov_deg=fov
    )
    return spinning, duration_s


def _imu(grade: str, random: np.random.Generator) -> ImuModel:
    gyro, accel, gyro_walk, accel_walk, gyro_bias, accel_bias = _IMU_GRADES[grade]
    return ImuModel(
        rate_hz=float(random.choice((100.0, 125.0, 200.0, 250.0, 400.0))),
        gyro_noise_density=gyro,
        accel_noise_density=accel,
        gyro_bias_walk=gyro_walk,
        accel_bias_walk=accel_walk,
        gyro_bias=tuple(random.uniform(-gyro_bias, gyro_bias, 3)),
        accel_bias=tuple(random.uniform(-accel_bias, accel_bias, 3)),
    )


def _mounting(near: bool, random: np.random.Generator) -> NDArray[np.float64]:
    """A LiDAR near the IMU (within a hand-held device) or farther away, turned about the vertical at will, tilted a little."""
    reach = 0.08 if near else float(random.choice((0.08, 0.3)))
    yaw = random.uniform(-180.0, 180.0) if random.uniform() < 0.7 else random.uniform(-10.0, 10.0)
    roll, pitch = random.uniform(-8.0, 8.0, 2)
    return mounting(roll, pitch, yaw, tuple(random.uniform(-reach, reach, 3)))


def _spoil(made: Draw, place: Place, random: np.random.Generator) -> Draw:
    """The draw with its fault."""
    fault = made.fault
    begin = float(random.uniform(4.0, 0.6 * made.duration_s))
    if fault == "none":
        return made
    if fault == "option":
        key, value = _WRONG_OPTIONS[int(random.integers(len(_WRONG_OPTIONS)))]
        return replace(made, recording_options={key: value}, detail=f"--{key.replace('_', '-')} {value}")
    if fault == "other_lidar":
        return _second_lidar(made, random)
    spoiled: Fault
    if fault == "gyro_unit":
        spoiled = faults.gyro_in_deg() if made.bag or random.uniform() < 0.5 else faults.gyro_in_rad_as_deg()
    elif fault == "accel_unit":
        spoiled = faults.imu_in_g()
    elif fault == "time_unit":
        spoiled = faults.wrong_time_unit(float(random.choice((1e-3, 1e3))))
    elif fault == "gyro_sign":
        spoiled = faults.flip_gyro()
    elif fault == "accel_sign":
        spoiled = faults.flip_accel()
    elif fault == "clock_offset":
        spoiled = faults.clock_offset(float(random.choice((-1.0, 1.0)) * np.exp(random.uniform(np.log(0.02), np.log(0.5)))))
    elif fault == "clock_drift":
        spoiled = faults.clock_drift(float(random.choice((-1.0, 1.0)) * np.exp(random.uniform(np.log(0.001), np.log(0.02)))))
    elif fault == "other_imu":
        low, high = np.array(place.low), np.array(place.high)
        other = manoeuvres.handheld(made.duration_s + 1.0, low, high, 1.0, 1.2, 2.0, seed=made.seed + 1)
        body = Simulation(replace(made.scenario, trajectory=other), made.seed + 1, made.duration_s)
        spoiled = faults.other_imu(body.imu_samples)
    elif fault == "point_scale":
        spoiled = faults.scale_points(float(random.choice((1.1, 0.9, 3.28084))))
    elif fault == "mirrored":
        spoiled = faults.mirror_points(int(random.integers(3)))
    elif fault == "imu_gap":
        spoiled = faults.drop_imu(begin, float(random.uniform(0.2, 2.0)))
    elif fault == "nan_burst":
        spoiled = faults.nan_burst(begin, float(random.uniform(0.2, 1.0)))
    elif fault == "inverted_extrinsic":
        spoiled = faults.inverted_extrinsic()
    elif fault == "extrinsic_off":
        axis = random.standard_normal(3)
        angle = float(random.uniform(5.0, 20.0))
        off = made.scenario.T_imu_lidar.copy()
        off[:3, :3] = off[:3, :3] @ so3.exp(np.deg2rad(angle) * axis / np.linalg.norm(axis))
        spoiled = faults.declare(off, f"T_imu_lidar {angle:.1f} deg off")
    else:
        raise ValueError(fault)
    return replace(made, spoiled=spoiled, detail=spoiled.description)


def _second_lidar(made: Draw, random: np.random.Generator) -> Draw:
    """The points come from a second LiDAR, mounted otherwise; what is declared is the mounting of the first."""
    first, second = made.scenario.T_imu_lidar, np.eye(4)
    turned = random.uniform() < 0.8
    if turned:
        yaw = random.choice((90.0, 180.0, -90.0)) + random.uniform(-15.0, 15.0)
        second = mounting(random.uniform(-15.0, 15.0), random.uniform(-15.0, 15.0), yaw, (0.0, 0.0, 0.0))
    second = first @ second
    second[:3, 3] = first[:3, 3] + random.choice((-1.0, 1.0), 3) * random.uniform(0.1, 0.4, 3)
    spoiled = faults.declare(first, "a second LiDAR, turned and set off" if turned else "a second LiDAR, set off, not turned")
    return replace(made, scenario=replace(made.scenario, T_imu_lidar=second), spoiled=spoiled, detail=spoiled.description)


def _declared(made: Draw) -> Draw:
    """Bring the mounting to the odometry: as an option, by the recording, or not at all."""
    if made.extrinsic == "recorded":
        return made
    T_imu_lidar = made.scenario.T_imu_lidar
    declared = T_imu_lidar if made.spoiled is None else made.spoiled.declared_extrinsic(T_imu_lidar)
    silent = faults.declare(None, "no T_imu_lidar")
    spoiled = silent if made.spoiled is None else made.spoiled.then(silent)
    return replace(made, spoiled=spoiled, T_imu_lidar=declared if made.extrinsic == "given" else None)
