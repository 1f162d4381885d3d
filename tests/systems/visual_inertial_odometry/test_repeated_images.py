"""Images that are delivered again: left out in motion, believed at rest."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from boxplus import CameraImage
from boxplus.sensors.images.repeated_images import RepeatedImages
from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VioEstimate, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.known_motion import imu_moves, is_motion
from boxplus.systems.visual_inertial_odometry.odometry import REPEATED

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
SECOND = 10**9
SIMULATION = simulate_cameras("room", 1, duration_s=3.6, rig=make_rig("stereo", None, 0.3, 15.0))


def ran(
    frozen_s: tuple[float, float], cameras: tuple[int, ...] = (0, 1)
) -> tuple[VisualInertialOdometry, list[VioEstimate], float]:
    """The odometry over two seconds of rest and the motion after it; images of these cameras stand still between two times.

    With the largest distance between an estimate and the truth, from the first pose on [m].
    """
    recording = as_camera_recording(SIMULATION)
    cams = [stream.calibrated() for stream in recording.info.cameras]
    noise = recording.info.imu and recording.info.imu.noise
    rig = Rig.of([c.model for c in cams], [c.T_body_camera for c in cams], [(c.width, c.height) for c in cams], noise)
    vio, estimates, first, last = VisualInertialOdometry(VioConfig(cell_size=12, features=100), rig), [], None, {}
    for event in recording:
        if not isinstance(event, CameraImage):
            estimates += vio.push_imu(event)
            continue
        first = event.time_ns if first is None else first
        since_s = (event.time_ns - first) / SECOND
        if event.camera not in last or not (event.camera in cameras and frozen_s[0] <= since_s < frozen_s[1]):
            last[event.camera] = event.pixels
        estimates += vio.push_image(CameraImage(event.camera, event.name, event.time_ns, last[event.camera].copy()))
    known = [estimate for estimate in estimates + vio.flush() if estimate.status != "starting"]
    truth = SIMULATION.ground_truth(np.array([estimate.time_ns for estimate in known])).p_world_imu
    found = np.array([estimate.T_world_imu[:3, 3] for estimate in known])
    # Headings differ by what is free: lengths do not.
    off = np.linalg.norm(found - found[0], axis=1) - np.linalg.norm(truth - truth[0], axis=1)
    return vio, known, float(np.abs(off).max())


@pytest.mark.slow
@needs_cv2
def test_a_camera_that_stalls_in_motion_does_not_stop_the_odometry() -> None:
    sound, everything, off_sound = ran((9.0, 9.0))
    stalled, known, off = ran((2.7, 3.2))
    assert REPEATED not in sound.counters and stalled.counters[REPEATED] in (14, 16)
    assert off < off_sound + 0.01 and stalled.contradiction is None
    assert len(everything) - len(known) == stalled.counters[REPEATED] / 2


@pytest.mark.slow
@needs_cv2
def test_the_other_camera_goes_on_where_one_stalls() -> None:
    _, everything, off_sound = ran((9.0, 9.0))
    stalled, known, off = ran((2.7, 3.2), cameras=(1,))
    assert stalled.counters[REPEATED] in (7, 8) and len(known) == len(everything)
    assert off < off_sound + 0.01 and stalled.contradiction is None


@needs_cv2
def test_equal_images_at_rest_are_believed() -> None:
    """A source without noise has them, and they are true."""
    vio, known, _ = ran((0.0, 1.9))
    assert REPEATED not in vio.counters and vio.start is not None and vio.start.kind == "at rest"
    assert {estimate.status for estimate in known} == {"ok"}


def test_only_images_that_show_something_can_repeat() -> None:
    rng, repeated = np.random.default_rng(1), RepeatedImages()
    image, flat = rng.integers(0, 255, (48, 64), np.uint8), np.full((48, 64), 7, np.uint8)
    assert repeated.among({0: image, 1: flat}) == set()
    repeated.keep({0: image, 1: flat})
    assert repeated.among({0: image.copy(), 1: flat.copy()}) == {0}
    other = image.copy()
    other[17, 5] ^= 1
    assert repeated.among({0: other}) == set()


def test_what_counts_as_motion() -> None:
    still = np.zeros((10, 3))
    weight = still + np.array([0.0, 0.0, 9.81])
    assert not imu_moves(still + 0.04, weight, 9.81) and not imu_moves(still[:0], weight[:0], 9.81)
    assert imu_moves(still + 0.1, weight, 9.81) and imu_moves(still, 1.1 * weight, 9.81)
    none = np.zeros(3)
    assert not is_motion(0.0, none, none + 0.01, 450.0)
    assert is_motion(0.002, none, none, 450.0) and is_motion(0.0, none + 0.01, none, 450.0)
    assert is_motion(0.0, none, none + 0.1, 450.0)
