"""What moves corners off their epipolar lines, against central differences of the cameras themselves."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry.corners.epipolar_offsets import offset_sigmas, offsets, pairs_of_rays
from tests.systems.visual_inertial_odometry.simulated_rays import IMAGE_EVERY, PIXEL_SIGMA, Flight, SimulatedTracker, rig


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_slopes_are_those_of_a_longer_focal_length_and_a_turned_mounting(seed: int) -> None:
    flight, its = Flight(seed, 4.0), rig(2)
    tracker = SimulatedTracker(flight, its)
    tracks = tracker.detect(tracker.track(int(flight.time_ns[6 * IMAGE_EVERY])))
    T = np.linalg.inv(its.cameras[1].T_imu_camera) @ its.cameras[0].T_imu_camera
    _, rays, normals, seen = pairs_of_rays(tracks, 1, T)
    slopes, e = offsets(rays, normals)
    assert len(e) == len(rays) == seen > 20
    sigma = offset_sigmas(its, PIXEL_SIGMA)[0]
    assert np.abs(e).max() < 5.0 * sigma  # nothing but the noise of corners

    def moved(x: np.ndarray) -> np.ndarray:
        y = rays @ so3.exp(x[1:]).T  # of a camera turned by −x, its image stretched
        y = np.column_stack([y[:, :2] * (1.0 + x[0]), y[:, 2]])
        return (normals * y).sum(axis=1)

    for k, step in enumerate(1e-6 * np.eye(4)):
        np.testing.assert_allclose(slopes[:, k], (moved(step) - moved(-step)) / 2e-6, atol=1e-7)


def test_without_a_baseline_nothing_is_said() -> None:
    flight, its = Flight(1, 4.0), rig(2)
    tracker = SimulatedTracker(flight, its)
    tracks = tracker.detect(tracker.track(int(flight.time_ns[6 * IMAGE_EVERY])))
    T = np.linalg.inv(its.cameras[1].T_imu_camera) @ its.cameras[0].T_imu_camera
    T[:3, 3] = 0.0
    turned, rays, normals, seen = pairs_of_rays(tracks, 1, T)
    assert seen == int(np.isfinite(tracks.rays[:, 1, 0]).sum()) > 20
    assert len(turned) == len(rays) == len(normals) == 0
