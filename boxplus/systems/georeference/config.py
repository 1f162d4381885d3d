"""The settings of the georeference. None has to be given."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class GeoreferenceConfig(Settings):
    """How positions by satellite are weighed against an odometry, and which are believed.

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> GeoreferenceConfig(lever_arm=(0.1, 0.0, 0.85)).lever_arm
        (0.1, 0.0, 0.85)
    """

    lever_arm: tuple[float, float, float] | None = Field(
        None, description="antenna in the IMU's frame [m]; null: the recording's, and where it has none, estimated"
    )
    lever_sigma: float = Field(1.0, gt=0, description="standard deviation of a lever arm that nobody gave, about zero [m]")
    time_offset_s: float = Field(0.0, ge=-60, le=60, description="added to the times of the fixes [s]")
    delay_sigma: float = Field(0.1, gt=0, description="standard deviation of how late fixes are stamped beyond that [s]")
    sigma: float = Field(3.0, gt=0, description="of east and north where the receiver states none; up: twice of it [m]")
    least_sigma: float = Field(0.02, gt=0, description="no fix is believed better than this [m]")
    interval: float = Field(1.0, ge=0, description="one fix in this time is used [s]")
    correlation: float = Field(30.0, ge=0, description="errors of fixes stay for this long: as much as one fix counts in it [s]")
    inlier: float = Field(0.999, gt=0, lt=1, description="probability of a true fix to be taken for one")
    most_gated: float = Field(0.4, gt=0, lt=1, description="with a larger share of fixes that fit nothing, none is believed")
    utm: bool = Field(False, description="write the trajectory in UTM, too; needs the extra gnss")
    largest_yaw_sigma: float = Field(0.05, gt=0, description="a heading known worse than this is not determined [rad]")
