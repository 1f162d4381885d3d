"""The start: attitude, velocity, biases and, with one camera, scale, from the first frames; or why there is none yet.

At rest: the mean angular rate is the gyroscope's bias, the mean specific force points up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, so3
from boxplus.sensors.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.tracks import Tracks

_STILL_ACCEL, _STILL_GYRO, _STILL_PX = 0.6, 0.06, 0.3  # m/s², rad/s: standard deviations; px from image to image


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """The states that the window begins with.

    The window takes all measurements from `time_ns[0]` on into account itself: the tracks of these frames, and the IMU samples
    between them. What the states are worth beside them, because of what was measured before, is `sigma`.

    Attributes:
        kind: how it was found.
        frames: (k,) which of the frames given became keyframes, ascending; one at least.
        time_ns: (k,) of them.
        T_world_imu: (k, 7) wxyz and xyz, z up, the first one at the origin with yaw 0.
        velocity_world: (k, 3) [m/s].
        gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s²].
        sigma: (15,) standard deviations of the first state before anything is measured from its time on, in the order
            `[θ, p, v, b_ω, b_a]`; position and yaw are made known by definition, whatever stands here.
        facts: the numbers of the tests it passed, by name and unit, for the report.
    """

    kind: Literal["at rest", "moving stereo", "moving mono"]
    frames: NDArray[np.intp]
    time_ns: NDArray[np.int64]
    T_world_imu: NDArray[np.float64]
    velocity_world: NDArray[np.float64]
    gyro_bias: NDArray[np.float64]
    accel_bias: NDArray[np.float64]
    sigma: NDArray[np.float64]
    facts: Mapping[str, float]


def find_start(seen: Sequence[Tracks], imu: ImuSamples, rig: Rig, config: VioConfig) -> Start | str:
    """The start from the frames so far, or a sentence that says which test failed, with its number.

    Args:
        seen: of the last seconds, in order of time; at least two.
        imu: strictly increasing samples that cover them, from before the first to the last.
        rig: one camera stands for mono.
    """
    last = seen[-1].time_ns
    first = last - round(config.start_duration * 1e9)
    chosen = (imu.time_ns >= first) & (imu.time_ns <= last)
    if imu.time_ns[0] > first or seen[0].time_ns > first:
        return f"{(last - max(seen[0].time_ns, imu.time_ns[0])) * 1e-9:.2f} s were seen so far, of {config.start_duration:g} s"
    gyro, accel = imu.gyro[chosen], imu.accel[chosen]
    motion = float(np.median([tracks.motion_px for tracks in seen if tracks.time_ns > first]))
    spread = float(accel.std(axis=0).max()), float(gyro.std(axis=0).max())
    if not (spread[0] < _STILL_ACCEL and spread[1] < _STILL_GYRO and motion < _STILL_PX):
        return f"not at rest: accelerometer {spread[0]:.3f} m/s², gyroscope {spread[1]:.4f} rad/s, images {motion:.2f} px"
    up = accel.mean(axis=0)
    size = float(np.linalg.norm(up))
    axis = np.cross(up / size, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = float(np.arctan2(sine, up[2] / size))
    R = so3.exp(axis / sine * angle) if sine > 1e-9 else np.eye(3)
    heading = np.arctan2(R[1, 0], R[0, 0])
    R = so3.exp(np.array([0.0, 0.0, -heading])) @ R
    sigma = np.concatenate([[0.02, 0.02, 1e-4], np.full(3, 1e-4), np.full(3, 0.02), np.full(3, 2e-3), np.full(3, 0.1)])
    return Start(
        kind="at rest",
        frames=np.array([len(seen) - 1]),
        time_ns=np.array([last]),
        T_world_imu=np.concatenate([quaternion.from_matrix(R), np.zeros(3)])[None],
        velocity_world=np.zeros((1, 3)),
        gyro_bias=gyro.mean(axis=0),
        accel_bias=up * (1.0 - config.gravity / size),
        sigma=sigma,
        facts={"accelerometer [m/s²]": spread[0], "gyroscope [rad/s]": spread[1], "images [px]": motion},
    )
