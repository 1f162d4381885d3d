"""The focal length of one camera beside that of another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig
from boxplus.systems.visual_inertial_odometry.corners.focal_watch import FocalWatch
from tests.systems.visual_inertial_odometry.simulated_rays import (
    IMAGE_EVERY,
    PIXEL_SIGMA,
    Flight,
    SimulatedTracker,
    rig,
    run,
)

LIMIT_PX = 1.5  # `VioConfig.epipolar`


def _stated(factors):
    """The rig as somebody states it who has the focal lengths wrong by these factors."""
    its = rig(2)
    cameras = zip(its.cameras, factors, strict=True)
    return replace(
        its, cameras=tuple(replace(c, model=replace(c.model, fx=f * c.model.fx, fy=f * c.model.fy)) for c, f in cameras)
    )


class _Misled(SimulatedTracker):
    """Rays are those of the stated rig; corners off their epipolar line are taken for mistakes, as `FeatureTracker` does."""

    def __init__(self, flight: Flight, stated: Rig) -> None:
        super().__init__(flight, rig(2))
        self._stated = stated

    def _tracks(self, fresh):
        tracks = super()._tracks(fresh)
        pixels, rays = tracks.pixels.copy(), tracks.rays.copy()
        for c, camera in enumerate(self._stated.cameras):
            rays[:, c], _ = camera.model.unproject(pixels[:, c])
        T = np.linalg.inv(self._stated.cameras[1].T_imu_camera) @ self._stated.cameras[0].T_imu_camera
        n = np.cross(T[:3, 3], rays[:, 0] @ T[:3, :3].T)
        off = self._stated.cameras[1].model.fx * np.abs((n * rays[:, 1]).sum(axis=1)) / np.linalg.norm(n[:, :2], axis=1)
        pixels[~(off < LIMIT_PX), 1] = rays[~(off < LIMIT_PX), 1] = np.nan
        return replace(tracks, pixels=pixels, rays=rays)


def _watched(seed, stated, keyframes=12):
    flight = Flight(seed, 4.0)
    tracker, watch = _Misled(flight, stated), FocalWatch(stated, PIXEL_SIGMA)
    for k in range(keyframes):
        watch.add(tracker.detect(tracker.track(int(flight.time_ns[6 * IMAGE_EVERY * k]))))
    return watch


@pytest.mark.parametrize(
    ("factors", "expected"), [((1.0, 1.0), 0.0), ((1.0, 1.02), -0.02), ((0.97, 1.0), -0.03), ((1.04, 1.0), 0.04)]
)
def test_the_ratio_of_two_focal_lengths_is_told_and_named_where_it_is_wrong(factors, expected):
    watch = _watched(1, _stated(factors))
    # Corners far off were taken for mistakes, which makes less of it.
    least, most = sorted([0.5 * expected, 1.05 * expected])
    assert least - 4.0 * watch.sigma[0] < watch.longer[0] < most + 4.0 * watch.sigma[0]
    assert watch.sigma[0] < 0.005
    if expected:
        assert f"about {abs(100.0 * watch.longer[0]):.1f} % {'longer' if expected > 0.0 else 'shorter'}" in watch.contradiction
    else:
        assert watch.contradiction is None


def test_sound_rigs_come_to_their_standard_deviation():
    share = [
        float(watch.longer[0] / watch.sigma[0]) for watch in (_watched(seed, _stated((1.0, 1.0)), 8) for seed in range(2, 12))
    ]
    assert np.abs(share).max() < 4.0
    assert 0.2 < np.mean(np.square(share)) < 2.6  # ten of them


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_mounting_that_is_turned_is_no_focal_length(axis):
    its = rig(2)
    T = its.cameras[1].T_imu_camera.copy()
    T[:3, :3] = T[:3, :3] @ so3.exp(0.003 * np.eye(3)[axis])
    watch = _watched(1, replace(its, cameras=(its.cameras[0], replace(its.cameras[1], T_imu_camera=T))))
    assert abs(watch.longer[0]) < 0.005
    assert watch.contradiction is None


def test_one_camera_has_nothing_to_be_compared_with():
    flight, its = Flight(1, 2.0), rig(1)
    tracker, watch = SimulatedTracker(flight, its), FocalWatch(its, PIXEL_SIGMA)
    watch.add(tracker.detect(tracker.track(int(flight.time_ns[0]))))
    assert watch.contradiction is None


def test_an_odometry_says_so_soon_after_its_start():
    flight, stated = Flight(3, 4.5), _stated((1.0, 1.03))
    vio, estimates = run(flight, stated, VioConfig(pixel_sigma=PIXEL_SIGMA), _Misled(flight, stated))
    assert estimates[-1].status == "weak"
    assert "a focal length of camera 1" in vio.contradiction
