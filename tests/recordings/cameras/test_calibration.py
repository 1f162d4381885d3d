"""Camera models from the names and numbers of files and messages."""

from __future__ import annotations

import pytest

from boxplus.cameras import Pinhole, RadialTangential
from boxplus.recordings.cameras.calibration import camera_model

INTRINSICS = (400.0, 410.0, 320.0, 240.0)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12])
@pytest.mark.parametrize("name", ["plumb_bob", "rational_polynomial"])
def test_a_distortion_of_zeros_is_none(name: str, count: int) -> None:
    model, why = camera_model("pinhole", INTRINSICS, name, (0.0,) * count)
    assert isinstance(model, Pinhole) and model.distortion is None and why == ""


def test_a_rational_polynomial_without_its_denominator_is_radial_tangential() -> None:
    numbers = (-0.28, 0.07, 1e-4, 2e-5, 0.01)
    model, _ = camera_model("pinhole", INTRINSICS, "rational_polynomial", (*numbers, 0.0, 0.0, 0.0))
    assert isinstance(model, Pinhole) and model.distortion == RadialTangential(*numbers)


def test_a_rational_polynomial_with_its_denominator_is_not_taken_for_another_model() -> None:
    model, why = camera_model("pinhole", INTRINSICS, "rational_polynomial", (0.1, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0, 0.0))
    assert model is None and "8 coefficients of 'rational_polynomial'" in why
