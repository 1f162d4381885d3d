"""A drive whose odometry drifts, without running one: scans at true poses, and poses that errors pile up along.

For what stands on an odometry, such as loop closure: a drive of a kilometre takes seconds, and its error is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._arguments import as_settings
from boxplus._settings import Settings
from boxplus.manifolds import quaternion, se3
from boxplus.simulation.motions.trajectories import rounded
from boxplus.simulation.worlds.world import World

Floats = NDArray[np.float64]


class DriftConfig(Settings):
    """How the odometry of a simulated drive drifts, and what its sensor sees.

    Raises:
        InputError: a setting is unknown or out of range.
    """

    step_m: float = Field(1.0, gt=0, description="way between scans [m]")
    speed: float = Field(8.0, gt=0, description="[m/s]")
    height: float = Field(1.8, description="of the sensor above the ground [m]")
    corner_radius: float = Field(5.0, gt=0, description="of the route [m]")
    yaw_drift: float = Field(5e-4, ge=0, description="random walk of yaw [rad/√m]")
    tilt_drift: float = Field(1e-4, ge=0, description="random walk of roll and pitch, small thanks to gravity [rad/√m]")
    position_drift: float = Field(0.01, ge=0, description="random walk of the position along each axis [m/√m]")
    channels: int = Field(32, ge=1, description="rays of a firing")
    azimuth_steps: int = Field(360, ge=1, description="firings of a turn")
    vertical_fov_deg: tuple[float, float] = Field((-25.0, 15.0), description="lowest and highest ray [deg]")
    max_range: float = Field(70.0, gt=0, description="[m]")
    range_sigma: float = Field(0.02, ge=0, description="of a range [m]")


@dataclass(frozen=True, slots=True, eq=False)
class DriftingDrive:
    """K scans along a route.

    Attributes:
        time_ns: (K,) int64.
        T_world_body: (K, 7) true; T_odo_body: (K, 7) as the odometry has it, which begins at the truth.
        covariance: (K, 6, 6) of each pose of the odometry against the first [rad, m], on the right: that of the drift.
        scans: K of (N, 3) float32, body's frame [m].
    """

    time_ns: NDArray[np.int64]
    T_world_body: Floats
    T_odo_body: Floats
    covariance: Floats
    scans: list[NDArray[np.float32]]


def simulate_drifting_drive(world: World, route: ArrayLike, config: DriftConfig | None = None, seed: int = 0) -> DriftingDrive:
    """Drive a route (W, 2) or (W, 3) [m] through a world; the same bits for the same seed.

    Args:
        route: corners, which are rounded; a third column is the height of the ground there.

    Raises:
        InputError: a route whose legs are too short to round their corners.

    Example:
        `simulate_drifting_drive(city(), [[0, 0], [60, 0], [60, 60], [0, 60], [0, 0], [60, 0]])`
    """
    config = as_settings(DriftConfig, config)
    random = np.random.Generator(np.random.PCG64([seed, 700]))
    time_ns, truth, odometry, covariance = _driven(route, config, random)
    scans = [_scan(world, T, config, random) for T in truth]
    return DriftingDrive(time_ns, truth, odometry, covariance, scans)


def simulate_drift(route: ArrayLike, config: DriftConfig, seed: int = 0) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """The drive without its scans: times (K,) [ns], T_world_body (K, 7), T_odo_body (K, 7) and its covariance (K, 6, 6).

    Arguments and errors as `simulate_drifting_drive`.
    """
    return _driven(route, config, np.random.Generator(np.random.PCG64([seed, 700])))


def _driven(
    route: ArrayLike, config: DriftConfig, random: np.random.Generator
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    corners = np.asarray(route, dtype=np.float64)
    path, _, heading = rounded(corners[:, :2], config.corner_radius)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.arange(0.0, way[-1], config.step_m)
    legs = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners[:, :2], axis=0), axis=1))])
    ground = np.interp(at, legs * way[-1] / legs[-1], corners[:, 2]) if corners.shape[1] == 3 else np.zeros(len(at))
    yaw = np.interp(at, way, heading)
    position = np.column_stack([np.interp(at, way, path[:, 0]), np.interp(at, way, path[:, 1]), ground + config.height])
    q = np.column_stack([np.cos(0.5 * yaw), np.zeros((len(at), 2)), np.sin(0.5 * yaw)])
    truth = np.hstack([q, position])
    odometry, covariance = _drifted(truth, config, random)
    return np.rint(at / config.speed * 1e9).astype(np.int64), truth, odometry, covariance


def _drifted(truth: Floats, config: DriftConfig, random: np.random.Generator) -> tuple[Floats, Floats]:
    """Along the steps of the truth, each with an error on its right."""
    steps = se3.compose(se3.inverse(truth[:-1]), truth[1:])
    length = np.linalg.norm(steps[:, 4:], axis=1)
    rate = np.array([config.tilt_drift, config.tilt_drift, config.yaw_drift, *[config.position_drift] * 3])
    noise = random.standard_normal((len(steps), 6)) * rate * np.sqrt(length)[:, None]
    poses, covariances = [truth[0]], [np.zeros((6, 6))]
    for step, own, m in zip(steps, noise, length, strict=True):
        poses.append(se3.compose(se3.compose(poses[-1], step), se3.exp(own)))
        Ad = se3.adjoint(se3.inverse(step))
        covariances.append(Ad @ covariances[-1] @ Ad.T + np.diag(rate**2 * m))
    return np.stack(poses), np.stack(covariances)


def _scan(world: World, T: Floats, config: DriftConfig, random: np.random.Generator) -> NDArray[np.float32]:
    azimuth = random.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi * np.arange(config.azimuth_steps) / config.azimuth_steps
    elevation = np.deg2rad(np.linspace(*config.vertical_fov_deg, config.channels))
    a, e = (grid.ravel() for grid in np.meshgrid(azimuth, elevation))
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    ranges, _ = world.cast(rays, quaternion.to_matrix(T[:4])[None], T[None, 4:], config.max_range)
    hit = np.isfinite(ranges)
    noisy = ranges[hit] + random.normal(0.0, config.range_sigma, int(hit.sum()))
    return (rays[hit] * noisy[:, None]).astype(np.float32)
