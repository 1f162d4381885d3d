"""Corners of a rolling shutter against where they are at the stamp, on points and motions that are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus import InputError, Pinhole
from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry import Rig, VioConfig, VisualInertialOdometry
from boxplus.systems.visual_inertial_odometry.corners.shutter import BodyMotion, at_once, flow
from boxplus.systems.visual_inertial_odometry.rig import RigCamera

SIZE = (752, 480)
MODEL = Pinhole(458.0, 457.0, 372.0, 246.0)
APART_S, READOUT_S = 0.05, 0.03


def mounting() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3.exp(np.array([-1.2, 1.2, -1.2])), [0.07, 0.06, 0.01]
    return T


def camera(readout_s: float = READOUT_S) -> RigCamera:
    return Rig.of([MODEL], [mounting()], [SIZE], line_delays_s=[readout_s / SIZE[1]]).cameras[0]


class Flight:
    """A body that turns and moves with constant accelerations: R = Exp(ω t + α t² / 2), the axis of α being that of ω."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        axis = rng.normal(size=3)
        self.omega, self.alpha = (scale * axis / np.linalg.norm(axis) for scale in (rng.uniform(0.5, 2.5), rng.uniform(-8, 8)))
        self.v, self.a = rng.uniform(-1.5, 1.5, 3), rng.uniform(-3.0, 3.0, 3)
        directions = rng.uniform((-0.7, -0.45, 1.0), (0.7, 0.45, 1.0), (200, 3)) * rng.uniform(1.0, 8.0, (200, 1))
        self.p_world = directions @ mounting()[:3, :3].T + mounting()[:3, 3]

    def rate(self, t: float) -> np.ndarray:
        return self.omega + self.alpha * t

    def pose(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        t = np.asarray(t)[..., None]
        return so3.exp(self.omega * t + 0.5 * self.alpha * t**2), self.v * t + 0.5 * self.a * t**2

    def seen(self, stamp_s: float, delay_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Pixels and rays of all points, each at the instant of its row."""
        rows = np.full(len(self.p_world), 0.5 * (SIZE[1] - 1))
        for _ in range(12):
            R, p = self.pose(stamp_s + delay_s * (rows - 0.5 * (SIZE[1] - 1)))
            body = np.einsum("nji,nj->ni", R, self.p_world - p)
            pixels, _ = MODEL.project((body - mounting()[:3, 3]) @ mounting()[:3, :3])
            rows = pixels[:, 1]
        return pixels, MODEL.unproject(pixels)[0]

    def motion(self) -> BodyMotion:
        R, p = self.pose(np.array([-APART_S, 0.0]))
        return BodyMotion(APART_S, R[0].T @ R[1], R[0].T @ (p[1] - p[0]), self.rate(0.0))


@pytest.mark.parametrize("seed", range(6))
def test_corners_come_to_where_they_are_at_the_stamp(seed: int) -> None:
    flight, its = Flight(seed), camera()
    (pixels, rays), (old_pixels, old_rays) = (flight.seen(t, its.line_delay_s) for t in (0.0, -APART_S))
    truth, _ = flight.seen(0.0, 0.0)
    there, moved = at_once(its, pixels, rays, old_pixels, old_rays, np.zeros(len(pixels)), flight.motion())
    before, after = (np.linalg.norm(found - truth, axis=1) for found in (pixels, there))
    assert np.median(before) > 1.0  # what is at stake
    # Left is what the velocity changes by from the middle of the two images on: a tenth of it where 3 m/s² meet 1.5 m/s.
    assert np.median(after) < 0.1 * np.median(before) and np.max(after) < 0.2 * np.max(before)
    np.testing.assert_allclose(MODEL.unproject(there)[0], moved, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_new_corners_take_the_motion_of_the_imu_and_their_depth(seed: int) -> None:
    flight, its = Flight(seed), camera()
    pixels, rays = flight.seen(0.0, its.line_delay_s)
    truth, _ = flight.seen(0.0, 0.0)
    rho = 1.0 / ((flight.p_world - mounting()[:3, 3]) @ mounting()[:3, :3])[:, 2]
    there, _ = at_once(its, pixels, rays, np.full_like(pixels, np.nan), np.full_like(rays, np.nan), rho, flight.motion())
    before, after = (np.median(np.linalg.norm(found - truth, axis=1)) for found in (pixels, there))
    assert after < 0.1 * before  # the velocity is that of the time between the images


def test_the_flow_is_the_derivative_of_the_projection() -> None:
    rng = np.random.default_rng(3)
    p = rng.uniform((-2, -2, 1.0), (2, 2, 6.0), (50, 3))
    omega, velocity, h = rng.normal(size=3), rng.normal(size=3), 1e-5
    ahead, behind = ((p - t * velocity) @ so3.exp(t * omega) for t in (h, -h))  # in the frame of a camera at t v, turned by t ω
    expected = (ahead[:, :2] / ahead[:, 2:] - behind[:, :2] / behind[:, 2:]) / (2 * h)
    np.testing.assert_allclose(flow(p / p[:, 2:], omega, velocity / p[:, 2:]), expected, rtol=1e-7, atol=1e-8)


def test_what_is_not_seen_stays_so_and_a_global_shutter_moves_nothing() -> None:
    flight = Flight(0)
    pixels, rays = flight.seen(0.0, 0.0)
    old_pixels, old_rays = flight.seen(-APART_S, 0.0)
    pixels[3], rays[3] = np.nan, np.nan
    there, moved = at_once(camera(0.0), pixels, rays, old_pixels, old_rays, np.zeros(len(pixels)), flight.motion())
    np.testing.assert_allclose(there, pixels, atol=1e-8)
    np.testing.assert_array_equal(moved, rays)


def test_line_delays_are_checked_and_lines_refused() -> None:
    with pytest.raises(InputError, match="in seconds"):
        Rig.of([MODEL], [mounting()], [SIZE], line_delays_s=[30.0])  # µs
    with pytest.raises(InputError, match="2 line delays"):
        Rig.of([MODEL], [mounting()], [SIZE], line_delays_s=[0.0, 0.0])
    pytest.importorskip("cv2")
    rig = Rig.of([MODEL], [mounting()], [SIZE], line_delays_s=[3e-5])
    with pytest.raises(InputError, match="rolling shutter"):
        VisualInertialOdometry(VioConfig(lines=True), rig)
    assert VisualInertialOdometry(VioConfig(), replace(rig)).rig.cameras[0].line_delay_s == 3e-5
