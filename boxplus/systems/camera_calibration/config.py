"""Settings of a camera calibration."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from boxplus._settings import Settings
from boxplus.systems.camera_calibration.lens import LensKind


class CameraCalibrationConfig(Settings):
    """Settings of `calibrate_cameras`.

    Example:
        >>> bp.CameraCalibrationConfig(lens="pinhole-equi").max_views
        80
    """

    lens: Literal["auto"] | LensKind = Field(
        "auto", description="Kalibr's name of the lens; auto takes the simplest of those that leave the smallest residuals"
    )
    max_views: int = Field(
        80, ge=8, description="frames used for lenses and mountings, evenly chosen; the IMU's part takes up to 400"
    )
