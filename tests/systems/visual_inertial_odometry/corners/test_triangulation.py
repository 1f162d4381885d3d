"""Inverse depths from several views: exact without noise, refused without parallax."""

from __future__ import annotations

import numpy as np

from boxplus.manifolds import quaternion, se3, so3
from boxplus.systems.visual_inertial_odometry.corners.triangulation import epipolar_distances, inverse_depths, triangulate


def views(p_world: np.ndarray, bodies: np.ndarray, mountings: np.ndarray) -> np.ndarray:
    """(f, n, c, 3) rays of points (n, 3)."""
    rays = np.full((len(bodies), len(p_world), len(mountings), 3), np.nan)
    for f, body in enumerate(bodies):
        for c, mounting in enumerate(mountings):
            p = se3.act(se3.inverse(se3.compose(body, mounting)), p_world)
            rays[f, :, c] = p / p[:, 2:]
    return rays


def rig(seed: int, frames: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    turn = quaternion.from_matrix(so3.exp(0.1 * rng.normal(size=(frames, 3))))
    bodies = np.hstack([turn, 0.3 * rng.normal(size=(frames, 3))])
    mountings = np.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0.1, 0, 0]])
    return bodies, mountings, rng.uniform([-2, -2, 3], [2, 2, 9], (40, 3))


def test_depths_are_exact_where_several_frames_see_a_point_whichever_do() -> None:
    for seed in range(5):
        bodies, mountings, p_world = rig(seed, 4)
        rays = views(p_world, bodies, mountings)
        rng = np.random.default_rng(seed)
        rays[rng.random(rays.shape[:3]) < 0.4] = np.nan
        anchor, rho, good = triangulate(rays, bodies, mountings, 1e-3)
        assert good.sum() > 20
        for n in np.flatnonzero(good):
            first = np.flatnonzero(np.isfinite(rays[:, n, 0, 0]))[0]
            p = se3.act(se3.inverse(se3.compose(bodies[first], mountings[0])), p_world[n])
            assert anchor[n] == first
            np.testing.assert_allclose(rho[n], 1.0 / p[2], rtol=1e-9)


def test_what_has_no_parallax_or_does_not_agree_is_not_believed() -> None:
    bodies, mountings, p_world = rig(0, 3)
    still = np.tile(bodies[:1], (3, 1))
    assert not triangulate(views(p_world, still, mountings[:1]), still, mountings[:1], 1e-3)[2].any()
    rays = views(p_world, bodies, mountings)
    rays[2, :, 0, 1] += 0.05  # fifty standard deviations
    assert not triangulate(rays, bodies, mountings, 1e-3)[2].any()
    rays = views(p_world, bodies, mountings)
    rays[:, :, 0] = np.nan
    assert not triangulate(rays, bodies, mountings, 1e-3)[2].any()


def test_two_views_give_the_depth_and_tell_how_far_a_ray_is_off_its_epipolar_line() -> None:
    bodies, mountings, p_world = rig(5, 1)
    rays = views(p_world, bodies, mountings)[0]
    T = se3.compose(se3.inverse(mountings[1]), mountings[0])
    turned, t = rays[:, 0] @ quaternion.to_matrix(T[:4]).T, T[4:]
    rho, information = inverse_depths(turned, t, rays[:, 1])
    depth = se3.act(se3.inverse(se3.compose(bodies[0], mountings[0])), p_world)[:, 2]
    np.testing.assert_allclose(rho, 1.0 / depth, rtol=1e-9)
    np.testing.assert_allclose(information, ((t[:2] - rays[:, 1, :2] * t[2]) ** 2).sum(axis=1), rtol=1e-12)
    np.testing.assert_allclose(epipolar_distances(turned, t, rays[:, 1]), 0.0, atol=1e-12)
    moved = rays[:, 1] + np.append(np.random.default_rng(0).normal(size=(len(rays), 2)), np.zeros((len(rays), 1)), axis=1)
    line = np.cross(t, turned)
    expected = np.abs((line * moved).sum(axis=1)) / np.linalg.norm(line[:, :2], axis=1)
    np.testing.assert_allclose(epipolar_distances(turned, t, moved), expected, rtol=1e-12)
    lost = np.where(np.arange(len(rays))[:, None] == 3, np.nan, rays[:, 1])
    assert np.isnan(inverse_depths(turned, t, lost)[0][3]) and np.isnan(epipolar_distances(turned, t, lost)[3])
