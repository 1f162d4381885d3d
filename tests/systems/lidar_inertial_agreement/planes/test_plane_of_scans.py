"""The main plane of single scans against gravity: it shows a mounting that leans, and only what no slope or motion explains."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import sites, worlds
from boxplus.simulation.worlds.world import World
from boxplus.systems.lidar_inertial_agreement.planes.plane_of_scans import tilted_plane, untilted_plane
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data

LIDAR = SpinningLidar(channels=24, azimuth_steps=120, rate_hz=5.0)
LOW, HIGH = (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5)


def over(world: World, motion: Trajectory, seed: int) -> Simulation:
    return Simulation(Scenario("plane", world, motion, LIDAR, ImuModel(), np.eye(4)), seed, 2.0)


def said(simulation: Simulation, R_imu_lidar: NDArray[np.float64] | None = None) -> str | None:
    scans, imu = data(simulation)
    return tilted_plane(scans, imu, np.eye(3) if R_imu_lidar is None else R_imu_lidar, CONFIG)


def level(seed: int) -> Trajectory:
    return manoeuvres.constant_velocity(3.0, np.array([-1.0, 0.2, 1.5]), (2.0, 0.0, 0.0), manoeuvres.level(0.3 * seed, 0.0, 0.0))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("degrees", [0.0, 6.0, 15.0, 35.0])
def test_the_ground_shows_how_far_a_mounting_leans(seed: int, degrees: float) -> None:
    axis = np.array([np.cos(seed), np.sin(seed), 0.0])
    text = said(over(sites.open_field(seed=seed), level(seed), seed), so3.exp(np.deg2rad(degrees) * axis))
    if degrees <= 8.0:
        assert text is None
    else:
        assert text is not None and "check T_imu_lidar" in text
        assert float(text.split("most of a scan is ")[1].split(" deg")[0]) == pytest.approx(degrees, abs=1.5)


def test_a_turn_about_the_vertical_and_quarter_turns_do_not_show() -> None:
    simulation = over(sites.open_field(seed=4), level(4), 4)
    for axis in np.eye(3):
        assert said(simulation, so3.exp(0.5 * np.pi * axis)) is None
    assert said(simulation, so3.exp(np.array([0.0, 0.0, 0.7]))) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_motion_is_no_mounting(seed: int) -> None:
    """A hand that swings, and a fast steady turn, whose centripetal acceleration leans what the accelerometer shows."""
    swung = manoeuvres.handheld(3.0, LOW, HIGH, 1.2, 1.5, standstill_s=0.0, seed=seed)
    turn = manoeuvres.constant_turn(3.0, (0.0, 0.0, 1.5), 3.0, 0.8)
    for motion in (swung, turn):
        assert said(over(sites.open_field(seed=seed), motion, seed)) is None


def test_nothing_is_said_without_a_plane_or_samples() -> None:
    leaning = so3.exp(np.array([0.5, 0.0, 0.0]))
    assert said(over(worlds.room(seed=1), level(1), 1), leaning) is None
    scans, imu = data(over(sites.open_field(seed=1), level(1), 1))
    assert tilted_plane(scans, ImuSamples(imu.time_ns[:5], imu.gyro[:5], imu.accel[:5]), leaning, CONFIG) is None
    assert tilted_plane(scans[:2], imu, leaning, CONFIG) is None


def _gyro(motion: Trajectory, samples: ImuSamples) -> ImuSamples:
    """The samples with the rates of another motion."""
    other = Simulation(Scenario("other", worlds.room(), motion, LIDAR, ImuModel(), np.eye(4)), 5, 3.0)
    rates = data(other)[1]
    index = np.clip(np.searchsorted(rates.time_ns, samples.time_ns), 0, len(rates) - 1)
    return ImuSamples(samples.time_ns, rates.gyro[index], samples.accel)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_gyroscope_that_tilts_while_the_ground_does_not_is_another_ones(seed: int) -> None:
    swinging = manoeuvres.handheld(5.0, LOW, HIGH, 1.0, 2.5, standstill_s=0.0, seed=seed)
    for motion, foreign in ((level(seed), True), (swinging, False)):
        simulation = Simulation(Scenario("tilt", sites.open_field(seed=seed), motion, LIDAR, ImuModel(), np.eye(4)), seed, 3.0)
        scans, imu = data(simulation)
        assert untilted_plane(scans, imu, CONFIG) is None
        # What turns about one axis leaves it where it is: that may be the plane's normal, and may be a bias.
        steady = ImuSamples(imu.time_ns, imu.gyro + np.array([0.3, -0.2, 0.1]), imu.accel)
        assert not foreign or untilted_plane(scans, steady, CONFIG) is None
        text = untilted_plane(scans, _gyro(swinging, imu), CONFIG)
        assert (text is not None) == foreign
        assert text is None or "the IMU is not the one of this LiDAR" in text
