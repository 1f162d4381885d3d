"""A LiDAR alone where all but a few points look the same from every place: on a highway, from its first scan on at speed."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from boxplus.filtering.degeneracy import PoseDirections
from boxplus.manifolds import so3
from boxplus.maps.ikd_tree import IkdTree
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Simulation
from boxplus.simulation.lidar import SpinningLidar
from boxplus.simulation.motions.manoeuvres import constant_velocity, level
from boxplus.simulation.scenarios import Scenario, mounting
from boxplus.simulation.worlds.sites import highway, tunnel
from boxplus.simulation.worlds.world import World, box
from boxplus.systems.lidar_inertial_odometry.watches.weak_spell import WeakSpell
from boxplus.systems.lidar_odometry.motion import MotionState
from boxplus.systems.lidar_odometry.odometry import LidarOdometry
from boxplus.systems.lidar_odometry.passing import PassingWatch, turning_along

SPEED_M_S = 25.0
HARDLY, POOR, WELL = 2.0, 8.0, 30.0  # ratios of a direction that is measured


@cache
def drive(speed: float, count: int = 24, yaw_deg: float = 25.0) -> tuple[Simulation, list[Scan]]:
    motion = constant_velocity(6.0, (-60.0, 0.0, 1.6), (speed, 0.0, 0.0), level(0.0))
    lidar = SpinningLidar(channels=32, azimuth_steps=900)
    scenario = Scenario("highway", highway(seed=5), motion, lidar, T_imu_lidar=mounting(2.0, -3.0, yaw_deg, (0.1, 0.0, 0.2)))
    simulation = Simulation(scenario, seed=5, duration_s=0.1 * count + 0.2)
    return simulation, [simulation.scan(k) for k in range(count)]


def true_states(simulation: Simulation, scans: Sequence[Scan]) -> list[MotionState]:
    times = np.array([scan.end_ns for scan in scans])
    motion, T = simulation.scenario.trajectory.evaluate(times), simulation.T_imu_lidar
    R = motion.R_world_imu @ T[:3, :3]
    p = motion.p_world_imu + motion.R_world_imu @ T[:3, 3]
    still = np.zeros(3)
    return [MotionState(t, R[k], p[k], still, motion.v_world_imu[k]) for k, t in enumerate(times.tolist())]


def directions(ratio: float, axis: Sequence[float] = (1.0, 0.0, 0.0)) -> PoseDirections:
    """Of which the least known one is a shift along an axis of the world."""
    vectors, ratios = np.eye(6)[:, [3, 4, 5, 0, 1, 2]], np.full(6, 100.0)
    vectors[3:, 0], ratios[0] = axis, ratio
    return PoseDirections(ratios, vectors, 10.0, np.zeros(6, bool), np.eye(6))


def told(
    scans: Sequence[Scan], states: Sequence[MotionState], ratio: float, axis: Sequence[float] = (1.0, 0.0, 0.0)
) -> list[str]:
    watch, tree = PassingWatch(), IkdTree(cell_size=0.25)
    found = []
    for scan, state in zip(scans, states, strict=True):
        tree.insert(scan.p_lidar[::5] @ state.R_world_lidar.T + state.p_world_lidar, downsample=True)
        found.append(watch.add(scan, state, directions(ratio, axis), tree))
    assert watch.contradiction == next((text for text in found if text), None)
    return [text for text in found if text]


@pytest.mark.slow
@pytest.mark.parametrize("yaw_deg", [25.0, -140.0])
def test_a_start_at_speed_follows_what_passes(yaw_deg: float) -> None:
    """By its registrations it stood still: all scans were ok, and 57 m away the covariance said three centimetres."""
    simulation, scans = drive(SPEED_M_S, yaw_deg=yaw_deg)
    odometry = LidarOdometry()
    estimates = [e for scan in scans for e in odometry.push_scan(scan)]
    assert odometry.start is not None and odometry.start.text.endswith("which what changes from scan to scan shows")
    truth = true_states(simulation, scans[len(scans) - len(estimates) :])
    first, last = truth[0], truth[-1]
    way = first.R_world_lidar.T @ (last.p_world_lidar - first.p_world_lidar)
    assert np.linalg.norm(estimates[-1].state.p_world_imu - estimates[0].state.p_world_imu - way) < 0.02 * np.linalg.norm(way)
    assert odometry.contradiction is None


def test_an_estimate_that_stays_behind_is_contradicted() -> None:
    simulation, scans = drive(SPEED_M_S)
    truth = true_states(simulation, scans)
    at_rest = [MotionState(s.time_ns, s.R_world_lidar, truth[0].p_world_lidar, s.rate, np.zeros(3)) for s in truth]
    (text,) = told(scans, at_rest, POOR)
    assert (
        text.startswith("what changes from scan to scan goes by as at (")
        and "m/s (LiDAR axes), and the estimate moves at (" in text
    )
    along = simulation.T_imu_lidar[:3, :3].T @ [SPEED_M_S, 0.0, 0.0]
    found = [float(value) for value in text.split("(")[1].split(")")[0].split(",")]
    np.testing.assert_allclose(found, along, atol=1.0)
    assert told(scans, truth, POOR) == []
    assert told(scans, at_rest, WELL) == []  # where the scans show every direction, nobody asks


def test_a_difference_of_one_window_contradicts_nothing() -> None:
    simulation, scans = drive(SPEED_M_S)
    truth = true_states(simulation, scans)
    at_rest = [MotionState(s.time_ns, s.R_world_lidar, truth[0].p_world_lidar, s.rate, np.zeros(3)) for s in truth]
    assert told(scans, [*at_rest[:6], *truth[6:]], POOR) == []


def test_at_rest_nothing_passes() -> None:
    simulation, scans = drive(0.0, count=14)
    assert told(scans, true_states(simulation, scans), POOR) == []


@pytest.mark.parametrize("is_closed", [False, True])
def test_a_way_that_nothing_faces_is_open(is_closed: bool) -> None:
    """Rings at the corners of a bare tunnel seem to face the way: by their ratio it was measured, and it was not."""
    motion = constant_velocity(6.0, (-60.0, 0.0, 1.6), (2.0, 0.0, 0.0), level(0.0))
    world = World([*tunnel().solids, box((-51.0, 0.0, 3.0), (0.3, 9.0, 6.0))]) if is_closed else tunnel()
    lidar = SpinningLidar(channels=32, azimuth_steps=900)
    simulation = Simulation(Scenario("tunnel", world, motion, lidar, T_imu_lidar=np.eye(4)), seed=5, duration_s=1.5)
    scans = [simulation.scan(k) for k in range(13)]
    found = told(scans, true_states(simulation, scans), HARDLY)
    said = [text.startswith("nothing that the LiDAR sees faces the way along (+1.00, +0.00, +0.00)") for text in found]
    assert said == ([] if is_closed else [True])
    assert told(scans, true_states(simulation, scans), HARDLY, (0.0, 0.0, 1.0)) == []  # nothing drives upwards


def test_attitudes_in_between_turn_as_those_beside_them() -> None:
    rate, time_ns = np.array([0.3, -0.2, 0.9]), np.arange(4) * 100_000_000
    turning = turning_along(time_ns, so3.exp((time_ns * 1e-9)[:, None] * rate))
    asked = np.array([-50_000_000, 0, 130_000_000, 300_000_000, 360_000_000])
    np.testing.assert_allclose(turning(asked), so3.exp((asked * 1e-9)[:, None] * rate), atol=1e-12)


@pytest.mark.parametrize(("every", "is_open"), [(3, True), (40, False)])
def test_a_direction_that_noise_shows_now_and_then_is_open(every: int, is_open: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a tunnel one scan of three seemed to measure it: no spell was longer than two seconds, and nothing was said."""
    _, scans = drive(SPEED_M_S)
    count = iter(range(10_000))

    def status(*_: object) -> str:
        is_shown = (next(count) % 3 == 0) if every == 3 else (next(count) % every > 3)
        return "ok" if is_shown else "weak"

    monkeypatch.setattr(WeakSpell, "status", status)
    odometry = LidarOdometry()
    monkeypatch.setattr("boxplus.systems.lidar_odometry.odometry._LONGEST_WEAK_S", 0.5)
    for scan in scans:
        odometry.push_scan(scan)
    assert ("left a direction open" in (odometry.contradiction or "")) == is_open
