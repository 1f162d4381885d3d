"""Models of LiDARs: when which ray leaves the sensor, and the noise of its range."""

from __future__ import annotations

import functools
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from boxplus._settings import Settings


class Rays(NamedTuple):
    """The rays of one scan, in order of time.

    Attributes:
        offset_s: (M,) time of every firing after the start of the scan, in (0, period] [s].
        directions_lidar: (N, 3) unit vectors in the LiDAR frame; N / M rays leave in each firing.
    """

    offset_s: NDArray[np.float64]
    directions_lidar: NDArray[np.float64]


class _Lidar(Settings):
    rate_hz: float = Field(10.0, gt=0, description="scans per second")
    range_sigma_m: float = Field(0.02, ge=0, description="standard deviation of the range [m]")
    min_range: float = Field(0.5, ge=0, description="nearer returns are not reported [m]")
    max_range: float = Field(100.0, gt=0, description="farther returns are not reported [m]")


class SpinningLidar(_Lidar):
    """A mechanical LiDAR: channels one above the other turn about z, all firing at once, counter-clockwise from +x."""

    kind: Literal["spinning"] = "spinning"
    channels: int = Field(16, ge=1, description="rays per firing")
    azimuth_steps: int = Field(1625, ge=1, description="firings per turn")
    vertical_fov_deg: tuple[float, float] = Field((-15.0, 15.0), description="elevation of the lowest and highest channel [deg]")

    def rays(self, scan_index: int) -> Rays:
        """The rays of a scan; the same for all."""
        del scan_index
        return _spinning_rays(self.rate_hz, self.channels, self.azimuth_steps, self.vertical_fov_deg)

    def ring(self, p_lidar: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Channel (N,) of points (N, 3), counted from below."""
        low, high = np.deg2rad(self.vertical_fov_deg)
        elevation = np.arctan2(p_lidar[:, 2], np.hypot(p_lidar[:, 0], p_lidar[:, 1]))
        ring = np.rint((elevation - low) / max(high - low, 1e-9) * (self.channels - 1))
        found: NDArray[np.uint16] = np.clip(np.nan_to_num(ring), 0, self.channels - 1).astype(np.uint16)
        return found


class RosetteLidar(_Lidar):
    """A LiDAR with two turning prisms that looks along +x and draws a rosette that never repeats (Livox Mid and Avia).

    The angle of a ray off the axis is the sum of two vectors of a quarter of the field of view each, turning at unrelated rates.
    """

    kind: Literal["rosette"] = "rosette"
    fov_deg: float = Field(70.0, gt=0, lt=170, description="full cone of view [deg]")
    points_per_scan: int = Field(24000, ge=1, description="rays per scan")
    prism_rates_hz: tuple[float, float] = Field((121.5672, -77.7333), description="turns per second of the two prisms")

    def rays(self, scan_index: int) -> Rays:
        """The rays of a scan; every scan continues the figure of the one before."""
        offset_s = np.arange(1, self.points_per_scan + 1) / (self.points_per_scan * self.rate_hz)
        time = scan_index / self.rate_hz + offset_s
        first, second = (2.0 * np.pi * np.mod(rate * time, 1.0) for rate in self.prism_rates_hz)
        quarter = 0.25 * np.deg2rad(self.fov_deg)
        left, up = quarter * (np.cos(first) + np.cos(second)), quarter * (np.sin(first) + np.sin(second))
        angle = np.hypot(left, up)
        across = np.sinc(angle / np.pi)
        return Rays(offset_s, np.stack([np.cos(angle), across * left, across * up], axis=1))

    def ring(self, p_lidar: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Zero (N,): one laser draws the whole figure."""
        return np.zeros(len(p_lidar), np.uint16)


class OmniLidar(_Lidar):
    """A LiDAR that looks all around, mostly up, and draws a figure that never repeats (Livox Mid-360).

    One ray swings up and down at an even speed while it turns about z.
    """

    kind: Literal["omni"] = "omni"
    points_per_scan: int = Field(20000, ge=1, description="rays per scan")
    vertical_fov_deg: tuple[float, float] = Field((-7.0, 52.0), description="elevation of the lowest and highest ray [deg]")
    turns_hz: float = Field(19.3718, gt=0, description="turns about z per second")
    swings_hz: float = Field(517.2911, gt=0, description="swings up and down again per second")

    def rays(self, scan_index: int) -> Rays:
        """The rays of a scan; every scan continues the figure of the one before."""
        offset_s = np.arange(1, self.points_per_scan + 1) / (self.points_per_scan * self.rate_hz)
        time = scan_index / self.rate_hz + offset_s
        azimuth = 2.0 * np.pi * np.mod(self.turns_hz * time, 1.0)
        low, high = np.deg2rad(self.vertical_fov_deg)
        elevation = low + (high - low) * np.abs(2.0 * np.mod(self.swings_hz * time, 1.0) - 1.0)
        level = np.cos(elevation)
        return Rays(offset_s, np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1))

    def ring(self, p_lidar: NDArray[np.float32]) -> NDArray[np.uint16]:
        """Zero (N,): one laser draws the whole figure."""
        return np.zeros(len(p_lidar), np.uint16)


LidarModel = Annotated[SpinningLidar | RosetteLidar | OmniLidar, Field(discriminator="kind")]


@functools.lru_cache(maxsize=4)
def _spinning_rays(rate_hz: float, channels: int, azimuth_steps: int, vertical_fov_deg: tuple[float, float]) -> Rays:
    firing = np.arange(1, azimuth_steps + 1)
    azimuth = 2.0 * np.pi * (firing - 1) / azimuth_steps
    elevation = np.deg2rad(np.linspace(*vertical_fov_deg, channels))
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(azimuth, elevation, indexing="ij"))
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    directions.setflags(write=False)
    offset_s = firing / (azimuth_steps * rate_hz)
    offset_s.setflags(write=False)
    return Rays(offset_s, directions)
