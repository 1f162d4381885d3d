"""Stereo and IMU on images: eight seconds of a recording that begins at rest."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from boxplus import CameraImage, open_camera_recording, read_trajectory
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory
from boxplus.manifolds import quaternion
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VisualInertialOdometry

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")


@pytest.mark.slow
@needs_cv2
def test_a_flight_from_rest_is_followed_to_half_a_centimetre(shared_data: Path) -> None:
    folder = shared_data / "cameras" / "mh05_stereo"
    if not folder.is_dir():
        pytest.skip("the recording is not on this machine")
    recording = open_camera_recording(folder)
    cameras = [camera.calibrated() for camera in recording.info.cameras]
    imu = recording.info.imu
    rig = Rig.of(
        [c.model for c in cameras], [c.T_body_camera for c in cameras], [(c.width, c.height) for c in cameras], imu and imu.noise
    )
    vio = VisualInertialOdometry(VioConfig(), rig)
    estimates, images = [], 0
    for event in recording:
        if isinstance(event, CameraImage):
            if event.time_ns % 10**8 > 5 * 10**7:  # every other one
                continue
            images += 1
            if images > 2 * 80:
                break
            estimates += vio.push_image(event)
        else:
            estimates += vio.push_imu(event)
    known = [e for e in estimates if e.status != "starting"]
    assert len(known) > 60 and {e.status for e in known} == {"ok"} and vio.contradiction is None
    T = np.array([e.T_world_imu for e in known])
    path = Trajectory(np.array([e.time_ns for e in known]), T[:, :3, 3], quaternion.from_matrix(T[:, :3, :3]))
    result = evaluate(path, read_trajectory(folder / "gt.tum"))
    assert result.ate.rmse < 0.008
