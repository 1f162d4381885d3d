"""Everything that can be set for a run of `boxplus vo`."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.runs.settings_file import dump_settings
from boxplus.systems.direct_odometry.config import DirectOdometryConfig


class StreamConfig(Settings):
    """Which streams of a recording the odometry takes."""

    mono: bool = Field(
        default=False,
        description="the first camera alone, whatever else there is; then the scale is not known",
    )


class DirectRunConfig(Settings):
    """Settings of a run of direct odometry; this is what `config.yaml` holds. None has to be given."""

    recording: CameraRecordingOptions = Field(default_factory=lambda: CameraRecordingOptions())
    streams: StreamConfig = Field(default_factory=lambda: StreamConfig())
    odometry: DirectOdometryConfig = Field(default_factory=lambda: DirectOdometryConfig())


def dump_direct_config(config: DirectRunConfig, info: CameraRecordingInfo) -> str:
    """The text of `config.yaml`: everything as used, topics found from the data included."""
    used = config.model_dump(mode="json")
    if any(topic.name == camera.source for topic in info.topics for camera in info.cameras):
        used["recording"]["image_topics"] = [camera.source for camera in info.cameras]
    head = "# Settings of this run, those found from the data included: 'boxplus vo RECORDING --config FILE' repeats it.\n"
    return dump_settings(head, used)
