"""What a user gives as numbers and is none: the same error at every door of the public interface."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from decimal import Decimal

import numpy as np
import pytest

import boxplus as bp
from boxplus._numbers import as_floats, as_numbers

RAGGED = [[1.0, 2.0, 3.0], [1.0, 2.0]]
BAD = {
    "ragged": RAGGED,
    "complex": np.ones((2, 3)) * 1j,
    "text": [["a", "b", "c"]] * 2,
    "objects": np.array([[object(), 1.0, 2.0]] * 2, dtype=object),
    "dates": np.array([["2020-01-01"] * 3] * 2, dtype="M8[s]"),
}
TIME, ROWS = np.arange(2), np.ones((2, 3))
CAMERA = bp.Pinhole(500.0, 500.0, 320.0, 240.0)
DOORS: dict[str, Callable[[object], object]] = {
    "Scan, points": lambda bad: bp.Scan.from_arrays(bad, TIME),
    "Scan, times": lambda bad: bp.Scan.from_arrays(ROWS, bad),
    "Scan, intensities": lambda bad: bp.Scan.from_arrays(ROWS, TIME, bad),
    "ImuSamples, times": lambda bad: bp.ImuSamples.from_arrays(bad, ROWS, ROWS),
    "ImuSamples, gyro": lambda bad: bp.ImuSamples.from_arrays(TIME, bad, ROWS),
    "ImuSamples, accel": lambda bad: bp.ImuSamples.from_arrays(TIME, ROWS, bad),
    "IkdTree, build": lambda bad: bp.IkdTree(bad),
    "IkdTree, insert": lambda bad: bp.IkdTree(ROWS).insert(bad),
    "IkdTree, delete": lambda bad: bp.IkdTree(ROWS).delete_points(bad),
    "IkdTree, nearest": lambda bad: bp.IkdTree(ROWS).nearest(bad, 1),
    "IkdTree, radius": lambda bad: bp.IkdTree(ROWS).radius_search(bad, 1.0),
    "IkdTree, box": lambda bad: bp.IkdTree(ROWS).box_search(bad, bad),
    "variables": lambda bad: bp.Problem().add_variables(bp.Euclidean(3), bad),
    "variables SE3": lambda bad: bp.Problem().add_variables(bp.SE3, bad),
    "⊞": lambda bad: bp.SE3.boxplus(np.eye(1, 7), bad),
    "Prior": lambda bad: bp.residuals.Prior(bp.Euclidean(3), bad, sigma=1.0),
    "sigma": lambda bad: bp.residuals.Prior(bp.Euclidean(3), ROWS, sigma=bad),
    "covariance": lambda bad: bp.residuals.Prior(bp.Euclidean(3), ROWS, covariance=bad),
    "Reprojection": lambda bad: bp.residuals.Reprojection(CAMERA, bad, sigma=1.0),
    "BalReprojection": lambda bad: bp.residuals.BalReprojection(bad, sigma=1.0),
    "PointToPoint": lambda bad: bp.residuals.PointToPoint(bad, ROWS, sigma=1.0),
    "PointToPlane": lambda bad: bp.residuals.PointToPlane(bad, ROWS, ROWS, sigma=1.0),
    "Gicp": lambda bad: bp.residuals.Gicp(bad, ROWS, np.eye(3), np.eye(3)),
    "RelativePose": lambda bad: bp.residuals.RelativePose(bad, sigma=1.0),
    "RelativePose2D": lambda bad: bp.residuals.RelativePose2D(bad, sigma=1.0),
    "LineReprojection": lambda bad: bp.residuals.LineReprojection(np.eye(3), bad, sigma=1.0),
}


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("kind", BAD)
def test_what_is_no_array_of_real_numbers_is_refused(door: str, kind: str) -> None:
    """Complex numbers lost their imaginary part with a warning of NumPy, dates became seconds, the rest was its ValueError."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(bp.InputError, match=r"expected .*(numbers|array|integer)"):
            DOORS[door](BAD[kind])


def test_numbers_of_every_kind_are_taken() -> None:
    for values in ([1, 2], [True, False], np.array([1.5, 2.5], np.float32), (3.0,), 4):
        assert as_floats(values, "x").dtype == np.float64
        assert np.array_equal(as_numbers(values, "x"), as_floats(values, "x"))
    assert np.array_equal(as_floats([Decimal("0.5"), 2**70], "x"), [0.5, 2.0**70])
    with pytest.raises(bp.InputError, match=r"expected x as real numbers – got Python objects \(object\) – convert"):
        as_numbers([Decimal("0.5")], "x")
