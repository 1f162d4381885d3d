"""The settings of loop closure. None has to be given."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus._settings import Settings
from boxplus.maps.descriptors.config import DescriptorConfig
from boxplus.maps.local_maps.config import LocalMapRegistrationConfig


class SlamConfig(Settings):
    """Which loops are looked for, and which are believed.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> SlamConfig(least_overlap=0.6).least_overlap
        0.6
    """

    descriptor: DescriptorConfig = Field(DescriptorConfig(), description="see DescriptorConfig")
    registration: LocalMapRegistrationConfig = Field(LocalMapRegistrationConfig(), description="see LocalMapRegistrationConfig")
    appearance: Literal["density", "scan_context", "none"] = Field(
        "density",
        description="how places are recognised: by features of density images (needs the extra vision), and by scan contexts "
        "where these find nothing; by scan contexts alone; or not at all, by where the estimate has them only",
    )
    context_range: float = Field(40.0, gt=0, description="reach of scan contexts [m]")
    context_distance: float = Field(0.4, gt=0, le=1, description="of two scan contexts that look alike, at most")
    least_way: float = Field(30.0, ge=0, description="way between two visits of a loop, at least [m]")
    nearby: float = Field(12.0, ge=0, description="places within this of where one should be are tried [m]; 0: none")
    nearby_sigma: float = Field(3.0, gt=0, description="where the position against them is known to this [m]")
    nearby_count: int = Field(3, ge=0, description="how many of them")
    least_overlap: float = Field(0.5, ge=0, le=1, description="share of points of either map that the other one has too")
    largest_rms: float = Field(1.5, gt=0, description="distances to planes against those of successive maps, at most")
    least_measured: int = Field(5, ge=1, le=6, description="directions of the pose that the surfaces determine")
    innovation: float = Field(0.999, gt=0, lt=1, description="probability of a true loop to agree with the odometry")
    odometry_scale: float = Field(1.5, gt=0, description="factor of the odometry's standard deviations in that test")
    rival_distance: float = Field(1.5, gt=0, description="as good a fit this far away makes a loop ambiguous [m]")
    rival_fit: float = Field(0.95, gt=0, le=1, description="as good: with this share of the points that fit")
    seam: float = Field(
        0.35, gt=0, le=1, description="share of what stands that successive maps see through, from which on it is a slip; 1: none"
    )
    gravity_sigma: float = Field(0.005, gt=0, description="standard deviation of the vertical of a local map [rad]")

    def without_gravity(self) -> SlamConfig:
        """Those for an odometry without an IMU: what was taken for its vertical holds no local map upright.

        A radian beside the milliradians by which an odometry turns from map to map.
        """
        return self.model_copy(update={"gravity_sigma": 1.0})
