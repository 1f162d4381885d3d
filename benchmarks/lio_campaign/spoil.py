"""The one fault of a recording: what happens to its events, to its declared mounting, or on the command line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import Fault, faults, mounting

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
MOUNTING_FAULTS = ("inverted_extrinsic", "extrinsic_off", "other_lidar")
"""Without a declared mounting there is nothing wrong about it."""
READER_FAULTS = ("gyro_unit", "accel_unit", "time_unit")
"""Most of these go through a file, where the reader may see through them; in memory nothing stands between."""

_WRONG_OPTIONS = (
    ("gyro_unit", "deg/s"),
    ("accel_unit", "g"),
    ("point_time_unit", "ms"),
    ("point_time_unit", "us"),
    ("point_time_reference", "scan_end"),
)


@dataclass(frozen=True)
class Spoiling:
    """A fault, ready to be applied.

    Attributes:
        fault: changes of the events and of the declared mounting; None when there are none.
        detail: its parameters in words.
        recording_options: what the user says wrongly on the command line.
    """

    fault: Fault | None = None
    detail: str = ""
    recording_options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Setting:
    """What a fault may need to know of its recording.

    Attributes:
        begin_s: when a passing fault sets in [s].
        bag: it goes through a file.
        T_imu_lidar: (4, 4) the true mounting.
        other_imu: samples of an IMU on another body, see `faults.other_imu`.
    """

    begin_s: float
    bag: bool
    T_imu_lidar: NDArray[np.float64]
    other_imu: Callable[[int, int, int], ImuSamples]


def draw_spoiling(kind: str, setting: Setting, random: np.random.Generator) -> Spoiling:
    """The fault `kind` with parameters drawn at random; none for "none"."""
    if kind == "none":
        return Spoiling()
    if kind == "option":
        key, value = _WRONG_OPTIONS[int(random.integers(len(_WRONG_OPTIONS)))]
        return Spoiling(None, f"--{key.replace('_', '-')} {value}", {key: value})
    fault = _MAKERS[kind](setting, random)
    return Spoiling(fault, fault.description)


def deliver(extrinsic: str, fault: Fault | None, T_imu_lidar: NDArray[np.float64]) -> tuple[Fault, NDArray[np.float64] | None]:
    """Bring the mounting, true or as the fault has it, to the odometry.

    Args:
        extrinsic: "recorded", "given" as an option, or "absent".
        fault: of the recording, or None.
        T_imu_lidar: (4, 4) the true mounting.

    Returns:
        The fault with what the recording declares, and T_imu_lidar of the command line or None.
    """
    declared = T_imu_lidar if fault is None else fault.declared_extrinsic(T_imu_lidar)
    says = faults.declare(declared if extrinsic == "recorded" else None)
    return (says if fault is None else fault.then(says)), (declared if extrinsic == "given" else None)


def _sign(random: np.random.Generator) -> float:
    return float(random.choice((-1.0, 1.0)))


def _log_uniform(low: float, high: float, random: np.random.Generator) -> float:
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _gyro_unit(setting: Setting, random: np.random.Generator) -> Fault:
    return faults.gyro_in_deg() if setting.bag or random.uniform() < 0.5 else faults.gyro_in_rad_as_deg()


def _extrinsic_off(setting: Setting, random: np.random.Generator) -> Fault:
    axis, angle = random.standard_normal(3), float(random.uniform(5.0, 20.0))
    off = setting.T_imu_lidar.copy()
    off[:3, :3] = off[:3, :3] @ so3.exp(np.deg2rad(angle) * axis / np.linalg.norm(axis))
    return faults.declare(off, f"T_imu_lidar {angle:.1f} deg off")


def _other_lidar(setting: Setting, random: np.random.Generator) -> Fault:
    """The points come from a second LiDAR; what is declared is the mounting of the first one, which sits elsewhere."""
    first, turned = np.eye(4), bool(random.uniform() < 0.8)
    if turned:
        yaw = random.choice((90.0, 180.0, -90.0)) + random.uniform(-15.0, 15.0)
        first = mounting(random.uniform(-15.0, 15.0), random.uniform(-15.0, 15.0), yaw, (0.0, 0.0, 0.0))
    first = setting.T_imu_lidar @ first
    first[:3, 3] = setting.T_imu_lidar[:3, 3] + random.choice((-1.0, 1.0), 3) * random.uniform(0.1, 0.4, 3)
    return faults.declare(first, "a second LiDAR, turned and set off" if turned else "a second LiDAR, set off, not turned")


_MAKERS: dict[str, Callable[[Setting, np.random.Generator], Fault]] = {
    "gyro_unit": _gyro_unit,
    "accel_unit": lambda setting, random: faults.imu_in_g(),
    "time_unit": lambda setting, random: faults.wrong_time_unit(float(random.choice((1e-3, 1e3)))),
    "gyro_sign": lambda setting, random: faults.flip_gyro(),
    "accel_sign": lambda setting, random: faults.flip_accel(),
    "clock_offset": lambda setting, random: faults.clock_offset(_sign(random) * _log_uniform(0.02, 0.5, random)),
    "clock_drift": lambda setting, random: faults.clock_drift(_sign(random) * _log_uniform(0.001, 0.02, random)),
    "other_imu": lambda setting, random: faults.other_imu(setting.other_imu),
    "other_lidar": _other_lidar,
    "point_scale": lambda setting, random: faults.scale_points(float(random.choice((1.1, 0.9, 3.28084)))),
    "mirrored": lambda setting, random: faults.mirror_points(int(random.integers(3))),
    "imu_gap": lambda setting, random: faults.drop_imu(setting.begin_s, float(random.uniform(0.2, 2.0))),
    "nan_burst": lambda setting, random: faults.nan_burst(setting.begin_s, float(random.uniform(0.2, 1.0))),
    "inverted_extrinsic": lambda setting, random: faults.inverted_extrinsic(),
    "extrinsic_off": _extrinsic_off,
}
