"""Positions by satellite along a known motion, with what goes wrong with them: noise, multipath, tunnels, clocks, datums."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from boxplus._arguments import as_settings
from boxplus._settings import Settings
from boxplus.manifolds import quaternion, se3
from boxplus.manifolds.se3 import SE3
from boxplus.sensors.satellites.geodesy import EnuFrame
from boxplus.sensors.satellites.gnss import GnssFixes

Floats = NDArray[np.float64]


class GnssConfig(Settings):
    """A simulated receiver. Heights are twice as bad as places throughout, as those of satellites are.

    Raises:
        InputError: a setting is unknown or out of range.
    """

    rate_hz: float = Field(5.0, gt=0)
    sigma: float = Field(0.5, ge=0, description="white noise of east and north [m]")
    slow_sigma: float = Field(0.5, ge=0, description="noise that stays for `slow_s` (orbits, ionosphere) [m]")
    slow_s: float = Field(60.0, gt=0, description="time constant of it [s]")
    claimed: float | None = Field(0.7, gt=0, description="standard deviation the receiver states [m]; None: it states none")
    multipath: int = Field(0, ge=0, description="stretches with a signal off a wall")
    multipath_m: float = Field(20.0, ge=0, description="how far off it is, twice of that at most [m]")
    multipath_s: float = Field(10.0, gt=0, description="how long one lasts [s]")
    tunnels: int = Field(0, ge=0, description="stretches without fixes")
    tunnel_s: float = Field(20.0, gt=0)
    lever: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="of the antenna in the IMU's frame [m]")
    delay_s: float = Field(0.0, description="by which stamps come after the measurement [s]")
    swapped: bool = Field(False, description="latitude and longitude in each other's place")
    datum_shift: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="of all positions, east, north, up [m]")
    jump: tuple[float, float, float] = Field((0.0, 0.0, 0.0), description="of the datum half way, east, north, up [m]")
    unit: Literal["deg", "rad"] = "deg"


RECEIVERS = {
    "good": GnssConfig(lever=(0.3, 0.0, 0.8)),
    "multipath": GnssConfig(lever=(0.3, 0.0, 0.8), multipath=2, multipath_s=6.0),
    "late": GnssConfig(lever=(0.3, 0.0, 0.8), delay_s=0.3),
    "swapped": GnssConfig(lever=(0.3, 0.0, 0.8), swapped=True),
}
"""Receivers by name, for `boxplus simulate --gnss`."""


def simulate_gnss(
    time_ns: ArrayLike, T_enu_imu: ArrayLike, origin: EnuFrame, config: GnssConfig | None = None, seed: int = 0
) -> GnssFixes:
    """Fixes along poses (K, 7) of the IMU at times (K,); the same bits for the same seed.

    Raises:
        InputError: poses whose quaternions are not of unit length.
    """
    config = as_settings(GnssConfig, config)
    random = np.random.Generator(np.random.PCG64([seed, 900]))
    t, T = np.asarray(time_ns, dtype=np.int64), SE3.check("T_enu_imu", T_enu_imu)
    step = round(1e9 / config.rate_hz)
    at = np.arange(t[0], t[-1] + 1, step)
    p = antenna_positions(t, T, at, np.array(config.lever))
    seconds = (at - at[0]) * 1e-9
    axes = np.array([1.0, 1.0, 2.0])
    p = p + config.sigma * axes * random.standard_normal((len(at), 3))
    keep = np.exp(-step * 1e-9 / config.slow_s)
    slow, state = np.zeros((len(at), 3)), random.standard_normal(3)
    for k in range(len(at)):
        slow[k] = state
        state = keep * state + np.sqrt(1.0 - keep**2) * random.standard_normal(3)
    p = p + config.slow_sigma * axes * slow
    for _ in range(config.multipath):
        begin, heading = random.uniform(0.0, seconds[-1]), random.uniform(0.0, 2.0 * np.pi)
        size = config.multipath_m * random.uniform(1.0, 2.0)
        inside = (seconds >= begin) & (seconds < begin + config.multipath_s)
        p[inside] += size * np.array([np.cos(heading), np.sin(heading), random.uniform(-1.0, 1.0)])
    present = np.ones(len(at), dtype=np.bool_)
    for _ in range(config.tunnels):
        begin = random.uniform(0.0, seconds[-1])
        present &= (seconds < begin) | (seconds >= begin + config.tunnel_s)
    p = p + np.array(config.datum_shift)
    p[seconds > 0.5 * seconds[-1]] += np.array(config.jump)
    lla = origin.to_geodetic(p)
    if config.swapped:
        lla = lla[:, [1, 0, 2]]
    if config.unit == "rad":
        lla[:, :2] = np.radians(lla[:, :2])
    covariance = None
    if config.claimed is not None:
        covariance = np.tile(np.diag((config.claimed * axes) ** 2), (len(at), 1, 1))[present]
    return GnssFixes.from_arrays(at[present] + round(config.delay_s * 1e9), lla[present], covariance)


def antenna_positions(time_ns: NDArray[np.int64], T: Floats, at_ns: NDArray[np.int64], lever: Floats) -> Floats:
    """(N, 3) where a point of the body is at times (N,), between poses (K, 7)."""
    after = np.clip(np.searchsorted(time_ns, at_ns, side="right"), 1, len(time_ns) - 1)
    A, B = T[after - 1], T[after]
    share = np.clip((at_ns - time_ns[after - 1]) / np.maximum(time_ns[after] - time_ns[after - 1], 1), 0.0, 1.0)
    poses = se3.compose(A, se3.exp(share[:, None] * se3.log(se3.compose(se3.inverse(A), B))))
    turned: Floats = quaternion.to_matrix(poses[:, :4]) @ lever
    return poses[:, 4:] + turned
