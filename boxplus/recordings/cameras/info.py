"""What is known about a camera recording, and from where."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from boxplus.cameras import CameraModel
from boxplus.errors import RecordingError
from boxplus.recordings.info import Evidence, Topic
from boxplus.recordings.options import AccelUnit, GyroUnit
from boxplus.residuals.inertial.imu_noise import ImuNoise

ImageKind = Literal["intensity", "depth"]


@dataclass(frozen=True, slots=True)
class CalibratedCamera:
    """A camera of which everything is known that an estimator needs.

    Attributes:
        model: projection of points in the camera frame (z forward, x to the right, y down).
        T_body_camera: (4, 4) float64, camera coordinates to body coordinates.
        width, height: of the images that the model belongs to [px].
        line_delay_s: time from row to row of a rolling shutter [s]; the middle row is taken at the stamp. 0 where none is stated.

    Example:
        >>> from boxplus.recordings import CalibratedCamera
        >>> camera = CalibratedCamera(bp.Pinhole(458.7, 457.3, 367.2, 248.4), np.eye(4), 752, 480)
        >>> camera.width, camera.model.fx
        (752, 458.7)
    """

    model: CameraModel
    T_body_camera: NDArray[np.float64]
    width: int
    height: int
    line_delay_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class CameraStream:
    """One camera of a recording, or the depth images of one.

    Attributes:
        index: its number, `CameraImage.camera`.
        name: short (`cam0`, `rgb`, `/left/image_raw`).
        kind: `intensity` or `depth`.
        source: topic or folder.
        frame: name of the camera frame, empty when the format has none.
        width, height: of the first image [px].
        count: images of it.
        rate_hz: from the median step between stamps [Hz]; NaN for a single image.
        depth_unit_m: metres of one count of a depth image, None for intensities.
        model: intrinsics and distortion, or None.
        T_body_camera: (4, 4) float64, camera coordinates to body coordinates, or None. The body is the IMU where there is one,
            else the first camera.
        time_offset_s: t_imu − t_camera as calibrated [s]; it is already added to the images' times. None: not known, and
            nothing is added.
        sources: where `model`, `T_body_camera`, `time_offset_s`, `line_delay_s`, `depth_unit_m` come from.
        missing: what of these is not known, and why.
        line_delay_s: time from row to row of a rolling shutter as stated [s]; None: nothing is said of the shutter.

    Example:
        >>> from boxplus.recordings import CameraStream
        >>> stream = CameraStream(0, "cam0", "grey", "mav0/cam0", "cam0", 752, 480, 3682, 20.0)
        >>> stream.name, stream.model is None  # no calibration: no estimator takes it
        ('cam0', True)
    """

    index: int
    name: str
    kind: ImageKind
    source: str
    frame: str
    width: int
    height: int
    count: int
    rate_hz: float
    depth_unit_m: float | None = None
    model: CameraModel | None = None
    T_body_camera: NDArray[np.float64] | None = None
    time_offset_s: float | None = None
    sources: Mapping[str, str] = field(default_factory=dict)
    missing: Mapping[str, str] = field(default_factory=dict)
    line_delay_s: float | None = None

    def calibrated(self) -> CalibratedCamera:
        """The calibration, complete.

        Raises:
            RecordingError: the model or the mounting is not known; the message says which, and why.
        """
        model, T_body_camera = self.model, self.T_body_camera
        if model is None or T_body_camera is None:
            unknown = [f"{what} ({self.missing.get(what, 'not in the recording')})" for what in ("model", "T_body_camera")]
            known = (model is not None, T_body_camera is not None)
            raise RecordingError(
                f"the calibration of {self.name}: model and T_body_camera",
                "no " + " and no ".join(text for text, there in zip(unknown, known, strict=True) if not there),
                "give a Kalibr camchain: --calibration FILE, or CameraRecordingOptions(calibration=…)",
            )
        return CalibratedCamera(model, T_body_camera, self.width, self.height, self.line_delay_s or 0.0)

    @property
    def readout_s(self) -> float:
        """Time from the first row to the last as stated [s]; 0 where nothing is."""
        return (self.line_delay_s or 0.0) * (self.height - 1)


@dataclass(frozen=True, slots=True)
class ImuStream:
    """The IMU of a camera recording.

    Attributes:
        source: topic or file.
        frame: name of its frame, empty when the format has none.
        count: samples.
        rate_hz: from the median step between stamps [Hz].
        gyro_unit, accel_unit: in the recording; samples are delivered in SI units.
        noise: densities as calibrated, or None when the recording does not say.
        noise_source: where they come from, empty when unknown.

    Example:
        >>> from boxplus.recordings import ImuStream
        >>> ImuStream("mav0/imu0", "imu0", 36820, 200.0, "rad/s", "m/s2").rate_hz
        200.0
    """

    source: str
    frame: str
    count: int
    rate_hz: float
    gyro_unit: GyroUnit
    accel_unit: AccelUnit
    noise: ImuNoise | None = None
    noise_source: str = ""


@dataclass(slots=True)
class CameraRecordingInfo:
    """What a camera recording contains and how it is read.

    Attributes:
        path: the file or folder.
        format: `ROS 1 bag`, `EuRoC ASL folder`, `TUM RGB-D folder` …
        topics: all streams found.
        duration_s: time between the first and the last message [s].
        message_count: images and IMU samples that will be read.
        cameras: in the order of their indices.
        imu: or None when there is none.
        evidence: every decision with its reasons; grows while a damaged file is read.

    Example:
        >>> from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras
        >>> recording = as_camera_recording(simulate_cameras("room", duration_s=1.0, rig=make_rig("stereo", scale=0.25)))
        >>> [camera.name for camera in recording.info.cameras], recording.info.imu.rate_hz
        (['cam0', 'cam1'], 200.0)
    """

    path: Path
    format: str
    topics: list[Topic]
    duration_s: float
    message_count: int
    cameras: list[CameraStream]
    imu: ImuStream | None
    evidence: list[Evidence] = field(default_factory=list)

    @property
    def body_frame(self) -> str:
        """Which frame `T_body_camera` refers to: `imu`, or the name of the first camera."""
        return "imu" if self.imu is not None else self.cameras[0].name

    def camera(self, name: str) -> CameraStream:
        """The camera of this name.

        Raises:
            RecordingError: there is none.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise RecordingError(
            f"a camera named {name}", f"{', '.join(camera.name for camera in self.cameras)}", "choose one of these"
        )
