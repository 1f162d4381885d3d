"""What a user may decide about the reading of a recording; everything left at None is found from the data."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from boxplus.errors import RecordingError

TimeUnit = Literal["s", "ms", "us", "ns"]
TimeReference = Literal["scan_start", "scan_end", "absolute"]
GyroUnit = Literal["rad/s", "deg/s"]
AccelUnit = Literal["m/s2", "g"]

NO_POINT_TIME = "none"
"""Value of `point_time_field` for scans without point times: every point is taken at the stamp of its message."""

NO_IMU = "none"
"""Value of `imu_topic` for a LiDAR alone: samples of an IMU are left out."""

ANY_GNSS, NO_GNSS = "auto", "none"
"""Values of `gnss_topic`: the only one there is, and none."""


class RecordingOptions(BaseModel):
    """How to read a recording. None means: find it from the data, and refuse when two readings fit.

    The command line's options are these fields.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    lidar_topic: str | None = Field(default=None, description="topic of the LiDAR (bags only)")
    imu_topic: str | None = Field(default=None, description="topic of the IMU (bags only); 'none': the LiDAR alone, without one")
    gnss_topic: str = Field(
        default=ANY_GNSS,
        description="topic of the satellite receiver; 'auto': the only one there is; 'none': positions by satellite are left out",
    )
    point_time_field: str | None = Field(
        default=None,
        description="name of the cloud's field with the time of each point; 'none' takes all points at the message's stamp",
    )
    point_time_unit: TimeUnit | None = Field(default=None, description="unit of the point times")
    point_time_reference: TimeReference | None = Field(
        default=None,
        description="instant from which point times count: start or end of the scan (the message's stamp), or absolute",
    )
    gyro_unit: GyroUnit | None = Field(default=None, description="unit of the angular velocity in the recording")
    accel_unit: AccelUnit | None = Field(default=None, description="unit of the acceleration in the recording")
    lidar_time_offset_s: float = Field(
        default=0.0,
        ge=-10.0,
        le=10.0,
        description="added to all times of the LiDAR to bring them to the IMU's clock ('boxplus calibrate' finds it) [s]",
    )
    min_range: float = Field(default=0.5, ge=0.0, description="points nearer than this are dropped: the robot itself [m]")
    max_range: float = Field(default=1000.0, gt=0.0, description="points farther than this are dropped [m]")
    start_s: float = Field(default=0.0, ge=0.0, description="skip this much at the beginning of the recording [s]")
    duration_s: float | None = Field(default=None, gt=0.0, description="read at most this much [s]")


def check_start(start_s: float, duration_s: float) -> None:
    """Raise RecordingError when the start skips a whole recording of this duration."""
    if start_s >= duration_s > 0.0:
        raise RecordingError(
            f"a start within the recording, which ends after {duration_s:.3f} s",
            f"--start {start_s:g}",
            "skip less of it",
        )
