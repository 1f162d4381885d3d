"""A part of the view that moves along with the camera is told; of landmarks and images that stand nothing is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.recordings.cameras.info import CameraStream
from boxplus.runs.inspection.cameras.carried import Followed, check_carried
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras

SIMULATION = simulate_cameras("room_moving", 4, duration_s=6.0, rig=make_rig("mono", None, 0.5, 20.0))
N = 120


def camera() -> CameraStream:
    return as_camera_recording(SIMULATION).info.cameras[0]


def imu(factor: float = 1.0) -> ImuSamples:
    samples = SIMULATION.imu.samples(SIMULATION.start_ns, SIMULATION.end_ns, 0)
    return ImuSamples(samples.time_ns, factor * samples.gyro, samples.accel)


def pairs(share: float, seed: int, stands: bool = False) -> list[Followed]:
    """Corners of points 1 to 8 m away; the camera carries a share of them along, and all of them where the images stand."""
    random, made = np.random.default_rng(seed), []
    model, sensor = camera().model, SIMULATION.scenario.rig.cameras[0].sensor
    for k in range(0, SIMULATION.image_count - 3, 2):
        begin_ns, end_ns = SIMULATION.stamp_ns(k), SIMULATION.stamp_ns(k + 3)
        T = SIMULATION.T_world_camera(0, [begin_ns, end_ns])
        before = random.uniform((10, 10), (sensor.width - 10, sensor.height - 10), (N, 2))
        X = model.unproject(before)[0] * random.uniform(1.0, 8.0, (N, 1))
        X = (X @ T[0, :3, :3].T + T[0, :3, 3] - T[1, :3, 3]) @ T[1, :3, :3]
        after, seen = model.project(X)
        carried = random.uniform(size=N) < (1.0 if stands else share)
        after[carried] = before[carried]
        kept = seen | carried
        made.append(Followed(begin_ns, end_ns, before[kept], after[kept] + random.normal(0, 0.1, (int(kept.sum()), 2))))
    return made


@settings(max_examples=10)
@given(share=st.floats(0.12, 0.6), seed=st.integers(0, 1000))
def test_what_the_camera_carries_along_is_told_with_its_share(share: float, seed: int) -> None:
    (said,) = check_carried(camera(), pairs(share, seed), imu())
    assert said.key == "cam0_carried" and "part of the platform is in view" in said.text
    assert abs(float(said.value[:-1]) / 100.0 - share) < 0.1


@settings(max_examples=10)
@given(seed=st.integers(0, 1000), factor=st.sampled_from((1.0, -1.0, 0.0, 57.3)))
def test_nothing_is_said_of_landmarks_whatever_the_gyroscope_says(seed: int, factor: float) -> None:
    assert check_carried(camera(), pairs(0.0, seed), imu(factor)) == []
    assert check_carried(camera(), pairs(0.0, seed, stands=True), imu(factor)) == []


def test_nothing_is_said_without_calibration_or_samples() -> None:
    some = pairs(0.3, 0)
    assert check_carried(replace(camera(), model=None), some, imu()) == []
    assert check_carried(replace(camera(), T_body_camera=None), some, imu()) == []
    assert check_carried(camera(), some, imu().where(slice(0, 5))) == []
    assert check_carried(camera(), [], imu()) == []
