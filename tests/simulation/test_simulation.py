"""Whole simulations: exact surfaces, honest noise, order of events, determinism."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import (
    SCENARIOS,
    OmniLidar,
    RosetteLidar,
    Simulation,
    SpinningLidar,
    make_scenario,
    mounting,
    simulate,
)
from tests.simulation.small_simulations import small

QUICK = [name for name in SCENARIOS if name != "drive30"]


def world_points(simulation: Simulation, p_lidar: np.ndarray, time_ns: np.ndarray) -> np.ndarray:
    """Points in the world, each by the true pose at its own time."""
    truth = simulation.ground_truth(time_ns)
    p_imu = p_lidar @ simulation.T_imu_lidar[:3, :3].T + simulation.T_imu_lidar[:3, 3]
    return np.einsum("nij,nj->ni", truth.R_world_imu, p_imu) + truth.p_world_imu


@pytest.mark.parametrize("name", QUICK)
def test_points_lie_on_the_surfaces_of_the_world(name: str) -> None:
    simulation = small(name, duration_s=None)
    for index in (0, simulation.scan_count // 2):
        points, time_ns = simulation.exact_points(index)
        assert len(points) > 20
        assert simulation.world.distance(world_points(simulation, points, time_ns)).max() < 1e-8


@pytest.mark.parametrize("name", QUICK)
def test_scenarios_begin_at_rest_and_keep_clear_of_obstacles(name: str) -> None:
    simulation = small(name, duration_s=None)
    first = simulation.ground_truth(simulation.start_ns + np.arange(0, 1_000_000_001, 50_000_000))
    speed = np.linalg.norm(first.v_world_imu, axis=1).max() + np.linalg.norm(first.omega_imu, axis=1).max()
    assert speed > 5.0 if name == "moving_start" else speed < 1e-9
    path = simulation.ground_truth(np.arange(simulation.start_ns, simulation.end_ns, 500_000_000)).p_world_imu
    assert simulation.world.distance(path).min() > 0.5


def test_the_walk_and_the_drive_have_their_lengths() -> None:
    for name, length in (("walk", 93.0), ("drive", 450.0)):
        simulation = small(name, duration_s=None)
        path = simulation.ground_truth(np.arange(simulation.start_ns, simulation.end_ns, 20_000_000)).p_world_imu
        assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(length, rel=0.02)


def test_range_noise_lies_along_the_rays() -> None:
    lidar = SpinningLidar(channels=4, azimuth_steps=500, range_sigma_m=0.05, min_range=0.0)
    simulation = Simulation(replace(make_scenario("at_rest"), lidar=lidar))
    exact, _ = simulation.exact_points(0)
    noisy = simulation.scan(0).p_lidar.astype(np.float64)
    ranges = np.linalg.norm(exact, axis=1)
    along = np.einsum("ij,ij->i", noisy - exact, exact) / ranges
    assert np.abs(noisy - exact - along[:, None] * exact / ranges[:, None]).max() < 1e-5
    assert along.std() == pytest.approx(0.05, rel=0.05)
    assert abs(along.mean()) < 4 * 0.05 / np.sqrt(len(along))


def test_events_come_in_order_and_cover_the_scans() -> None:
    simulation = small("walk", duration_s=1.0)
    events = list(simulation.events())
    scans = [event for event in events if isinstance(event, Scan)]
    imu_ns = np.concatenate([event.time_ns for event in events if isinstance(event, ImuSamples)])
    assert len(scans) == simulation.scan_count == 9
    np.testing.assert_array_equal(imu_ns, simulation.start_ns + 5_000_000 * np.arange(201))
    for index, scan in enumerate(scans):
        begin, end = simulation.scan_start_ns(index), simulation.scan_start_ns(index + 1)
        assert end - begin == 100_000_000
        assert begin < scan.time_ns.min() <= scan.time_ns.max() <= end
        assert imu_ns[0] <= begin
        assert end <= imu_ns[-1]
    reached, complete_ns = 0, simulation.scan_start_ns(0)
    for event in events:
        if isinstance(event, ImuSamples):
            reached = int(event.time_ns[-1])
        else:
            complete_ns += 100_000_000
            assert reached <= complete_ns < reached + 5_000_000


def test_the_same_seed_gives_the_same_bits_in_any_order() -> None:
    first, second, other = small("walk", seed=1), small("walk", seed=1), small("walk", seed=2)
    last = second.scan_count - 1
    np.testing.assert_array_equal(second.scan(last).p_lidar, [e for e in first if isinstance(e, Scan)][last].p_lidar)
    blocks = [[event.gyro for event in run if isinstance(event, ImuSamples)] for run in (first, second, other)]
    np.testing.assert_array_equal(np.concatenate(blocks[0]), np.concatenate(blocks[1]))
    assert not np.array_equal(np.concatenate(blocks[0]), np.concatenate(blocks[2]))


def test_a_rosette_stays_in_its_field_and_never_repeats() -> None:
    lidar = RosetteLidar(fov_deg=40.0, points_per_scan=500)
    first, second = lidar.rays(0), lidar.rays(1)
    for rays in (first, second):
        np.testing.assert_allclose(np.linalg.norm(rays.directions_lidar, axis=1), 1.0, atol=1e-12)
        assert rays.directions_lidar[:, 0].min() >= np.cos(np.deg2rad(20.0)) - 1e-12
    assert np.abs(first.directions_lidar - second.directions_lidar).max() > 0.1
    assert 0.0 < first.offset_s[0] < first.offset_s[-1] <= 0.1


def test_an_omni_lidar_looks_all_around_between_its_elevations_and_never_repeats() -> None:
    lidar = OmniLidar(points_per_scan=4000, vertical_fov_deg=(-7.0, 52.0))
    first, second = lidar.rays(0), lidar.rays(1)
    for rays in (first, second):
        x, y, z = rays.directions_lidar.T
        np.testing.assert_allclose(np.linalg.norm(rays.directions_lidar, axis=1), 1.0, atol=1e-12)
        elevation, azimuth = np.degrees(np.arcsin(z)), np.degrees(np.arctan2(y, x))
        assert -7.0 - 1e-9 <= elevation.min() < -6.0 and 51.0 < elevation.max() <= 52.0 + 1e-9
        assert np.histogram(azimuth, 12, (-180.0, 180.0))[0].min() > 150  # once or twice around: 172 or 344 of them
        np.testing.assert_allclose(np.histogram(elevation, 8, (-7.0, 52.0))[0], 4000 / 8, rtol=0.1)  # swings evenly
    assert np.abs(first.directions_lidar - second.directions_lidar).max() > 0.1
    assert 0.0 < first.offset_s[0] < first.offset_s[-1] <= 0.1
    assert not lidar.ring(np.zeros((3, 3), np.float32)).any()


def test_rings_are_found_from_the_points() -> None:
    lidar = SpinningLidar(channels=16, azimuth_steps=10)
    rays = lidar.rays(0)
    np.testing.assert_array_equal(lidar.ring((7.3 * rays.directions_lidar).astype(np.float32)), np.tile(np.arange(16), 10))


def test_other_sensors_and_mountings() -> None:
    T_imu_lidar = mounting(0.0, 0.0, 90.0, (0.0, 0.0, 0.2))
    lidar = SpinningLidar(channels=2, azimuth_steps=8, rate_hz=20.0)
    simulation = simulate("at_rest", lidar=lidar, T_imu_lidar=T_imu_lidar, duration_s=0.5)
    assert simulation.scan_count == 9
    np.testing.assert_allclose(T_imu_lidar[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    points, time_ns = simulation.exact_points(0)
    assert simulation.world.distance(world_points(simulation, points, time_ns)).max() < 1e-9
    assert simulation.config.lidar == lidar
    assert np.array_equal(simulation.config.T_imu_lidar, T_imu_lidar)


def test_refused() -> None:
    with pytest.raises(InputError, match=r"expected the name of a scenario – got .* – .*the scenarios are: walk, walk_livox"):
        simulate("stroll")
    with pytest.raises(InputError, match=r"a duration of at most 10\.0 s, the length of the motion of 'at_rest' – got 11 s"):
        simulate("at_rest", duration_s=11.0)
    with pytest.raises(InputError, match="with a rotation"):
        simulate("at_rest", T_imu_lidar=2.0 * np.eye(4))
    with pytest.raises(InputError, match="a scan from 0 to 98 – got 99"):
        simulate("at_rest").scan(99)


def test_a_scan_that_meets_nothing_has_its_times() -> None:
    up = RosetteLidar(fov_deg=20.0, points_per_scan=50)
    simulation = small("walk", lidar=up, T_imu_lidar=mounting(0.0, -90.0, 0.0, (0.0, 0.0, 0.0)))
    for index in (0, 3):
        scan = simulation.scan(index)
        assert len(scan) == 0
        assert simulation.scan_start_ns(index) < scan.start_ns < scan.end_ns == simulation.scan_start_ns(index + 1)
