"""From which lean on a mounting is doubted."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.systems.lidar_inertial_agreement.planes.ground_lean import GroundLean
from boxplus.systems.lidar_inertial_agreement.planes.leaning import leaning
from boxplus.systems.lidar_inertial_agreement.planes.plane_tilt import PlaneTilt


@pytest.mark.parametrize(
    ("lean_deg", "std_deg", "named"),
    [(19.0, 0.1, False), (20.9, 0.0, False), (22.0, 0.1, True), (22.0, 1.0, False), (59.0, 1.0, True), (61.0, 0.1, False)],
)
def test_ground_is_doubted_that_is_steeper_than_a_road_and_not_as_steep_as_a_wall(
    lean_deg: float, std_deg: float, named: bool
) -> None:
    found = leaning(None, GroundLean(np.deg2rad(lean_deg), np.deg2rad(std_deg), 1.8, 12.0))
    assert (found is not None) == named
    assert found is None or (found.cause == "extrinsic" and f"leans by {lean_deg:.0f} deg" in found.text)


def test_planes_that_stand_around_speak_first() -> None:
    ground = GroundLean(np.deg2rad(30.0), 0.0, 1.8, 12.0)
    planes = PlaneTilt(np.deg2rad(9.0), 0.0, 2, np.full(3, np.pi))
    found = leaning(planes, ground)
    assert found is not None and "two directions of planes" in found.text
    assert leaning(None, None) is None
    upright = leaning(PlaneTilt(0.0, 0.0, 2, np.full(3, np.pi)), ground)
    assert upright is not None and "the ground" in upright.text
