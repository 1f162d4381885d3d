"""The start: attitude, velocity, biases and, with one camera, scale, from the first frames; or why there is none yet.

At rest: the mean angular rate is the gyroscope's bias, the mean specific force points up.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.sensors.imu import ImuSamples
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.rig import Rig
from boxplus.systems.visual_inertial_odometry.tracks import Tracks


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
    return f"{len(seen)} frames and {len(imu)} IMU samples of {len(rig.cameras)} cameras, {config.start_duration:g} s are needed"
