"""The settings of visual-inertial odometry. None has to be given."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus._settings import Settings

# One camera knows depths by its motion alone: with eight, landmarks leave before their depth is known, and simulated flights are
# off by a sixth to a third more than with twelve.
_KEYFRAMES, _KEYFRAMES_MONO = 8, 12


class VioConfig(Settings):
    """Settings of `VisualInertialOdometry`; lengths in metres, times in seconds, noise as densities (per √Hz).

    Raises:
        InputError: a setting is unknown or out of range.

    Example:
        >>> bp.VioConfig(keyframes=8).keyframes
        8
    """

    cameras: Literal["all", "first"] = Field("all", description="all cameras of the rig (stereo), or the first one alone (mono)")
    features: int = Field(150, ge=30, le=2000, description="corners followed at most")
    cell_size: int = Field(40, ge=8, description="side of the cells of the image that hold a corner or two each [px]")
    pixel_sigma: float = Field(0.3, gt=0, description="standard deviation of a tracked corner along each axis [px]")
    there_and_back: float = Field(0.7, gt=0, description="a corner tracked to the next image and back ends this near [px]")
    epipolar: float = Field(1.5, gt=0, description="a corner lies this near to its epipolar line in another image [px]")
    lines: bool = Field(False, description="follow straight lines beside the corners")
    max_lines: int = Field(30, ge=1, le=200, description="lines followed at most")
    line_sigma: float = Field(0.15, gt=0, description="standard deviation of the ends of a segment across it [px]")
    keyframes: int | None = Field(
        None,
        ge=3,
        le=30,
        description="keyframes in the window; None is 8, and 12 with one camera, which needs longer to see depth",
    )
    recent_frames: int = Field(2, ge=1, le=5, description="newest frames that are kept whether keyframes or not")
    spared_keyframes: int = Field(
        2, ge=1, le=5, description="newest keyframes whose sight of a landmark that leaves the window founds it anew"
    )
    keyframe_parallax: float = Field(
        12.0, gt=0, description="parallax since the last keyframe that makes a new one, in the mean [px]"
    )
    keyframe_tracked: float = Field(0.7, gt=0, lt=1, description="a smaller share of landmarks still tracked makes a keyframe")
    keyframe_interval: float = Field(1.0, gt=0, description="longest time between keyframes while moving [s]")
    max_iterations: int = Field(4, ge=1, le=50, description="steps of the solver per frame; more where all of them are refused")
    gyro_noise: float | None = Field(None, gt=0, description="gyroscope noise [rad/s/√Hz]; None is what the rig states")
    accel_noise: float | None = Field(None, gt=0, description="accelerometer noise [m/s²/√Hz]; None is what the rig states")
    gyro_bias_walk: float | None = Field(
        None, gt=0, description="random walk of the gyroscope bias [rad/s²/√Hz]; None is what the rig states"
    )
    accel_bias_walk: float | None = Field(
        None, gt=0, description="random walk of the accelerometer bias [m/s³/√Hz]; None is what the rig states"
    )
    accel_bias_sigma: float = Field(
        0.2, gt=0, description="standard deviation of the accelerometer's bias beforehand, along each axis [m/s²]"
    )
    gravity: float = Field(9.81, gt=9.7, lt=9.9, description="magnitude of gravity [m/s²]")
    max_imu_gap: float = Field(0.15, gt=0, description="longest interval between IMU samples that is integrated over [s]")
    max_blind: float = Field(1.0, gt=0, description="time without a view after which the IMU's pose counts as lost [s]")
    extrinsic_estimation: bool = Field(False, description="refine T_imu_camera of every camera while running")
    extrinsic_rotation_sigma_deg: float = Field(0.2, gt=0, description="of the rotation in T_imu_camera, about each axis [deg]")
    extrinsic_translation_sigma: float = Field(0.005, gt=0, description="of the translation in T_imu_camera, along each axis [m]")
    time_offset_estimation: bool = Field(False, description="refine the offset of the cameras' clock while running")
    time_offset_sigma: float = Field(0.005, gt=0, description="standard deviation of the clocks' offset beforehand [s]")
    start_duration: float = Field(1.0, gt=0, description="time over which the start is observed, at rest or moving [s]")

    def keyframes_of(self, cameras: int) -> int:
        """Keyframes in the window of a rig of so many cameras."""
        return self.keyframes or (_KEYFRAMES_MONO if cameras == 1 else _KEYFRAMES)

    @property
    def refines_mounting(self) -> bool:
        """Whether mountings or the clock of the cameras are refined while running."""
        return self.extrinsic_estimation or self.time_offset_estimation
