"""What is said of a recording in which no start was found."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation.faults import wrong_time_unit
from boxplus.systems.lidar_inertial_agreement.finding import Finding
from boxplus.systems.lidar_inertial_odometry.start import unstarted as unstarted_module
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


def test_a_stretch_that_shows_what_its_neighbours_do_not_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths break, and know too little: what only shows from six to three seconds before the end is named."""
    simulation = room_walk(8.5)
    unstarted = UnstartedScans(config(simulation))
    seen = frames(simulation.events())
    unstarted.add(seen)
    last_ns = seen[-1].scan.end_ns

    def compared(scans: Sequence[Scan], *_: object, **__: object) -> tuple[float, float]:
        return (last_ns - scans[0].start_ns) * 1e-9, (last_ns - scans[-1].end_ns) * 1e-9

    def contradicted(stretch: tuple[float, float], _: object) -> list[Finding]:
        begun_s, ended_s = stretch
        assert begun_s - ended_s < 4.11
        return [Finding("gyro_sign", "the sign is wrong")] if begun_s > 5.5 and ended_s < 2.5 else []

    monkeypatch.setattr(unstarted_module, "compare_sensors", compared)
    monkeypatch.setattr(unstarted_module, "contradictions", contradicted)
    monkeypatch.setattr(unstarted_module, "untilted_plane", lambda *_: None)
    monkeypatch.setattr(unstarted_module, "tilted_plane", lambda *_: None)
    assert unstarted.contradictions() == ["the sign is wrong"]


def test_without_scans_nothing_is_said() -> None:
    unstarted = UnstartedScans(config(room_walk(1.0)))
    unstarted.add([])
    assert unstarted.contradictions() == []
