"""What is handed to the watches: the rate without its bias, the velocity in the axes of the IMU."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import quaternion
from boxplus.systems.visual_inertial_odometry.sensor_watches import SensorWatches
from tests.systems.visual_inertial_odometry.corners.test_instant_watch import FIRST, _Late
from tests.systems.visual_inertial_odometry.simulated_rays import IMAGE_EVERY, PIXEL_SIGMA, Flight, rig


@pytest.mark.parametrize("samples", [0, 2])
def test_a_wrong_bias_and_a_late_camera_are_told_from_each_other(samples: int) -> None:
    flight = Flight(2, 6.0)
    tracker, watches = _Late(flight, rig(2), samples), SensorWatches(rig(2), PIXEL_SIGMA, 9.81)
    bias = np.array([0.2, -0.3, 0.1])
    for k in range(12):
        at = IMAGE_EVERY * (FIRST + 6 * k)
        tracks = tracker.detect(tracker.track(int(flight.time_ns[at])))
        pose = np.concatenate([quaternion.from_matrix(flight.R[at]), flight.p[at]])
        state = np.concatenate([flight.v[at], np.zeros(3), flight.bias_gyro[at] + bias])
        watches.add_keyframe(tracks, pose, state, flight.gyro[at] + bias)
    if samples:
        assert watches.among_cameras is not None and "whatever their stamps say" in watches.among_cameras
    else:
        assert watches.among_cameras is None
    assert watches.apart is None  # no way has been looked at
