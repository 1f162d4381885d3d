"""Corners of a rolling shutter, brought to where they would be had all rows been taken at once.

Row v is taken τ = d (v − (H − 1) / 2) after the stamp of its image, d being the line delay. By how far the corner's ray
y = [X/Z, Y/Z] moves meanwhile is taken off:

    y(0) = y − τ ẏ,    ẏ = (y − y') / Δt + f(y, ω − ω̄, 0)

y' is where the corner was in the image before, Δt the time between the two rows; ω̄, the mean angular velocity of the camera over
that time, becomes ω, that of the instant. Of a corner just found there is no y': ẏ = f(y, ω, ρ v) then, with the inverse depth ρ,
the camera's velocity v, and, as Ẋ = −ω × X − v,

    f(y, ω, u) = [g_x − x g_z, g_y − y g_z],    g = −ω × [x, y, 1] − u.

What is left is of second order in τ. Derivation and test: docs/visual_inertial_odometry.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.systems.visual_inertial_odometry.rig import RigCamera

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """How the IMU moved from the image before to this one.

    Attributes:
        seconds: between the stamps [s].
        R_before_now: (3, 3) attitude now in its frame at the image before.
        p_before_now: (3,) position there [m]; zero where it is not known.
        rate: (3,) angular velocity now, in the IMU's frame [rad/s]; None for the mean of the time between.
    """

    seconds: float
    R_before_now: Floats
    p_before_now: Floats
    rate: Floats | None = None


def flow(rays: Floats, omega: Floats, u: Floats) -> Floats:
    """f of the head of this file, (n, 2) [1/s].

    Args:
        rays: (n, 3) [X/Z, Y/Z, 1].
        omega: (3,) angular velocity of the camera in its frame [rad/s].
        u: ρ v, (n, 3) or (3,) [1/s].
    """
    g = np.cross(rays, omega) - u
    return np.asarray(g[:, :2] - rays[:, :2] * g[:, 2:])


def at_once(
    camera: RigCamera, pixels: Floats, rays: Floats, old_pixels: Floats, old_rays: Floats, rho: Floats, motion: BodyMotion
) -> tuple[Floats, Floats]:
    """Pixels (n, 2) and rays (n, 3) of one camera's corners at the stamp of their image.

    Args:
        pixels, rays: (n, 2) [px] and (n, 3) [X/Z, Y/Z, 1] as recorded; NaN where not seen.
        old_pixels, old_rays: the same in the image before; NaN where not seen there.
        rho: (n,) inverse depths, about [1/m], for corners that were not.
    """
    R, p = camera.T_imu_camera[:3, :3], camera.T_imu_camera[:3, 3]
    mean = so3.log(motion.R_before_now) / motion.seconds
    rate = mean if motion.rate is None else motion.rate
    velocity = motion.R_before_now.T @ motion.p_before_now / motion.seconds + np.cross(mean, p)
    between_s = motion.seconds + camera.line_delay_s * (pixels[:, 1] - old_pixels[:, 1])
    measured = (rays - old_rays)[:, :2] / between_s[:, None] + flow(rays, R.T @ (rate - mean), np.zeros(3))
    predicted = flow(rays, R.T @ rate, rho[:, None] * (R.T @ velocity))
    speed = np.where(np.isfinite(measured), measured, predicted)
    late_s = camera.line_delay_s * (pixels[:, 1] - 0.5 * (camera.height - 1))
    moved = rays.copy()
    moved[:, :2] -= late_s[:, None] * speed
    there, seen = camera.model.project(moved)
    return np.where(seen[:, None], there, np.nan), np.where(seen[:, None], moved, np.nan)
