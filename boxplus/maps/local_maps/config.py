"""Where local maps are cut, how much the odometry between them is believed, and how two are laid over each other."""

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


class LocalMapRegistrationConfig(Settings):
    """How two local maps are laid over each other, and what their covariance is made of."""

    thickness: float = Field(0.15, gt=0, description="a plane's points lie within this of it [m]")
    near: float = Field(0.5, gt=0, description="a point overlaps with a map that has one within this [m]")
    cluster: float = Field(4.0, gt=0, description="side of the cells within which residuals may be correlated fully [m]")
    inflation: float = Field(2.0, gt=0, description="factor of the covariance, from simulated worlds")
    floor_rotation: float = Field(5e-4, ge=0, description="smallest standard deviation of a rotation [rad]")
    floor_position: float = Field(0.01, ge=0, description="smallest standard deviation of a position [m]")
    weak_information: float = Field(0.01, ge=0, description="a direction with less information per point is not measured")
    weak_sigma: float = Field(0.3, gt=0, description="nor one with a larger standard deviation [m at the points]")
    open_sigma: float = Field(2.0, gt=0, description="standard deviation stated for what was not measured [m at the points]")
    threads: int = Field(1, ge=1, description="the result does not depend on it")
