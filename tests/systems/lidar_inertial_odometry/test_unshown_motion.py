"""Where nothing tells rest from a constant speed, the covariance says so, and no scan claims to know."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from boxplus.filtering.degeneracy import pose_directions
from boxplus.filtering.iterated_update import Information, Posterior
from boxplus.filtering.nav_state import T_P, T_V, TANGENT
from boxplus.simulation import ImuModel, Scenario, Simulation
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.unshown_motion import UnshownMotion
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, deviations, position_errors, run

AXIS = np.array([1.0, 0.0, 0.0])
CELL_M = 0.25


def covariance(seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(TANGENT, TANGENT)) * 0.05
    return root @ root.T + 1e-6 * np.eye(TANGENT)


def surface(normal: int, seed: int = 0) -> np.ndarray:
    """1500 points on a rough square of 8 m across an axis, 3 m away."""
    random = np.random.default_rng(seed)
    points = random.uniform(-4.0, 4.0, (1500, 3))
    points[:, normal] = 3.0 + 0.01 * random.normal(size=1500)
    return points


def looked_at(unshown: UnshownMotion, points: np.ndarray, x: float = 0.0) -> None:
    for _ in range(5):
        unshown.look(points + x * AXIS, x * AXIS, CELL_M, pose_directions(np.eye(6), np.eye(6), 1.0, 0.0))


@lru_cache(maxsize=1)
def constant_speed() -> tuple[Simulation, list[Estimate]]:
    """Five seconds with 1.5 m/s along a smooth corridor; the LiDAR sees the same all the time."""
    motion = manoeuvres.constant_velocity(5.5, (-5.0, 0.1, 1.4), (1.5, 0.0, 0.0), np.eye(3))
    simulation = Simulation(Scenario("corridor", worlds.corridor(), motion, LIDAR), 0, 5.0)
    return simulation, run(LidarInertialOdometry(config(simulation)), simulation.events())


def test_a_constant_speed_in_a_corridor_is_never_claimed_to_be_rest() -> None:
    simulation, estimates = constant_speed()
    assert {estimate.status for estimate in estimates[1:]} == {"weak"}
    (told,) = (text for estimate in estimates for text in estimate.warnings)
    assert "do not show whether the platform moves" in told
    assert all(max(abs(weak.translation_world[0]) for weak in estimate.weak_directions) > 0.9 for estimate in estimates[1:])
    time_ns = np.array([estimate.time_ns for estimate in estimates])
    truth = simulation.ground_truth(np.minimum(time_ns, simulation.end_ns))
    R = estimates[0].state.R_world_imu @ truth.R_world_imu[0].T
    for estimate, p in zip(estimates, truth.p_world_imu, strict=True):
        error = estimate.state.p_world_imu - estimates[0].state.p_world_imu - R @ (p - truth.p_world_imu[0])
        P = estimate.pose_covariance[3:, 3:] + 1e-6 * np.eye(3)
        assert error @ np.linalg.solve(P, error) < 5.0**2
        assert np.sqrt(estimate.covariance[T_V, T_V]) > 5.0
    assert np.linalg.norm(error) > 5.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_shaken_platform_at_rest_in_a_corridor_does_not_run_away(seed: int) -> None:
    """Motors shake it with 1 m/s²: it stays where it is, and says all the time that nothing shows it along the corridor."""
    motion, imu = trajectories.at_rest(9.0, (-5.0, 0.1, 1.4)), ImuModel(accel_vibration=1.0, gyro_vibration=0.05)
    simulation = Simulation(Scenario("corridor", worlds.corridor(), motion, LIDAR, imu), seed, 8.0)
    odometry = LidarInertialOdometry(config(simulation))
    estimates = run(odometry, simulation.events())
    assert odometry.start is not None and odometry.start.kind == "static" and odometry.contradiction is None
    assert {estimate.status for estimate in estimates[1:]} == {"weak"}
    assert position_errors(simulation, estimates).max() < 0.05 and (deviations(simulation, estimates) < 5.0).all()


def test_what_is_not_known_grows_with_time_along_the_axis() -> None:
    unshown = UnshownMotion(AXIS[None], 0)
    cov = covariance()
    for seconds in (0.0, 2.0, 7.0):
        wide = unshown.widened(cov, round(seconds * 1e9))
        added = wide - cov
        assert np.linalg.eigvalsh(added).min() > -1e-9
        np.testing.assert_allclose(np.sqrt(added[[T_P, T_V], [T_P, T_V]]), [10.0 * seconds, 10.0], atol=1e-9)
        assert np.sqrt(added[T_P + 1, T_P + 1]) <= 0.06 * seconds
        np.testing.assert_allclose(unshown.widened(cov[:6, :6], round(seconds * 1e9)), wide[:6, :6])
    np.testing.assert_array_equal(UnshownMotion().widened(cov, 10**9), cov)


def test_it_is_told_once_where_nothing_shows_it_for_long_and_at_once_where_rest_is_doubted() -> None:
    unshown = UnshownMotion(AXIS[None], 10**9, text="undecided")
    assert [unshown.words(round(seconds * 1e9)) for seconds in (1.0, 3.9, 4.0, 7.0)] == [[], [], ["undecided"], []]
    assert UnshownMotion(AXIS[None], 10**9, doubted=True, text="undecided").words(10**9) == ["undecided"]
    assert UnshownMotion().words(10**12) == []


def test_a_surface_across_the_axis_shows_the_speed() -> None:
    unshown = UnshownMotion(AXIS[None], 0, text="undecided")
    looked_at(unshown, surface(1))
    assert len(unshown.axes) == 1
    looked_at(unshown, surface(0))
    assert len(unshown.axes) == 0
    assert unshown.words(10**11) == []
    np.testing.assert_array_equal(unshown.widened(covariance(), 9 * 10**9), covariance())


def test_where_rest_was_doubted_only_a_way_along_the_axis_lets_surfaces_show_it() -> None:
    unshown = UnshownMotion(AXIS[None], 0, np.zeros(3), doubted=True)
    for x in (0.0, -9.0):
        looked_at(unshown, surface(0), x)
        assert len(unshown.axes) == 1
    looked_at(unshown, surface(0), -11.0)
    assert len(unshown.axes) == 0


def test_the_axis_is_refined_by_what_the_scans_leave_open() -> None:
    tilted = np.array([np.cos(0.1), np.sin(0.1), 0.0])
    unshown = UnshownMotion(tilted[None], 0)
    for seed in range(5):
        normals = np.random.default_rng(seed).normal(size=(500, 3)) * [0.02, 1.0, 1.0]
        A = np.zeros((12, 12))
        A[3:6, 3:6] = normals.T @ normals
        directions = pose_directions(np.eye(6), np.eye(6), 1.0, 0.0)
        posterior = Posterior(
            np.zeros(36), np.eye(24), True, A, Information(A, np.zeros(12), np.zeros(12), directions, 500, 0.0), 1, True
        )
        marked = unshown.mark(posterior)
        assert marked.last.directions.weak.sum() == 1 and not directions.weak.any()
    assert np.arccos(unshown.axes[0] @ AXIS) < 0.005
