"""A sensor that repeats itself while the platform moves has failed; at rest it may be coarse, and nothing is said."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Scenario, Simulation
from boxplus.simulation.faults import Event
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import Trajectory
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from boxplus.systems.lidar_inertial_odometry.watches.stuck_sensor import StuckSensor
from tests.systems.lidar_inertial_odometry.small_drives import LIDAR, config, deviations, position_errors

RATE_HZ, FAILS_S = 200, 3.0


def told(
    gyro: np.ndarray,
    accel: np.ndarray,
    rate_hz: int = RATE_HZ,
    scan_s: float = 0.1,
    burst: int = 1,
    rates: np.ndarray | None = None,
    bias: np.ndarray | None = None,
) -> list[tuple[float, str]]:
    """When [s] something was said of samples (N, 3), pushed scan by scan with one shared at every border, and what.

    Args:
        rates: (N, 3) at which the scans turn, if not as the gyroscope says [rad/s].
        bias: (3,) of the gyroscope, as it is known [rad/s]; None: none.
    """
    bias = np.zeros(3) if bias is None else bias
    rates = gyro if rates is None else rates
    watch, said = StuckSensor(), []
    time_ns = np.arange(len(gyro)) * (1_000_000_000 // rate_hz)
    time_ns = time_ns[np.arange(len(gyro)) // burst * burst] + np.arange(len(gyro)) % burst * 50_000
    step = round(scan_s * rate_hz)
    for begin in range(0, len(gyro) - step, step):
        part = slice(begin, begin + step + 1)
        turned = rates[begin : begin + step].sum(axis=0) / rate_hz
        text = watch.update(ImuSamples.from_arrays(time_ns[part], gyro[part], accel[part]), turned, bias)
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
def test_an_accelerometer_that_repeats_itself_amid_turns_is_named_within_a_second(seed: int, at_zero: bool) -> None:
    gyro, accel = moving(seed=seed)
    assert not told(gyro, accel)
    when, text = told(gyro, frozen(accel, 1.0, np.zeros(3) if at_zero else None))[0]
    assert 1.5 <= when <= 1.8
    assert "the accelerometer has given the same values sample after sample, although the platform turns" in text


@pytest.mark.parametrize("scan_s", [0.05, 0.1, 0.25, 0.5])
@pytest.mark.parametrize("begin_s", [1.0, 1.03, 1.26])
def test_a_gyroscope_that_stops_within_a_sample_is_named_without_help_of_the_accelerometer(scan_s: float, begin_s: float) -> None:
    """Turning on the spot that shows nothing."""
    rest = np.tile([0.0, 0.0, 9.81], (600, 1)) + 0.02 * np.random.default_rng(0).normal(size=(600, 3))
    turning = np.tile([0.0, 0.0, 1.5], (600, 1)) + 0.002 * np.random.default_rng(1).normal(size=(600, 3))
    when, text = told(frozen(turning, begin_s, np.zeros(3)), rest, scan_s=scan_s)[0]
    assert begin_s + 0.5 <= when <= begin_s + 0.5 + scan_s + 0.01 and "the gyroscope" in text
    assert not told(turning, rest, scan_s=scan_s)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("value", [0.0, 0.4])
def test_a_gyroscope_that_never_changes_is_named_where_the_scans_turn(seed: int, value: float) -> None:
    gyro, accel = moving(seed=seed)
    dead = np.full_like(gyro, value)
    when, text = told(dead, accel, rates=gyro)[0]
    assert when <= 2.0 and "the gyroscope has given the same values sample after sample, although the scans turn" in text
    assert not told(dead, accel) and not told(gyro, accel, rates=np.zeros_like(gyro))


@pytest.mark.parametrize("step", [0.002, 0.01, 0.02])
@pytest.mark.parametrize("scan_s", [0.05, 0.1, 0.5])
def test_turns_below_the_steps_of_a_coarse_gyroscope_are_nothing(step: float, scan_s: float) -> None:
    random = np.random.default_rng(0)
    accel = np.tile([0.0, 0.0, 9.81], (4000, 1)) + 0.02 * random.normal(size=(4000, 3))
    slow = 0.99 * step * np.tile([0.0, 0.6, 0.8], (4000, 1))
    noise = np.repeat(random.normal(size=(400, 3)), 10, axis=0) * np.deg2rad(0.1) / 0.05  # of the scans' turns
    assert not told(np.zeros_like(accel), accel, scan_s=scan_s, rates=slow + noise)


@pytest.mark.parametrize("size", [0.02, 0.05, 0.1])
def test_a_coarse_gyroscope_at_rest_may_have_a_large_bias(size: float) -> None:
    random, bias = np.random.default_rng(0), size * np.array([0.0, 0.6, 0.8])
    accel = np.tile([0.0, 0.0, 9.81], (2000, 1)) + 0.02 * random.normal(size=(2000, 3))
    gyro = np.round((bias + 1e-4 * random.normal(size=accel.shape)) / 0.005) * 0.005
    rest = np.zeros_like(gyro)
    assert not told(gyro, accel, rates=rest, bias=bias)
    turning = np.clip(np.arange(2000)[:, None] / RATE_HZ - 3.0, 0.0, 1.0) * [0.1, 0.0, 0.0]
    assert told(gyro, accel, rates=turning, bias=bias)  # which it does not show


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400])
@pytest.mark.parametrize("stops_in_s", [0.03, 0.1, 0.3])
@pytest.mark.parametrize("rate", [0.3, 1.0, 2.0])
def test_a_robot_that_stops_with_a_gyroscope_of_coarse_steps_is_nothing(rate_hz: int, stops_in_s: float, rate: float) -> None:
    """It turns on the spot, stops, and drives straight on; what is below 0.01 rad/s its driver takes for none."""
    random, time = np.random.default_rng(0), np.arange(4 * rate_hz) / rate_hz
    turn = rate * np.clip((1.0 + stops_in_s - time) / stops_in_s, 0.0, 1.0)[:, None] * [0.0, 0.0, 1.0]
    turn = turn + 1e-3 * random.normal(size=turn.shape)
    gyro = np.where(np.abs(turn) < 0.01, 0.0, turn)
    pull = np.clip(time - 2.0, 0.0, 1.0)[:, None] * [2.0, 0.0, 0.0] + [0.0, 0.0, 9.81]
    accel = pull + 0.02 * random.normal(size=pull.shape)
    assert not told(gyro, accel, rate_hz)
    for burst in (2, 4, 5):  # stamped as they arrive
        for phase in range(burst):
            assert not told(gyro[phase:], accel[phase:], rate_hz, burst=burst)


def test_a_turn_that_begins_beside_a_coarse_accelerometer_is_nothing() -> None:
    random, time = np.random.default_rng(0), np.arange(600) / RATE_HZ
    gyro = np.clip(time - 1.0, 0.0, 0.6)[:, None] / 0.6 * [0.0, 0.0, 1.0] + 0.002 * random.normal(size=(600, 3))
    assert not told(gyro, np.tile([0.0, 0.0, 9.8], (600, 1)))


@pytest.mark.parametrize("vibration", [0.02, 1.0])
@pytest.mark.parametrize("hz", [3.0, 13.0, 37.0, 70.0, 99.0])
def test_coarse_samples_at_rest_are_nothing(vibration: float, hz: float) -> None:
    """A gyroscope that rounds its noise away, on a platform whose motor runs."""
    random, time = np.random.default_rng(0), np.arange(800) / RATE_HZ
    gyro = np.round(1e-4 * random.normal(size=(800, 3)) / 0.01) * 0.01
    accel = vibration * np.sin(2.0 * np.pi * hz * time)[:, None] + 0.02 * random.normal(size=(800, 3)) + [0.0, 0.0, 9.81]
    assert (gyro == gyro[0]).all()
    assert not told(gyro, accel)


def test_a_simulated_imu_without_noise_may_stop_at_once() -> None:
    time = np.arange(600) / RATE_HZ
    gyro = np.where(time[:, None] < 1.0, [0.0, 0.0, 1.5], 0.0)
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
        manoeuvres.handheld(8.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 1.5),
        manoeuvres.handheld(8.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 0.4),
        trajectories.walk(((-2.5, 0.5), (1.0, 0.5), (1.0, -2.5), (-2.0, -2.0))),
        manoeuvres.constant_turn(8.0, (0.0, 0.0, 1.5), 0.01, 1.5),
    ],
    ids=["handheld", "slow", "walk", "on the spot"],
)
def test_a_gyroscope_that_dies_is_told_within_a_second_of_the_first_wrong_pose(motion: Trajectory, seed: int) -> None:
    simulation = Simulation(Scenario("dying", worlds.room(seed=seed), motion, LIDAR), seed, 7.0)
    odometry, estimates, told_s = LidarInertialOdometry(config(simulation)), [], np.inf
    for event in dying(simulation.events(), simulation.start_ns + round(FAILS_S * 1e9)):
        new = odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
        estimates += new
        if new and np.isinf(told_s) and (odometry.contradiction is not None or new[-1].status == "lost"):
            told_s = (new[-1].time_ns - simulation.start_ns) * 1e-9
    off = (position_errors(simulation, estimates) > 0.03) & (deviations(simulation, estimates) > 5.0)
    wrong_s = (np.array([estimate.time_ns for estimate in estimates]) - simulation.start_ns)[off] * 1e-9
    assert FAILS_S < told_s <= wrong_s.min(initial=6.0) + 1.05  # a scan more than a second
    assert odometry.contradiction is not None  # and it stays


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_gyroscope_that_gives_zeros_from_the_start_is_named(seed: int) -> None:
    motion = trajectories.walk(((-2.5, 0.5), (1.0, 0.5), (1.0, -2.5), (-2.0, -2.0)))
    simulation = Simulation(Scenario("dead", worlds.room(seed=seed), motion, LIDAR), seed, 8.0)
    odometry, warnings = LidarInertialOdometry(config(simulation)), []
    for event in dying(simulation.events(), simulation.start_ns):
        for estimate in odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event):
            warnings += estimate.warnings
    told = "the gyroscope has given the same values sample after sample, although the scans turn"
    assert any(told in text for text in warnings)
    assert odometry.contradiction is not None


def test_turns_while_a_gyroscope_repeated_itself_are_forgotten_once_it_works_again() -> None:
    """It repeats itself for a second twice, and the scans turn by 3 degrees each time: together that would be too much."""
    random, time = np.random.default_rng(0), np.arange(8 * RATE_HZ) / RATE_HZ
    accel = np.tile([0.0, 0.0, 9.81], (len(time), 1)) + 0.02 * random.normal(size=(len(time), 3))
    gyro = 0.002 * random.normal(size=accel.shape)
    rates = np.zeros_like(gyro)
    for begin in (2.0, 3.2):
        stuck = (time >= begin) & (time < begin + 1.0)
        gyro[stuck] = gyro[np.flatnonzero(stuck)[0]]
        rates[stuck & (time >= begin + 0.6), 2] = np.deg2rad(3.0) / 0.4
    assert not told(gyro, accel, rates=rates)
    rates[:, 2] *= 2.0
    assert told(gyro, accel, rates=rates)
