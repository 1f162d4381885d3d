"""Direct odometry of an RGB-D camera, frame by frame: here frames of a painted wall that the program draws itself.

python examples/direct_odometry.py
"""

from __future__ import annotations

import numpy as np

import boxplus as bp

camera = bp.Pinhole(150.0, 150.0, 79.5, 59.5)
rng = np.random.default_rng(0)
waves, phases = rng.normal(size=(30, 2)) * 9.0, rng.uniform(0.0, 6.3, 30)


def frame(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Grey values and depths [m] of a wall 2 m ahead that leans to the left, for a camera at (x, y, 0)."""
    v, u = np.mgrid[:120, :160]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u, dtype=float)], axis=-1)
    depth = (2.0 + 0.3 * x) / (1.0 - 0.3 * rays[..., 0])  # z = 2 + 0.3 x_world
    on_wall = np.stack([x + depth * rays[..., 0], y + depth * rays[..., 1]], axis=-1)
    grey = 120.0 + 8.0 * np.cos(on_wall @ waves.T + phases).sum(axis=-1)
    return grey + rng.normal(0.0, 1.0, grey.shape), depth


odometry = bp.DirectOdometry(camera)
for k in range(15):
    x, y = 0.02 * k, 0.05 * np.sin(0.4 * k)
    estimate = odometry.push_rgbd(k * 33_333_333, *frame(x, y))
    sigma = 1e3 * np.sqrt(np.diag(estimate.pose_covariance)[3:])
    off = 1e3 * (estimate.p_world_camera - [x, y, 0.0])
    print(f"{k:2d} {estimate.status:4s} keyframe {estimate.keyframe}  error {np.round(off, 1)} mm  sigma {np.round(sigma, 1)} mm")

print(f"{odometry.keyframes} keyframes; at the end {np.linalg.norm(off):.1f} mm off after {0.02 * 14:.2f} m")
