"""Where local maps are cut, and how much the odometry between them is believed."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class LocalMapConfig(Settings):
    """Settings of `LocalMapBuilder`.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> LocalMapConfig(length=50.0).length
        50.0
    """

    length: float = Field(20.0, gt=0, description="way after which a local map is cut [m]")
    duration: float = Field(5.0, gt=0, description="time after which it is cut, where `least_length` has been travelled [s]")
    least_length: float = Field(2.0, ge=0, description="shortest way of a local map: standing still makes none [m]")
    voxel: float = Field(0.25, gt=0, description="side of the voxels that keep one point each [m]")
    max_range: float = Field(80.0, gt=0, description="farther points are left out: angles blur them [m]")
    drift_rotation: float = Field(
        5e-4, ge=0, description="random walk of the odometry's rotation about each axis beside its own covariance [rad/√m]"
    )
    drift_position: float = Field(0.01, ge=0, description="and of its position along each axis [m/√m]")
