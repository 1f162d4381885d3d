"""A start at rest says where the accelerometer's scale or bias cannot be in order."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.runs.visual_inertial.visual_run import gravity_doubts
from boxplus.systems.visual_inertial_odometry.start.start import Start


def start(kind: str, norm: float) -> Start:
    zero, one = np.zeros(3), np.zeros(1, np.int64)
    return Start(
        kind, one, one, np.zeros((1, 7)), np.zeros((1, 3)), zero, zero, np.eye(15), np.zeros(6), np.eye(15),
         {"mean specific force [m/s²]": norm} if kind == "at rest" else {},
    )  # fmt: skip


@pytest.mark.parametrize("norm", [9.3, 10.3])
@pytest.mark.parametrize("cameras", [1, 2])
def test_gravity_that_is_more_than_three_per_cent_off_is_told(norm: float, cameras: int) -> None:
    (said,) = gravity_doubts(start("at rest", norm), cameras)
    assert f"{norm:.2f} m/s² of 9.81" in said and ("lengths of one camera" in said) == (cameras == 1)


def test_an_ordinary_bias_is_not_and_a_start_in_motion_says_nothing() -> None:
    assert gravity_doubts(start("at rest", 9.6), 1) == [] == gravity_doubts(start("moving mono", 10.3), 1)
