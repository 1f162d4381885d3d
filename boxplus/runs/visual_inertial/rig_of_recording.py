"""Cameras and IMU of a recording as the odometry takes them, or what of their calibration is missing."""

from __future__ import annotations

from pathlib import Path

from boxplus.errors import InputError, RecordingError
from boxplus.recordings.cameras.info import CameraRecordingInfo
from boxplus.systems.visual_inertial_odometry.config import VioConfig
from boxplus.systems.visual_inertial_odometry.rig import Rig

_NOISE = ("gyro_noise", "accel_noise", "gyro_bias_walk", "accel_bias_walk")
_CALIBRATE = "give a Kalibr camchain with --calibration camchain.yaml"


def cameras_alone(recording: Path) -> InputError:
    """That a recording has no IMU."""
    return InputError(
        "a recording with an IMU", f"cameras alone in {recording.resolve().name}", "without an IMU use 'boxplus vo'"
    )


def rig_of_recording(info: CameraRecordingInfo, config: VioConfig) -> Rig:
    """The cameras that see intensities, in the order of the recording, and the IMU. Nothing is guessed.

    Args:
        info: of the recording.
        config: with `cameras="first"` the others need no calibration.

    Raises:
        InputError: no IMU, no camera; intrinsics, mounting or the IMU's noise are not known; depth images before intensities.
    """
    if info.imu is None:
        raise cameras_alone(info.path)
    cameras = [camera for camera in info.cameras if camera.kind == "intensity"]
    if not cameras or [camera.index for camera in cameras] != list(range(len(cameras))):
        found = ", ".join(f"{camera.name} ({camera.kind})" for camera in info.cameras)
        advice = (
            "choose their topics with --image-topics; grey images of 16 bits are mono16, 16UC1 and 32FC1 are depths (REP 118)"
        )
        raise InputError("intensity images of the first cameras", found, advice)
    if config.cameras == "first":
        cameras = cameras[:1]
    try:
        known = [camera.calibrated() for camera in cameras]
    except RecordingError as error:
        missing = [f"{c.name}: {what} ({why})" for c in cameras for what, why in c.missing.items() if what != "time_offset_s"]
        raise InputError(
            "intrinsics and the mounting on the IMU of every camera", f"no {'; no '.join(missing) or error}", _CALIBRATE
        ) from error
    given = [getattr(config, name) for name in _NOISE]
    if info.imu.noise is None and None in given:
        unknown = ", ".join(name for name, value in zip(_NOISE, given, strict=True) if value is None)
        raise InputError(
            "the noise densities of the IMU",
            f"no {unknown} in the recording",
            f"{_CALIBRATE}, or set them with --set {unknown.split(', ')[0]}=…; data sheets and Allan deviations have them",
        )
    return Rig.of(
        [camera.model for camera in known],
        [camera.T_body_camera for camera in known],
        [(camera.width, camera.height) for camera in known],
        info.imu.noise,
        [camera.line_delay_s for camera in known],
    )
