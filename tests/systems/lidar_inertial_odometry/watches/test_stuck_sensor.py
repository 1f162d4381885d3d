"""A sensor that repeats itself while the platform moves has failed; at rest it may be coarse, and nothing is said."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from boxplus.sensors.imu import ImuSamples
from boxplus.sensors.scan import Scan
from boxplus.simulation import Scenario, Simulation
from boxplus.simulation.faults import Event
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.watches.stuck_sensor import StuckSensor
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, deviations, position_errors

RATE_HZ, SCAN_S, FAILS_S = 200, 0.1, 3.0


def told(gyro: np.ndarray, accel: np.ndarray) -> list[tuple[float, str]]:
    """When [s] something was said of samples (N, 3), pushed scan by scan with one shared at every border, and what."""
    watch, said = StuckSensor(), []
    time_ns = np.arange(len(gyro)) * (1_000_000_000 // RATE_HZ)
    step = round(SCAN_S * RATE_HZ)
    for begin in range(0, len(gyro) - step, step):
        part = slice(begin, begin + step + 1)
        text = watch.update(ImuSamples.from_arrays(time_ns[part], gyro[part], accel[part]))
        if text is not None:
            said.append((float(time_ns[part][-1]) * 1e-9, text))
    return said


def moving(seconds: float = 3.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a platform in a hand: both sensors swing at half a hertz to two."""
    random = np.random.default_rng(seed)
    time = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    swings = np.sin(2.0 * np.pi * random.uniform(0.5, 2.0, 6) * time[:, None] + random.uniform(0.0, 6.0, 6))
    values = swings * np.repeat([0.5, 1.0], 3) + 0.002 * random.normal(size=swings.shape) + [0.0, 0.0, 0.0, 0.0, 0.0, 9.81]
    return values[:, :3], values[:, 3:]


def frozen(values: np.ndarray, from_s: float, at: np.ndarray | None = None) -> np.ndarray:
    begin = round(from_s * RATE_HZ)
    spoilt = values.copy()
    spoilt[begin:] = values[begin] if at is None else at
    return spoilt


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("at_zero", [False, True])
def test_a_sensor_that_repeats_itself_amid_motion_is_named_within_a_second(seed: int, at_zero: bool) -> None:
    gyro, accel = moving(seed=seed)
    assert not told(gyro, accel)
    at = np.zeros(3) if at_zero else None
    for name, samples in (("gyroscope", (frozen(gyro, 1.0, at), accel)), ("accelerometer", (gyro, frozen(accel, 1.0, at)))):
        when, text = told(*samples)[0]
        assert 1.5 <= when <= 1.8
        assert f"the {name} has given the same values sample after sample although the platform moves" in text


def test_one_that_stops_within_a_sample_is_named_without_help_of_the_other() -> None:
    """Turning on the spot the accelerometer shows nothing."""
    rest = np.tile([0.0, 0.0, 9.81], (600, 1)) + 0.02 * np.random.default_rng(0).normal(size=(600, 3))
    turning = np.tile([0.0, 0.0, 0.5], (600, 1)) + 0.002 * np.random.default_rng(1).normal(size=(600, 3))
    when, text = told(frozen(turning, 1.0, np.zeros(3)), rest)[0]
    assert 1.5 <= when <= 1.6 and "the gyroscope" in text
    assert not told(turning, rest)


@pytest.mark.parametrize("vibration", [0.02, 1.0])
def test_coarse_samples_at_rest_are_nothing(vibration: float) -> None:
    """A gyroscope that rounds its noise away, after a motion that ends as motions do, on a platform whose motor runs."""
    random = np.random.default_rng(0)
    time = np.arange(800) / RATE_HZ
    rate = 0.5 * np.cos(0.5 * np.pi * np.clip(time, 0.0, 1.0)) ** 2
    gyro = np.round((rate[:, None] * [0.2, 0.3, 1.0] + 1e-4 * random.normal(size=(800, 3))) / 0.01) * 0.01
    accel = vibration * np.sin(2.0 * np.pi * 70.0 * time)[:, None] + 0.02 * random.normal(size=(800, 3)) + [0.0, 0.0, 9.81]
    assert (gyro[300:] == gyro[300]).all()
    assert not told(gyro, accel)


def test_a_simulated_imu_without_noise_may_drive_straight_on() -> None:
    time = np.arange(600) / RATE_HZ
    gyro = np.where(time[:, None] < 1.0, [0.0, 0.0, 0.5], 0.0)
    accel = np.array([0.0, 0.0, 9.81]) + np.sin(np.pi * time)[:, None] * [1.0, 0.0, 0.0]
    assert not told(gyro, accel)
    assert told(gyro, accel + 0.01 * np.random.default_rng(0).normal(size=accel.shape))


@pytest.mark.parametrize("held", [2, 10])
def test_values_held_until_the_next_arrives_are_nothing(held: int) -> None:
    """A driver that gives what a slower sensor had last, again and again."""
    gyro, accel = moving()
    assert not told(np.repeat(gyro[::held], held, axis=0), accel)


def dying(events: Iterable[Event], at_ns: int) -> Iterator[Event]:
    """The gyroscope reads zero from an instant on."""
    for event in events:
        if isinstance(event, ImuSamples):
            event = ImuSamples(event.time_ns, np.where(event.time_ns[:, None] < at_ns, event.gyro, 0.0), event.accel)
        yield event


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    "motion",
    [
        manoeuvres.handheld(6.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 1.5),
        manoeuvres.handheld(6.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 0.4),
        trajectories.walk(((-2.5, 0.5), (1.0, 0.5), (1.0, -2.5))),
        manoeuvres.constant_turn(6.0, (0.0, 0.0, 1.5), 0.01, 1.5),
    ],
    ids=["handheld", "slow", "walk", "on the spot"],
)
def test_a_gyroscope_that_dies_is_told_within_a_second_of_the_first_wrong_pose(motion: Trajectory, seed: int) -> None:
    simulation = Simulation(Scenario("dying", worlds.room(seed=seed), motion, LIDAR), seed, 5.5)
    odometry, estimates, told_s = LidarInertialOdometry(config(simulation)), [], np.inf
    for event in dying(simulation.events(), simulation.start_ns + round(FAILS_S * 1e9)):
        new = odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
        estimates += new
        if new and np.isinf(told_s) and (odometry.contradiction is not None or new[-1].status == "lost"):
            told_s = (new[-1].time_ns - simulation.start_ns) * 1e-9
    off = (position_errors(simulation, estimates) > 0.03) & (deviations(simulation, estimates) > 5.0)
    wrong_s = (np.array([estimate.time_ns for estimate in estimates]) - simulation.start_ns)[off] * 1e-9
    assert FAILS_S < told_s < min(wrong_s.min(initial=np.inf), FAILS_S + 1.0) + 1.0
    assert odometry.contradiction is not None  # and it stays
