"""Everything that can be set for a run of `boxplus vio`."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.runs.settings_file import dump_settings
from boxplus.systems.visual_inertial_odometry.config import VioConfig


class VioRunConfig(Settings):
    """Settings of a run with cameras and IMU; this is what `config.yaml` holds. None has to be given."""

    recording: CameraRecordingOptions = Field(default_factory=lambda: CameraRecordingOptions())
    odometry: VioConfig = Field(default_factory=lambda: VioConfig())  # type: ignore[call-arg]


def dump_vio_config(config: VioRunConfig, info: CameraRecordingInfo) -> str:
    """The text of `config.yaml`: everything as used, topics and units found from the data included."""
    used = config.model_dump(mode="json")
    found = used["recording"]
    if any(topic.name == camera.source for topic in info.topics for camera in info.cameras):
        found["image_topics"] = [camera.source for camera in info.cameras]
    if info.imu is not None:
        found["gyro_unit"], found["accel_unit"] = info.imu.gyro_unit, info.imu.accel_unit
        if any(topic.name == info.imu.source for topic in info.topics):
            found["imu_topic"] = info.imu.source
    head = "# Settings of this run, those found from the data included: 'boxplus vio RECORDING --config FILE' repeats it.\n"
    return dump_settings(head, used)
