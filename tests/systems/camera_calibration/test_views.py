"""Views that would have different lenses, and images that are smaller than stated, are said; sound sessions are not doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.systems.camera_calibration.calibration import CameraCalibration, calibrate_cameras
from boxplus.systems.camera_calibration.config import CameraCalibrationConfig
from boxplus.systems.camera_calibration.corners import TargetCorners
from boxplus.systems.camera_calibration.findings import judge
from boxplus.systems.camera_calibration.lens import lens
from tests.systems.camera_calibration.sessions import GRID, RADTAN, session

OTHER = lens("pinhole-radtan", RADTAN.parameters + np.array([0.0, 0.0, 13.0, 6.0, 0.0, 0.0, 0.0, 0.0]))


def calibrated(corners: TargetCorners) -> CameraCalibration:
    return calibrate_cameras(corners, GRID, CameraCalibrationConfig(lens="pinhole-radtan"))  # type: ignore[call-arg]


def doubts(found: CameraCalibration) -> list[str]:
    return [finding.code for finding in judge(found) if finding.severity == "doubt"]


def one_of_two(corners: TargetCorners, second: np.ndarray) -> TargetCorners:
    """The images of camera 1 in these frames, those of camera 0 in the others, as those of one camera."""
    part = corners.rows(corners.camera_of == np.isin(corners.frame_of, second))
    return replace(part, camera_of=np.zeros_like(part.camera_of), sizes=corners.sizes[:1])


@pytest.mark.parametrize("second", [np.arange(0, 20, 2), np.arange(10, 20), np.array([1, 2, 5, 9, 11, 12, 16])])
def test_images_of_two_cameras_in_one_are_doubted(second: np.ndarray) -> None:
    corners = session(RADTAN, OTHER, frames=20, seed=3).corners
    found = calibrated(one_of_two(corners, second))
    scatter = found.views[0]
    assert scatter is not None
    assert scatter.ratio > 4.0
    assert scatter.centre_px > 5.0  # of two lenses 13 and 6 px apart: half of that, beyond noise
    assert "views_differ" in doubts(found)


@pytest.mark.parametrize("seed", range(3))
def test_one_lens_gives_scatter_by_noise_alone(seed: int) -> None:
    found = calibrated(session(RADTAN, frames=16, seed=seed).corners)
    scatter = found.views[0]
    assert scatter is not None
    assert 0.4 < scatter.ratio < 2.0
    assert doubts(found) == []


def test_few_views_have_no_scatter() -> None:
    assert calibrated(session(RADTAN, frames=5, seed=1).corners).views == (None,)


def test_corners_of_images_of_half_the_size_are_doubted() -> None:
    corners = session(RADTAN, seed=2).corners
    assert doubts(calibrated(replace(corners, pixels=corners.pixels / 2.0))) == ["resolution"]
