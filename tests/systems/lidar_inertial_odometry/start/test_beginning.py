"""What a start has to go by."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Frame
from boxplus.simulation import SpinningLidar, simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.start.beginning import Beginning


@pytest.fixture(scope="module")
def frame() -> Frame:
    events = list(simulate("walk", 1, duration_s=0.4, lidar=SpinningLidar(azimuth_steps=100)).events())
    scan = next(event for event in events if isinstance(event, Scan))
    imu = next(event for event in events if isinstance(event, ImuSamples) and len(event) > 1)
    return Frame(scan, imu, scan.start_ns, covered=True, largest_gap_s=0.005)


@given(st.floats(0.0, 90.0), st.floats(0.0, 360.0))
def test_only_an_axis_that_is_vertical_counts_as_one_that_nobody_begins_to_move_along(
    frame: Frame, leaning_deg: float, towards_deg: float
) -> None:
    """Before one wall, in a corridor, the axis that is known least leans by 25 deg, and the corridor lies within it."""
    seen = Beginning([frame], LioConfig())
    across = np.cross(seen.up_lidar, [np.cos(np.radians(towards_deg)), np.sin(np.radians(towards_deg)), 0.1])
    axis = so3.exp(np.radians(leaning_deg) * across / np.linalg.norm(across)) @ seen.up_lidar
    for sign in (-1.0, 1.0):
        level = seen.level(sign * axis[None])
        if leaning_deg > 12.0:
            np.testing.assert_array_equal(level, sign * axis[None])
        if leaning_deg < 11.0:
            assert level.shape == (0, 3)
