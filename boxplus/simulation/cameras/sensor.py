"""Models of cameras: lens, mounting, shutter, exposure, noise; and rigs of several of them."""

from __future__ import annotations

from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from boxplus._settings import Settings
from boxplus.cameras import CameraModel, Equidistant, Pinhole, RadialTangential
from boxplus.errors import InputError
from boxplus.manifolds import so3

LensKind = Literal["pinhole", "radtan", "equidistant"]
RigKind = Literal["mono", "stereo", "rgbd"]

ELECTRONS_PER_GREY = 39.0
"""At a gain of one: 10,000 electrons make 255 grey values."""
GREY_PER_LIGHT_SECOND = 60_000.0
"""A radiance of one makes 240 grey values in 4 ms at a gain of one, in the light of day."""

_AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_imu_camera of a camera that looks along x of the IMU, z of the IMU up."""


class Lens(Settings):
    """Projection of a camera: z forward, u to the right, v down, pixel centres at integers."""

    kind: LensKind = "radtan"
    intrinsics: tuple[float, float, float, float] = Field(description="fx, fy, cx, cy [px]")
    distortion: tuple[float, ...] = Field((), description="k1 k2 p1 p2 of radtan, k1 k2 k3 k4 of equidistant")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        wanted = 0 if self.kind == "pinhole" else 4
        if len(self.distortion) != wanted:
            raise InputError(
                f"{wanted} coefficients of {self.kind}", f"{len(self.distortion)}", "give all of them, zeros where there are none"
            )
        self.model()
        return self

    def model(self) -> CameraModel:
        """The camera model."""
        if self.kind == "equidistant":
            return Equidistant(*self.intrinsics, *self.distortion)
        return Pinhole(*self.intrinsics, RadialTangential(*self.distortion) if self.kind == "radtan" else None)


class Exposure(Settings):
    """How long the shutter is open and how much is amplified; it follows the mean brightness of the first camera.

    The product of time and gain follows what would give `target` with the delay of a controller; time comes first, then gain.
    """

    auto: bool = Field(True, description="follow the light; else always `shortest_s` · `fixed`")
    target: float = Field(105.0, gt=0, lt=255, description="mean grey value aimed at")
    delay_s: float = Field(0.25, gt=0, description="time constant of the controller [s]")
    shortest_s: float = Field(2e-4, gt=0, description="[s]")
    longest_s: float = Field(0.012, gt=0, description="[s]")
    largest_gain: float = Field(8.0, ge=1.0)
    fixed: float = Field(20.0, gt=0, description="exposure in units of `shortest_s` where it is not automatic")
    jumps: float = Field(0.0, ge=0, lt=1, description="every second the exposure jumps by a factor up to 1 ± this")


class CameraSensor(Settings):
    """A camera; the default is one of the size and lens of EuRoC's.

    The stamp of an image is the middle of the exposure of its middle row; row v is exposed
    `(v − (height − 1) / 2) · line_delay_s` later. Without a delay it is a global shutter.
    """

    width: int = Field(752, ge=16, le=8192, description="[px]")
    height: int = Field(480, ge=16, le=8192, description="[px]")
    lens: Lens = Lens(intrinsics=(458.0, 457.0, 372.0, 246.0), distortion=(-0.283, 0.074, 2e-4, 2e-5))
    line_delay_s: float = Field(0.0, ge=0, description="time from row to row of a rolling shutter [s]")
    vignetting: float = Field(0.25, ge=0, lt=1, description="share of the light that is missing in the corners")
    noise: float = Field(1.0, ge=0, description="factor on shot and read noise; 0 is none")
    read_noise: float = Field(12.0, ge=0, description="of every pixel [electrons]")
    sharpness_px: float = Field(0.6, ge=0, description="standard deviation of the lens' own blur [px]")
    blur_samples: int = Field(12, ge=1, le=64, description="most instants an exposure is the mean of; 1 is no motion blur")

    def scaled(self, factor: float) -> Self:
        """The same field of view with `factor` times as many pixels a row."""
        fx, fy, cx, cy = self.lens.intrinsics
        moved = (fx * factor, fy * factor, (cx + 0.5) * factor - 0.5, (cy + 0.5) * factor - 0.5)
        lens = self.lens.model_copy(update={"intrinsics": moved})
        size = {"width": round(self.width * factor), "height": round(self.height * factor)}
        return self.model_copy(update={"lens": lens, **size, "line_delay_s": self.line_delay_s / factor})


class MountedCamera(Settings):
    """A camera on a body.

    Attributes:
        sensor: the camera.
        T_imu_camera: 4 × 4, camera coordinates to IMU coordinates.
    """

    sensor: CameraSensor
    T_imu_camera: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _rigid(self) -> Self:
        T = np.array(self.T_imu_camera)
        if T.shape != (4, 4) or not so3.is_rotation(T[:3, :3]):
            raise InputError("T_imu_camera (4, 4) with a rotation", f"shape {T.shape}", "give a rigid transform")
        return self

    @property
    def mounting(self) -> NDArray[np.float64]:
        """`T_imu_camera` (4, 4) as an array."""
        return np.array(self.T_imu_camera, dtype=np.float64)


class CameraRig(Settings):
    """Cameras that are triggered together.

    Attributes:
        cameras: in the order of their indices, `cam0` first.
        rate_hz: images a second.
        exposure: common to all.
        depth: exact depth images of the first camera come with its images, as another camera.
    """

    cameras: tuple[MountedCamera, ...] = Field(min_length=1)
    rate_hz: float = Field(20.0, gt=0, description="images a second")
    exposure: Exposure = Exposure()
    depth: bool = False


def camera_mounting(
    p_imu_camera: tuple[float, float, float], roll_deg: float = 0.0, pitch_deg: float = 0.0, yaw_deg: float = 0.0
) -> tuple[tuple[float, ...], ...]:
    """T_imu_camera of a camera at `p_imu_camera` [m] that looks along x of the IMU, turned by small angles about its own axes."""
    T = np.eye(4)
    T[:3, :3] = _AXES @ so3.exp(np.deg2rad([pitch_deg, yaw_deg, roll_deg]))
    T[:3, 3] = p_imu_camera
    return tuple(map(tuple, T.tolist()))


_LENSES: dict[LensKind, tuple[Lens, Lens]] = {
    "pinhole": (
        Lens(kind="pinhole", intrinsics=(458.0, 457.0, 372.0, 246.0)),
        Lens(kind="pinhole", intrinsics=(457.0, 456.0, 379.0, 238.0)),
    ),
    "radtan": (
        Lens(intrinsics=(458.0, 457.0, 372.0, 246.0), distortion=(-0.283, 0.074, 2e-4, 2e-5)),
        Lens(intrinsics=(457.0, 456.0, 379.0, 238.0), distortion=(-0.284, 0.075, -1e-4, -4e-5)),
    ),
    "equidistant": (
        Lens(kind="equidistant", intrinsics=(285.0, 284.0, 371.0, 243.0), distortion=(-0.01, 0.02, -0.012, 0.003)),
        Lens(kind="equidistant", intrinsics=(286.0, 285.0, 380.0, 236.0), distortion=(-0.008, 0.018, -0.011, 0.003)),
    ),
}


def make_rig(kind: RigKind = "stereo", lens: LensKind | None = None, scale: float = 1.0, rate_hz: float = 20.0) -> CameraRig:
    """A rig of one camera, of two 11 cm apart, or of one with depths.

    Args:
        kind: `mono`, `stereo` or `rgbd`.
        lens: `pinhole`, `radtan` or `equidistant`; radtan when not given, pinhole with depths.
        scale: factor on the 752 × 480 pixels; the field of view stays.
        rate_hz: images a second.

    Example:
        >>> rig = make_rig("stereo", lens="equidistant", scale=0.5)
        >>> [(camera.sensor.width, camera.sensor.lens.kind) for camera in rig.cameras]
        [(376, 'equidistant'), (376, 'equidistant')]
    """
    first, second = _LENSES[lens or ("pinhole" if kind == "rgbd" else "radtan")]
    sensor = CameraSensor(lens=first).scaled(scale)
    left = MountedCamera(sensor=sensor, T_imu_camera=camera_mounting((0.07, 0.058, 0.012), 0.9, -0.6, 1.1))
    cameras: tuple[MountedCamera, ...] = (left,)
    if kind == "stereo":
        other = CameraSensor(lens=second).scaled(scale)
        cameras += (MountedCamera(sensor=other, T_imu_camera=camera_mounting((0.068, -0.052, 0.010), 0.2, -0.3, 0.4)),)
    return CameraRig(cameras=cameras, rate_hz=rate_hz, depth=kind == "rgbd")
