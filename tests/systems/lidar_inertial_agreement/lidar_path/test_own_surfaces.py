"""Where a scan shows hardly any surface, no scan can be laid upon another, and a start that is refused says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar, mounting
from boxplus.simulation.motions import trajectories
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World
from boxplus.systems.lidar_inertial_agreement.lidar_path.own_surfaces import share_on_own_surfaces, show_little
from boxplus.systems.lidar_inertial_agreement.lidar_path.registration import with_cells_for
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.start.start import find_start
from boxplus.systems.lidar_odometry.start import find_lidar_start
from tests.systems.lidar_inertial_odometry.small_drives import config, frames


def _at_rest(world: World, channels: int, range_sigma_m: float = 0.02) -> Simulation:
    lidar = SpinningLidar(channels=channels, azimuth_steps=900, vertical_fov_deg=(-15.0, 15.0), range_sigma_m=range_sigma_m)
    rest = trajectories.at_rest(2.5, (0.0, 0.0, 2.2))
    return Simulation(Scenario("rest", world, rest, lidar, ImuModel(), mounting(0.0, 0.0, 0.0, (0.0, 0.0, 0.1))), 1, 2.0)


@pytest.mark.parametrize("noise_m", [0.005, 0.02, 0.03])
@pytest.mark.parametrize("seed", range(3))
def test_sixteen_rings_in_a_field_show_little(seed: int, noise_m: float) -> None:
    scan = _at_rest(sites.open_field(2, seed=seed), 16, noise_m).scan(3)
    settings = with_cells_for(scan, LioConfig())
    assert 0.0 < share_on_own_surfaces(scan, settings) < 0.1
    assert show_little([scan], settings).startswith(f"only {100.0 * share_on_own_surfaces(scan, settings):.0f} % of ")


@pytest.mark.parametrize(
    ("world", "channels"),
    [(sites.open_field(6, seed=1), 64), (worlds.room(), 16), (sites.street(seed=2), 16), (sites.forest(seed=3), 16)],
    ids=["64 rings in a field", "room", "street", "forest"],
)
def test_elsewhere_and_with_more_of_them_they_show_enough(world: World, channels: int) -> None:
    scan = _at_rest(world, channels).scan(3)
    assert show_little([scan], with_cells_for(scan, LioConfig())) == ""


def test_an_empty_scan_shows_nothing() -> None:
    scan = Scan.from_arrays(np.zeros((0, 3), np.float32), np.zeros(0, np.int64))
    assert share_on_own_surfaces(scan, LioConfig()) == 0.0


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_nothing_is_said_of_points_that_are_not_in_metres(factor: float) -> None:
    scan = _at_rest(worlds.room(), 16).scan(3)
    other = Scan.from_arrays(scan.p_lidar * np.float32(factor), scan.time_ns)
    assert share_on_own_surfaces(other, LioConfig()) < 0.1
    assert show_little([other], LioConfig()) == ""


def test_a_scrap_is_no_scan_and_one_poor_scan_not_all() -> None:
    simulation = _at_rest(worlds.room(), 16)
    scan, field = simulation.scan(3), _at_rest(sites.open_field(2, seed=0), 16).scan(3)
    scrap = Scan.from_arrays(scan.p_lidar[:20], scan.time_ns[:20])
    assert share_on_own_surfaces(scrap, LioConfig()) < 0.1
    assert show_little([scrap, scrap], LioConfig()) == ""
    assert show_little([field, scan, field], LioConfig()) == ""
    assert show_little([field, field, field], LioConfig())


def test_a_start_that_is_refused_says_so() -> None:
    simulation = _at_rest(sites.open_field(2, seed=0), 16)
    waiting = frames(simulation.events())
    refusal = find_start(waiting, config(simulation))
    assert isinstance(refusal, str)
    assert refusal.startswith("the surroundings do not show whether the platform moves: ")
    assert "few rings on bare ground" in refusal
    precise = _at_rest(sites.open_field(2, seed=0), 16, 0.005)
    alone = find_lidar_start([precise.scan(k) for k in range(4)], LioConfig())
    assert isinstance(alone, str) and "few rings on bare ground" in alone
    elsewhere = _at_rest(worlds.room(), 16)
    apart = [
        replace(frame, scan=Scan.from_arrays(frame.scan.p_lidar + np.float32(100.0 * k), frame.scan.time_ns))
        for k, frame in enumerate(frames(elsewhere.events()))
    ]
    alone = find_lidar_start([frame.scan for frame in apart[:4]], LioConfig())
    assert isinstance(alone, str) and "few rings" not in alone
