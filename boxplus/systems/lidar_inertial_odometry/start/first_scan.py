"""The first scan, undistorted with the motion that the start has found."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.propagation import NODE, propagate_interval
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.sensors.sequencer import Frame
from boxplus.systems.lidar_inertial_odometry.config import LioConfig


def deskew_at_constant_velocity(frame: Frame, x: NDArray[np.float64], config: LioConfig) -> NDArray[np.float32]:
    """Deskew a frame with the gyro and the velocity in x (36,), and move x to the end of the scan."""
    free = NavState.unpack(x)
    weightless = free.pack()
    weightless[21:24] = 0.0
    time = (frame.imu.time_ns - frame.begin_ns) * 1e-9
    duration = (frame.scan.end_ns - frame.begin_ns) * 1e-9
    nodes = np.zeros((len(time) + 3, NODE))
    ones = np.ones(4)
    cov = np.eye(TANGENT)
    count = propagate_interval(
        weightless, cov, time, frame.imu.gyro, np.zeros_like(frame.imu.accel), duration, ones, config.max_imu_gap, ones, nodes
    )
    points = np.zeros_like(frame.scan.p_lidar)
    deskew_into(frame.scan.p_lidar, frame.scan.time_ns, frame.begin_ns, nodes, count, weightless, points)
    x[:21] = weightless[:21]
    return points


def deskew_first(frame: Frame, state: NavState, config: LioConfig) -> NDArray[np.float32]:
    """Deskew the first scan, whose END `state` describes: found by going back with the gyro and the velocity."""
    forward = NavState.identity().pack()
    forward[15:18] = state.bias_gyro
    deskew_at_constant_velocity(frame, forward, config)
    turned = forward[:9].reshape(3, 3)
    elapsed = (frame.scan.end_ns - frame.begin_ns) * 1e-9
    x = state.pack()
    x[:9] = (state.R_world_imu @ turned.T).ravel()
    x[9:12] = state.p_world_imu - state.v_world_imu * elapsed
    return deskew_at_constant_velocity(frame, x, config)
