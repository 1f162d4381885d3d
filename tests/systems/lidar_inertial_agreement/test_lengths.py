"""Lengths by what the accelerations say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.systems.lidar_inertial_agreement.lengths import feet_finding, lengths_known, lengths_of_many, slope_finding
from boxplus.systems.lidar_inertial_agreement.translation import SLOPE, TranslationFit


def test_stretches_that_differ_among_themselves_show_no_lengths() -> None:
    assert lengths_of_many([(0.85, 0.05)]) is None
    assert lengths_of_many([(0.85, 0.05), (0.86, 0.05), (0.84, 0.05)]) is not None
    assert lengths_of_many([(0.60, 0.05), (1.10, 0.05), (0.85, 0.05)]) is None


def test_lengths_are_known_by_many_stretches_that_agree() -> None:
    assert not lengths_known([(1.0, 0.02)])
    assert lengths_known([(1.0, 0.02)] * 4)
    assert not lengths_known([(0.7, 0.02), (1.3, 0.02)])


@pytest.mark.parametrize(("slope", "std", "wrong"), [
    (1.05, 0.01, False), (1.1, 0.02, True), (0.9, 0.02, True), (1.3, 0.15, False), (3.2, 0.2, True), (-1.0, 0.05, False),
    (2.5, 0.4, False),
])  # fmt: skip
def test_a_slope_is_wrong_beyond_its_deviations(slope: float, std: float, wrong: bool) -> None:
    found = slope_finding(slope, std)
    assert (found is not None) == wrong
    assert found is None or ("feet" in found.text) == (slope > 3.0)


@pytest.mark.parametrize(("slope", "std", "explained", "sigma", "feet"), [
    (0.95, 0.05, 0.9, 0.002, True),
    (0.31, 0.01, 0.99, 0.002, False),  # of points in metres
    (1.0, 0.3, 0.9, 0.002, False),
    (1.0, 0.05, 0.5, 0.002, False),
    (1.0, 0.05, 0.9, 0.1, False),
])  # fmt: skip
def test_points_are_in_feet_where_only_feet_agree(slope: float, std: float, explained: float, sigma: float, feet: bool) -> None:
    covariance = np.zeros((13, 13))
    covariance[SLOPE, SLOPE] = std**2
    nothing = np.zeros(3)
    fit = TranslationFit(nothing, nothing, nothing, slope, nothing, covariance, [], sigma, 1.0, explained, 40, 1.0)
    found = feet_finding(fit)
    assert (found is not None) == feet
    assert found is None or (found.cause == "length_scale" and "in feet" in found.text)
    assert feet_finding(replace(fit, slope=-slope)) is None


@pytest.mark.parametrize(("excursion_m", "held_back"), [(0.007, 0.67), (0.014, 0.34), (0.028, 0.113), (0.3, 0.0011)])
def test_of_an_excursion_that_is_no_larger_than_the_error_of_a_pose_no_slope_is_known(
    excursion_m: float, held_back: float
) -> None:
    covariance = np.zeros((13, 13))
    covariance[SLOPE, SLOPE] = 0.02**2
    nothing = np.zeros(3)
    fit = TranslationFit(nothing, nothing, nothing, 0.6, nothing, covariance, [], 1e-3, 1.0, 0.95, 40, excursion_m, 0.03**2)
    assert fit.slope_std == pytest.approx(np.hypot(0.02, held_back), rel=0.02)
    assert fit.slope_std_alone == pytest.approx(np.sqrt(0.02**2 + 0.03**2 + held_back**2), rel=0.02)
