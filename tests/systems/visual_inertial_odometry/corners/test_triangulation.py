"""Inverse depths from several views: exact without noise, refused without parallax."""

from __future__ import annotations

import numpy as np

from boxplus.manifolds import quaternion, se3, so3
from boxplus.systems.visual_inertial_odometry.corners.triangulation import triangulate


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
