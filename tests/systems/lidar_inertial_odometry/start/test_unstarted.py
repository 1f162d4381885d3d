"""What is said of a recording in which no start was found."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.simulation.faults import wrong_time_unit
from boxplus.systems.lidar_inertial_odometry.start.unstarted import UnstartedScans
from tests.systems.lidar_inertial_odometry.small_drives import before_a_wall, config, frames, room_walk, turning_by


@pytest.mark.parametrize("leaning_deg", [0.0, 20.0])
def test_the_wall_says_whether_the_mounting_leans(leaning_deg: float) -> None:
    first, settings = before_a_wall(0.6)
    T = np.eye(4)
    T[:3, :3] = so3.exp(np.array([0.0, np.deg2rad(leaning_deg), 0.0]))
    unstarted = UnstartedScans(settings.model_copy(update={"T_imu_lidar": tuple(map(tuple, T.tolist()))}))
    unstarted.add(turning_by(first, T[:3, :3] @ np.array([0.07, 0.0, 0.0])))
    found = unstarted.contradictions()
    assert ["deg from level and from upright" in text for text in found] == [True] * (leaning_deg > 0.0)
    named = unstarted.named("no start yet")
    assert named is not None and named.startswith("no start yet") and (len(named) > 12) == (leaning_deg > 0.0)
    assert unstarted.named(None) is None


@pytest.mark.parametrize("seconds", [1.0, 6.0])
def test_a_wrong_unit_of_the_point_times_is_named(seconds: float) -> None:
    simulation = room_walk(seconds)
    unstarted, sound = UnstartedScans(config(simulation)), UnstartedScans(config(simulation))
    seen = frames(wrong_time_unit(0.001).events(simulation.events()))
    assert unstarted.add(seen[:5]) == 5
    unstarted.add(seen[5:])
    (found,) = unstarted.contradictions()
    assert "scans come every 100 ms: check the unit of the point times" in found
    sound.add(frames(simulation.events())[-4:])
    assert sound.contradictions() == []


def test_without_scans_nothing_is_said() -> None:
    unstarted = UnstartedScans(config(room_walk(1.0)))
    unstarted.add([])
    assert unstarted.contradictions() == []
