"""The first state against the truth: it is as far off as its covariance says, at rest amid vibration and in motion."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.evaluation.nees import nees, nees_band
from boxplus.filtering.nav_state import T_BA, T_BW, T_G, T_V
from boxplus.simulation import ImuModel, Scenario, Simulation
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.start.start import Start, find_start
from tests.systems.lidar_inertial_agreement.small_platforms import swaying
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, deviations, frames, position_errors, run

ROOM = (24.0, 20.0, 5.0)
SHAKEN = ImuModel(accel_vibration=1.0, gyro_vibration=0.05)
BIAS_STD = 0.1  # m/s² an axis
RUNS = 12


def started(motion: Trajectory, seed: int, imu: ImuModel) -> tuple[Start, np.ndarray, np.ndarray]:
    """A start, x_true - x of [velocity, gravity, bias of the accelerometer, of the gyroscope] (12,), and their covariance."""
    simulation = Simulation(Scenario("start", worlds.room(ROOM, seed=seed), motion, LIDAR, imu), seed, 1.4)
    found = find_start(frames(simulation.events()), config(simulation))
    assert isinstance(found, Start)
    state, truth = found.state, simulation.ground_truth(np.array([found.time_ns]))
    bias_gyro, bias_accel = simulation.biases(np.array([found.time_ns]))
    R = state.R_world_imu @ truth.R_world_imu[0].T  # from the simulated world to that of the start
    error = np.concatenate(
        [
            R @ truth.v_world_imu[0] - state.v_world_imu,
            R @ [0.0, 0.0, -9.81] - state.gravity_world,
            bias_accel[0] - state.bias_accel,
            bias_gyro[0] - state.bias_gyro,
        ]
    )
    of = np.r_[T_V : T_V + 3, T_G : T_G + 3, T_BA : T_BA + 3, T_BW : T_BW + 3]
    return found, error, found.covariance[np.ix_(of, of)]


def test_a_platform_that_sways_at_rest_is_as_fast_and_turns_as_it_says() -> None:
    """Somewhere in its swing it moves with up to 6 cm/s, and its mean turn rate is no bias."""
    deviations_of = []
    for seed in range(6):
        found, error, P = started(swaying(seed, (-5.0, -2.0, 1.5), 0.01, 0.01, 3.0), seed, ImuModel())
        assert found.kind == "static"
        deviations_of.append(error / np.sqrt(P.diagonal()))
    velocity, bias = np.array(deviations_of)[:, :3], np.array(deviations_of)[:, 9:]
    assert 0.2 < np.sqrt((velocity**2).mean()) < 1.5
    assert np.abs(velocity).max() < 3.0
    assert 0.1 < np.sqrt((bias**2).mean()) < 1.5
    assert np.abs(bias).max() < 3.0


@pytest.mark.slow
def test_a_shaken_platform_at_rest_stands_as_upright_as_it_says() -> None:
    """Amid motor vibration of 1 m/s² the first tilt is right within a degree."""
    errors, covariances = [], []
    for seed in range(RUNS):
        found, error, P = started(trajectories.at_rest(2.0, (-5.0, -2.0, 1.5)), seed, SHAKEN)
        assert found.kind == "static" and not error[:3].any()
        tilt, sigma = np.degrees(error[3:5] / 9.81), np.degrees(np.sqrt(np.linalg.eigvalsh(P[3:5, 3:5])[-1]) / 9.81)
        assert np.linalg.norm(tilt) < min(1.0, 3.0 * sigma) and sigma < 2.0
        errors.append(error[3:5])
        covariances.append(P[3:5, 3:5])
    assert nees(errors, covariances).mean() < nees_band(2, RUNS, 0.999)[1]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_shaken_platform_stays_where_it_stands(seed: int) -> None:
    motion = trajectories.at_rest(5.0, (-5.0, -2.0, 1.5))
    simulation = Simulation(Scenario("rest", worlds.room(ROOM, seed=seed), motion, LIDAR, SHAKEN), seed, 4.0)
    odometry = LidarInertialOdometry(config(simulation))
    estimates = run(odometry, simulation.events())
    assert odometry.start is not None and odometry.start.kind == "static" and odometry.contradiction is None
    errors = position_errors(simulation, estimates)
    assert errors.max() < 0.03 and (deviations(simulation, estimates) < 5.0).all()


@pytest.mark.slow
def test_velocity_gravity_and_biases_of_a_moving_start_are_as_far_off_as_they_say() -> None:
    """Average NEES over seeded starts of a platform in a hand, within the band of 99.9 %.

    Below it by a factor of up to four in the standard deviation is allowed: the filter sees the same scans a second time, which
    the covariance makes up for, and accelerometers are allowed larger biases than are drawn here.
    """
    errors, covariances = [], []
    for seed in range(RUNS):
        motion = manoeuvres.handheld(2.0, (-6.0, -5.0, 1.0), (6.0, 5.0, 3.0), 1.5, 1.5, standstill_s=0.0, seed=seed)
        bias = BIAS_STD * np.random.default_rng(seed).normal(size=3)
        found, error, P = started(motion, seed, ImuModel(accel_bias=tuple(bias)))
        assert found.kind == "moving"
        errors.append(error)
        covariances.append(P)
    e, P = np.array(errors), np.array(covariances)
    parts = {"velocity": slice(0, 3), "tilt": slice(3, 5), "accelerometer": slice(6, 9), "gyroscope": slice(9, 12)}
    for name, part in parts.items():
        low, high = nees_band(part.stop - part.start, RUNS, 0.999)
        average = nees(e[:, part], P[:, part, part]).mean()
        assert low / 16.0 < average < high, f"{name}: average NEES {average:.2f} outside {low / 16.0:.2f} … {high:.2f}"
    assert nees(e, P).mean() < nees_band(12, RUNS, 0.999)[1]
