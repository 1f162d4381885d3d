"""Settings of direct odometry."""

from __future__ import annotations

from pydantic import Field

from boxplus._settings import Settings


class DirectOdometryConfig(Settings):
    """Settings of `DirectOdometry`; every one has a default that served indoor RGB-D and outdoor stereo alike.

    Example:
        >>> bp.DirectOdometryConfig(window=5).keyframe_flow > 0.0
        True
    """

    levels: int = Field(default=5, ge=1, le=10, description="of the image pyramid, each half the resolution of the one before")
    pixels: int = Field(default=3000, ge=300, le=100_000, description="compared at each level when a frame is tracked")
    patches: int = Field(default=250, ge=50, le=5000, description="of each keyframe that the window adjusts")
    window: int = Field(default=7, ge=2, le=20, description="keyframes that are adjusted together")
    adjustments: int = Field(default=5, ge=0, le=50, description="steps of the window's adjustment at a keyframe; 0 turns it off")
    keyframe_flow: float = Field(
        default=0.05, gt=0.0, le=1.0, description="motion of the image that asks for a keyframe, by the sum of width and height"
    )
    keyframe_flow_translation: float = Field(
        default=0.025, gt=0.0, le=1.0, description="the same, for the part of the motion that translation makes"
    )
    keyframe_brightness: float = Field(
        default=0.5, gt=0.0, description="change of brightness that asks for a keyframe, logarithm of the gain"
    )
    keyframe_overlap: float = Field(
        default=0.7, gt=0.2, lt=1.0, description="share of a keyframe's pixels seen below which another is asked for"
    )
    keyframe_residual: float = Field(
        default=2.0, gt=1.0, description="residual that asks for a keyframe, by the least of the frames aligned to the one before"
    )
    depth_noise: tuple[float, float, float] = Field(
        default=(0.0012, 0.0019, 0.4),
        description="σ_z = a + b (z − c)² of measured depths [m], above c; by default that of structured light",
    )
    residual_ratio: float = Field(
        default=2.0, gt=1.0, description="a residual so many times that of the frames before makes a pose weak"
    )
    weak_rotation_deg: float = Field(
        default=0.3, gt=0.0, description="a larger standard deviation of the rotation makes a pose weak [deg]"
    )
    weak_translation: float = Field(
        default=0.005, gt=0.0, description="so does a larger one of the translation, by the median depth of the keyframe"
    )
    lost_s: float = Field(default=1.0, gt=0.0, description="after this much without a pose, begin anew at a guess [s]")
