"""Sensors, mountings and rates on which nothing has been chosen: what a campaign of the usual ones does not show."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import quaternion, so3
from boxplus.simulation import OmniLidar, RosetteLidar, SpinningLidar, mounting
from boxplus.simulation.lidar import LidarModel

SENSORS = ("omni", "narrow", "dome", "spinning8", "slow64", "fast32")
IMU_RATES_HZ = (50.0, 80.0, 500.0, 1000.0)
_TILTED, _ANYHOW = 0.5, 0.25  # share of the mountings


def lidar(sensor: str, random: np.random.Generator) -> tuple[LidarModel, float]:
    """The sensor and how long to record [s].

    `omni` looks all around and up, with a figure that never repeats; `narrow` has a cone of 40 degrees; `dome` sees the half
    space above; the others spin with eight channels, or at half or twice the usual rate.
    """
    sigma, reach = float(random.uniform(0.01, 0.03)), float(random.uniform(40.0, 120.0))
    rate = {"slow64": 5.0, "fast32": 20.0}.get(sensor, 10.0)
    noise = {"rate_hz": rate, "range_sigma_m": sigma, "max_range": reach}
    duration_s = float(random.uniform(12.0, 15.0) if rate > 10.0 else random.uniform(14.0, 25.0))
    if sensor == "omni":
        return OmniLidar(**noise), duration_s
    if sensor == "narrow":
        return RosetteLidar(**noise, points_per_scan=10_000, fov_deg=38.4), duration_s
    channels, steps, low, high = {
        "dome": (32, 900, 2.0, 88.0),
        "spinning8": (8, 1800, -12.0, 12.0),
        "slow64": (64, 1024, -22.5, 22.5),
        "fast32": (32, 512, -25.0, 15.0),
    }[sensor]
    return SpinningLidar(**noise, channels=channels, azimuth_steps=steps, vertical_fov_deg=(low, high)), duration_s


def any_mounting(near: bool, random: np.random.Generator) -> NDArray[np.float64]:
    """A LiDAR that hangs askew, lies on its side or upside down, or stands upright as usual."""
    reach = 0.08 if near else float(random.choice((0.08, 0.3, 1.0)))
    lever = tuple(random.uniform(-reach, reach, 3))
    kind = random.uniform()
    T = mounting(0.0, 0.0, float(random.uniform(-180.0, 180.0)), lever)
    if kind < _TILTED:
        about = random.uniform(-np.pi, np.pi)
        tilt = np.radians(random.uniform(15.0, 60.0)) * np.array([np.cos(about), np.sin(about), 0.0])
        T[:3, :3] = so3.exp(tilt) @ T[:3, :3]
    elif kind < _TILTED + _ANYHOW:
        q_wxyz = random.normal(size=4)
        T[:3, :3] = quaternion.to_matrix(q_wxyz / np.linalg.norm(q_wxyz))
    return T
