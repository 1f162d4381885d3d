"""A pattern that lies where it lay before is told from one that wanders."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, RosetteLidar, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.lidar_path.scan_pattern import recurs

ROOM = worlds.room((30.0, 18.0, 6.0), seed=4)


def scans_of(lidar: SpinningLidar | RosetteLidar, speed: float) -> list[Scan]:
    motion = manoeuvres.constant_velocity(2.0, (-5.0, 0.4, 1.5), (speed, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("pattern", ROOM, motion, lidar, ImuModel(), np.eye(4)), 5, 1.0)
    return [simulation.scan(k) for k in range(6)]


def frames(lines: int, jitter: float, seed: int, count: int = 5) -> list[Scan]:
    """A view of 70 by 25 degrees that is drawn line by line, each point anywhere on its line."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        azimuth = random.uniform(-0.6, 0.6, (lines, 12_000 // lines))
        elevation = np.linspace(-0.22, 0.22, lines)[:, None] + jitter * random.normal(size=azimuth.shape)
        towards = np.stack([np.cos(azimuth), np.sin(azimuth), np.tan(elevation)], axis=-1).reshape(-1, 3)
        p_lidar = (random.uniform(2.0, 30.0, (len(towards), 1)) * towards).astype(np.float32)
        found.append(Scan.from_arrays(p_lidar, np.linspace(0, 1e8, len(towards)).astype(np.int64)))
    return found


@pytest.mark.parametrize("speed", [0.0, 3.0])
@pytest.mark.parametrize("fov_deg", [38.0, 70.0])
def test_curves_that_fill_a_narrow_view_do_not_recur(fov_deg: float, speed: float) -> None:
    scans = scans_of(RosetteLidar(points_per_scan=10_000, fov_deg=fov_deg), speed)
    assert not recurs(scans) and not recurs(scans[:2])
    assert recurs([scans[0], scans[1], scans[0]])


@pytest.mark.parametrize("channels", [16, 128])
def test_rings_recur(channels: int) -> None:
    assert recurs(scans_of(SpinningLidar(channels=channels, azimuth_steps=360), 2.0))


@pytest.mark.parametrize("lines", [16, 32, 64])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_narrow_view_that_is_drawn_line_by_line_recurs(lines: int, seed: int) -> None:
    assert recurs(frames(lines, 0.0002, seed))


@pytest.mark.parametrize("seed", range(4))
def test_points_anywhere_do_not_recur(seed: int) -> None:
    assert not recurs(frames(120, 0.05, seed))


def test_where_little_is_known_it_is_taken_to_recur() -> None:
    scans = scans_of(RosetteLidar(points_per_scan=10_000), 0.0)
    assert recurs(scans[:1]) and recurs([])
    few = Scan.from_arrays(scans[0].p_lidar[:150], scans[0].time_ns[:150])
    assert recurs([few, *scans[1:3]]) and recurs([*scans[:3], few])
    here = Scan.from_arrays(0.001 * scans[0].p_lidar, scans[0].time_ns)  # all at the sensor itself
    assert recurs([here, *scans[1:3]]) and recurs([*scans[:3], here])
