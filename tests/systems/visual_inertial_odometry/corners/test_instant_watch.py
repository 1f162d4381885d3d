"""When a second camera takes its images, beside the first one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig
from boxplus.systems.visual_inertial_odometry.corners.instant_watch import InstantWatch
from tests.systems.visual_inertial_odometry.simulated_rays import (
    IMAGE_EVERY,
    PIXEL_SIGMA,
    RATE,
    Flight,
    SimulatedTracker,
    rig,
    run,
)

FIRST = 2 * RATE // IMAGE_EVERY  # image from which on the flight is under way


class _Late(SimulatedTracker):
    """The images of camera 1 are taken some samples of the IMU later than their stamps say."""

    def __init__(self, flight: Flight, its: Rig, samples: int) -> None:
        super().__init__(flight, its)
        self._samples = samples

    def _project(self, camera, which):
        at, self._at = self._at, self._at + (self._samples if camera else 0)
        pixels = super()._project(camera, which)
        self._at = at
        return pixels


def _watched(seed, samples, stated=None, keyframes=12):
    flight = Flight(seed, 6.0)
    tracker = _Late(flight, rig(2), samples)
    watch = InstantWatch(rig(2) if stated is None else stated, PIXEL_SIGMA)
    for k in range(keyframes):
        at = IMAGE_EVERY * (FIRST + 6 * k)
        tracks = tracker.detect(tracker.track(int(flight.time_ns[at])))
        if stated is not None:
            rays = tracks.rays.copy()
            for c, camera in enumerate(stated.cameras):
                rays[:, c], _ = camera.model.unproject(tracks.pixels[:, c])
            tracks = replace(tracks, rays=rays)
        watch.add(tracks, flight.gyro[at] - flight.bias_gyro[at], flight.R[at].T @ flight.v[at])
    return watch


@pytest.mark.parametrize("samples", [-2, -1, 0, 1, 2])
@pytest.mark.parametrize("seed", [1, 3])
def test_images_that_are_taken_apart_are_told_and_named(seed, samples):
    watch, late_s = _watched(seed, samples), samples / RATE
    assert abs(watch.late_s[0] - late_s) < 4.0 * watch.sigma_s[0] + 0.02 * abs(late_s)
    assert watch.sigma_s[0] < 5e-4
    if samples:
        assert f"{1e3 * watch.late_s[0]:+.1f} ms after those of camera 0" in watch.contradiction
    else:
        assert watch.contradiction is None


def test_sound_rigs_come_to_their_standard_deviation():
    share = [float(watch.late_s[0] / watch.sigma_s[0]) for watch in (_watched(seed, 0, None, 8) for seed in range(2, 12))]
    assert np.abs(share).max() < 4.0
    assert 0.2 < np.mean(np.square(share)) < 2.6  # ten of them


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mounting_that_is_turned_is_no_other_instant(axis):
    its = rig(2)
    T = its.cameras[1].T_imu_camera.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(0.003 * np.eye(3)[axis])
    watch = _watched(1, 0, replace(its, cameras=(its.cameras[0], replace(its.cameras[1], T_imu_camera=T))))
    assert watch.contradiction is None


def test_a_focal_length_that_is_wrong_is_no_other_instant():
    its = rig(2)
    model = its.cameras[1].model
    wrong = replace(its.cameras[1], model=replace(model, fx=1.02 * model.fx, fy=1.02 * model.fy))
    watch = _watched(1, 0, replace(its, cameras=(its.cameras[0], wrong)))
    assert watch.contradiction is None


def test_a_rig_that_rests_says_nothing_of_instants():
    flight = Flight(1, 2.0)
    tracker, watch = _Late(flight, rig(2), 1), InstantWatch(rig(2), PIXEL_SIGMA)
    for k in range(12):
        tracks = tracker.detect(tracker.track(int(flight.time_ns[IMAGE_EVERY * k])))
        watch.add(tracks, np.zeros(3), np.zeros(3))
    assert watch.contradiction is None
    assert watch.sigma_s[0] > 0.05


def test_one_camera_has_nothing_to_be_compared_with():
    flight, its = Flight(1, 2.0), rig(1)
    tracker, watch = SimulatedTracker(flight, its), InstantWatch(its, PIXEL_SIGMA)
    watch.add(tracker.detect(tracker.track(int(flight.time_ns[0]))), np.zeros(3), np.zeros(3))
    assert watch.contradiction is None


def test_an_odometry_says_so():
    flight, its = Flight(3, 6.0), rig(2)
    vio, estimates = run(flight, its, VioConfig(pixel_sigma=PIXEL_SIGMA), _Late(flight, its, 1))
    assert estimates[-1].status == "weak"
    assert "whatever their stamps say" in vio.contradiction
