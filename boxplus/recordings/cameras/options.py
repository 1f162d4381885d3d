"""What a user may decide about the reading of a camera recording; what is left at None is found from the recording."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from boxplus._settings import Settings
from boxplus.recordings.options import AccelUnit, GyroUnit


class CameraRecordingOptions(Settings):
    """How to read a camera recording. None means: as the recording says, and refuse where it does not say.

    Example:
        >>> bp.CameraRecordingOptions(start_s=5.0, frame_rate_hz=20.0).frame_rate_hz
        20.0
    """

    image_topics: tuple[str, ...] | None = Field(
        default=None, description="topics of the images, in the order in which the cameras are numbered (bags only)"
    )
    imu_topic: str | None = Field(default=None, description="topic of the IMU (bags only)")
    calibration: Path | None = Field(
        default=None, description="Kalibr camchain (YAML) with the calibration; it overrules what the recording says"
    )
    frame_rate_hz: float | None = Field(
        default=None, gt=0.0, description="images a second, for folders without times of their images [Hz]"
    )
    depth_unit_m: float | None = Field(
        default=None, gt=0.0, description="metres of one count of a 16-bit depth image; else as the format defines it [m]"
    )
    gyro_unit: GyroUnit | None = Field(default=None, description="unit of the angular velocity in the recording")
    accel_unit: AccelUnit | None = Field(default=None, description="unit of the acceleration in the recording")
    start_s: float = Field(default=0.0, ge=0.0, description="skip this much at the beginning of the recording [s]")
    duration_s: float | None = Field(default=None, gt=0.0, description="read at most this much [s]")
