"""A platform that sways by a centimetre contradicts neither lengths nor gyroscope; one that walks shows both as before."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.agreement import Agreement, compare_sensors
from boxplus.systems.lidar_inertial_agreement.held_back import shifts_held_back, turns_held_back
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld, swaying

RINGS = SpinningLidar(channels=32, azimuth_steps=450, vertical_fov_deg=(-30.0, 30.0))
ROSETTE = RosetteLidar(points_per_scan=3000)


def _swaying(shift_m: float, turn_rad: float, lidar: RosetteLidar | SpinningLidar, seed: int) -> Agreement:
    """Once a second, in a room of 5 by 4 m."""
    motion = swaying(seed, (-1.0, 0.5, 1.2), shift_m, turn_rad)
    room = worlds.room((5.0, 4.0, 3.0), seed=seed)
    scans, imu = data(Simulation(Scenario("sways", room, motion, lidar, ImuModel(), T_imu_lidar=np.eye(4)), seed, 4.0))
    return compare_sensors(scans, imu, CONFIG, T_declared=np.eye(4))


@pytest.mark.parametrize(("shift_m", "turn_rad"), [(0.01, 0.01), (0.02, 0.03)])
@pytest.mark.parametrize("lidar", [RINGS, ROSETTE], ids=["rings", "rosette"])
@pytest.mark.parametrize("seed", [1, 3])
def test_a_platform_that_sways_contradicts_nothing(
    shift_m: float, turn_rad: float, lidar: RosetteLidar | SpinningLidar, seed: int
) -> None:
    agreement = _swaying(shift_m, turn_rad, lidar, seed)
    assert contradictions(agreement, np.eye(4)) == []
    translation, rotation = agreement.translation, agreement.rotation
    assert translation is not None and rotation is not None
    assert translation.excursion_m < 0.03
    assert abs(translation.slope - 1.0) < 2.0 * translation.slope_std
    assert abs(rotation.scale - 1.0) < 3.0 * rotation.scale_std


def test_a_walk_holds_hardly_anything_back() -> None:
    simulation = handheld(2, seconds=4.0)
    scans, imu = data(simulation)
    agreement = compare_sensors(scans, imu, CONFIG, T_declared=simulation.T_imu_lidar)
    assert agreement.translation is not None
    assert shifts_held_back(agreement.translation.excursion_m) < 0.005
    assert turns_held_back(agreement.path) < 0.002
