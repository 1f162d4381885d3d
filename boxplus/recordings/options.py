"""What a user may decide about the reading of a recording; everything left at None is found from the data."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator, model_validator

from boxplus._settings import Settings
from boxplus.errors import InputError, RecordingError

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


class OtherLidar(Settings):
    """A LiDAR beside the first one, to be merged with it (docs/several_lidars.md). Only its topic has to be given.

    A text stands for its topic, or, in braces, for all of it in YAML: `{topic: /rear, time_offset_s: 0.05}`.

    Example:
        >>> from boxplus.recordings import OtherLidar
        >>> rear = OtherLidar(topic="/rear", time_offset_s=0.01)
        >>> bp.RecordingOptions(lidar_topic="/front", other_lidars=(rear,)).other_lidars[0].topic
        '/rear'
    """

    topic: str = Field(description="topic of its clouds")
    T_lidar_other: tuple[tuple[float, ...], ...] | None = Field(
        default=None,
        description="its pose in the frame of the first LiDAR, 4×4 row-major: p_first = T_lidar_other p_other; None takes it "
        "from the static transforms",
    )
    time_offset_s: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="added to all its times to bring them to the clock of the first LiDAR [s]"
    )
    point_time_field: str | None = Field(default=None, description="as for the first LiDAR")
    point_time_unit: TimeUnit | None = Field(default=None, description="as for the first LiDAR")
    point_time_reference: TimeReference | None = Field(default=None, description="as for the first LiDAR")
    min_range: float | None = Field(default=None, ge=0.0, description="None: that of the first LiDAR [m]")
    max_range: float | None = Field(default=None, gt=0.0, description="None: that of the first LiDAR [m]")

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: object) -> object:
        if not isinstance(value, str):
            return value
        if not value.lstrip().startswith("{"):
            return {"topic": value}
        import yaml  # here, as is numpy below: a command's --help, which lists these fields, needs neither

        try:
            return yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise InputError(
                "another LiDAR as a topic or as {topic: …, key: value} in YAML", repr(value), "see docs/several_lidars.md"
            ) from error

    @field_validator("T_lidar_other")
    @classmethod
    def _rigid(cls, value: tuple[tuple[float, ...], ...] | None) -> tuple[tuple[float, ...], ...] | None:
        if value is None:
            return None
        import numpy as np

        from boxplus.filtering.nav_state import check_transform  # here, as commands that read no recording start faster without

        return tuple(tuple(float(x) for x in row) for row in check_transform("T_lidar_other", np.array(value)))


class RecordingOptions(Settings):
    """How to read a recording. None means: find it from the data, and refuse when two readings fit.

    The command line's options are these fields.

    Example:
        >>> options = bp.RecordingOptions(min_range=1.0, duration_s=60.0)
        >>> options.min_range, options.lidar_topic
        (1.0, None)
    """

    lidar_topic: str | None = Field(default=None, description="topic of the LiDAR, of several the first one (bags only)")
    other_lidars: tuple[OtherLidar, ...] | None = Field(
        default=None,
        description="LiDARs to merge with the first one: topics, or {topic: …, T_lidar_other: …, time_offset_s: …} (bags only)",
    )
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

    @model_validator(mode="after")
    def _each_once(self) -> RecordingOptions:
        if not self.other_lidars:
            return self
        topics = [other.topic for other in self.other_lidars]
        if self.lidar_topic is None:
            raise InputError(
                "lidar_topic (--lidar-topic) beside other_lidars: the LiDAR whose frame and scans are those of the result",
                f"only the others, {', '.join(topics)}",
                "name the first LiDAR",
            )
        if len({self.lidar_topic, *topics}) != 1 + len(topics):
            raise InputError("every LiDAR once", f"{self.lidar_topic}, {', '.join(topics)}", "leave the repeated ones out")
        return self

    @model_validator(mode="after")
    def _some_range_is_left(self) -> RecordingOptions:
        for name, one in [("", None), *((f" of {other.topic}", other) for other in self.other_lidars or ())]:
            low, high = self._range_of(one)
            if low >= high:
                raise InputError(
                    f"min_range (--min-range) below max_range (--max-range){name}",
                    f"{low:g} and {high:g} m, between which no point lies",
                    "lower the first or raise the second",
                )
        return self

    def _range_of(self, other: OtherLidar | None) -> tuple[float, float]:
        """The least and the greatest range of points that are taken, of the first LiDAR where no other is given [m]."""
        low, high = (None, None) if other is None else (other.min_range, other.max_range)
        return self.min_range if low is None else low, self.max_range if high is None else high

    def alone(self, other: OtherLidar) -> RecordingOptions:
        """How one of the other LiDARs would be read as the only one, by its own clock."""
        own = other.model_dump(include={"point_time_field", "point_time_unit", "point_time_reference"})
        own["min_range"], own["max_range"] = self._range_of(other)
        return self.model_copy(update={**own, "lidar_topic": other.topic, "other_lidars": None, "lidar_time_offset_s": 0.0})


def check_start(start_s: float, duration_s: float) -> None:
    """Raise RecordingError when the start skips a whole recording of this duration."""
    if start_s >= duration_s > 0.0:
        raise RecordingError(
            f"a start within the recording, which ends after {duration_s:.3f} s",
            f"--start {start_s:g}",
            "skip less of it",
        )
