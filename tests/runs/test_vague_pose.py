"""When a position is of little use, by its own covariance."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.runs.vague_pose import is_unknown, is_vague, largest_sigmas, length_text


def test_the_largest_deviations_are_those_of_the_worst_axes() -> None:
    R, S = so3.exp(np.array([0.3, -0.8, 0.5])), so3.exp(np.array([-1.2, 0.1, 0.4]))
    P = np.zeros((6, 6))
    P[:3, :3], P[3:, 3:] = R @ np.diag([1e-6, 4e-4, 1e-5]) @ R.T, S @ np.diag([0.25, 0.01, 1e-4]) @ S.T
    assert largest_sigmas(P) == pytest.approx((0.02, 0.5))
    assert largest_sigmas(np.zeros((6, 6))) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("sigma_m", "way_m", "vague"), [(0.04, 0.1, False), (0.06, 0.1, True), (0.06, 10.0, False), (0.3, 10.0, True)]
)
def test_a_position_is_vague_beyond_five_centimetres_and_two_hundredths_of_the_way(
    sigma_m: float, way_m: float, vague: bool
) -> None:
    assert is_vague(sigma_m, way_m) is vague


@pytest.mark.parametrize(
    ("sigma_m", "way_m", "unknown"), [(0.9, 0.1, False), (1.1, 0.1, True), (1.1, 10.0, False), (2.1, 10.0, True)]
)
def test_a_position_is_unknown_beyond_a_metre_and_a_fifth_of_the_way(sigma_m: float, way_m: float, unknown: bool) -> None:
    assert is_unknown(sigma_m, way_m) is unknown


def test_lengths_are_read_in_centimetres_below_a_metre() -> None:
    assert length_text(0.514) == "51 cm" and length_text(12.34) == "12.3 m"
