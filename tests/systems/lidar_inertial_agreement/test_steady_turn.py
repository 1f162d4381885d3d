"""A turn at one rate: unit and sign are told where no bias explains the gyroscope's mean, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import ImuModel, Scenario, Simulation, SpinningLidar
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors
from boxplus.systems.lidar_inertial_agreement.hypotheses import contradictions
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.steady_turn import SteadyTurn, steady_turn
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data

DEGREES = 180.0 / np.pi
axes = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)
turns = st.builds(lambda axis, angle: so3.exp(angle * axis / np.linalg.norm(axis)), axes, st.floats(0.0, 3.1))
rates = st.builds(lambda axis, rate: rate * axis / np.linalg.norm(axis), axes, st.floats(np.deg2rad(25.0), 6.0))
biases = st.builds(lambda axis, size: size * axis / np.linalg.norm(axis), axes, st.floats(0.0, np.deg2rad(5.0)))


def _cause(lidar: NDArray[np.float64], gyro: NDArray[np.float64], R: NDArray[np.float64] | None) -> str | None:
    finding = SteadyTurn(lidar, gyro).finding(R)
    return None if finding is None else finding.cause


@given(rates, turns, biases)
def test_each_mistake_is_told_whatever_mounting_and_bias(
    rate: NDArray[np.float64], R: NDArray[np.float64], bias: NDArray[np.float64]
) -> None:
    read = R @ rate + bias
    for known in (R, None):
        assert _cause(rate, read, known) is None
        assert _cause(rate, DEGREES * read, known) == "gyro_unit"
        assert _cause(rate, read / DEGREES, known) == "gyro_unit"
    assert _cause(rate, -R @ rate + bias, R) == "gyro_sign"
    assert _cause(rate, -R @ rate + bias, None) is None


@given(rates, turns, turns)
def test_a_wrong_mounting_is_neither(rate: NDArray[np.float64], R: NDArray[np.float64], other: NDArray[np.float64]) -> None:
    """Unless it is half a turn off, which the sentence says."""
    finding = SteadyTurn(rate, R @ rate).finding(other)
    if finding is not None:
        assert finding.cause == "gyro_sign" and "half a turn off" in finding.text
        assert np.linalg.norm(R @ rate + other @ rate) < 0.25 * np.linalg.norm(rate)


def test_what_a_bias_explains_is_left_open() -> None:
    slow = np.array([0.0, 0.0, np.deg2rad(9.0)])
    assert _cause(slow, -slow, np.eye(3)) is None  # 18 deg/s of bias
    assert _cause(slow, slow / DEGREES, np.eye(3)) is None  # 9 deg/s
    assert _cause(slow, DEGREES * slow, np.eye(3)) == "gyro_unit"  # 500 deg/s are none
    assert _cause(np.zeros(3), np.array([0.0, 0.0, 3.0]), np.eye(3)) is None  # round surfaces may hide that the LiDAR turns


def _circling(rate: float, gyro: float = 1.0) -> tuple[LidarPath, ImuSamples]:
    K = 30
    time_ns = np.arange(K) * 100_000_000
    R = np.array([so3.exp(np.array([0.0, 0.0, rate * t * 1e-9])) for t in time_ns])
    zeros = np.zeros(K)
    information = np.tile(1e6 * np.eye(6), (K, 1, 1))
    path = LidarPath(time_ns, R, np.zeros((K, 3)), information, zeros.astype(int), zeros > 1.0, zeros, zeros, 0)
    samples = np.arange(600) * 5_000_000 - 20_000_000
    return path, ImuSamples(samples, np.tile([0.0, 0.0, gyro * rate], (600, 1)), np.tile([0.0, 0.0, 9.81], (600, 1)))


@pytest.mark.parametrize("rate", [0.5, -2.0, 14.0])
def test_the_means_are_those_of_the_motion(rate: float) -> None:
    path, imu = _circling(rate, DEGREES)
    found = steady_turn(path, imu)
    assert found is not None
    np.testing.assert_allclose(found.lidar, [0.0, 0.0, rate], atol=1e-9)
    np.testing.assert_allclose(found.gyro, [0.0, 0.0, DEGREES * rate], atol=1e-9)


def test_scans_that_do_not_show_their_attitude_say_nothing() -> None:
    path, imu = _circling(0.5)
    hidden = path.information.copy()
    hidden[: len(path) // 2 + 2, 2, 2] = 0.0  # a round room
    assert steady_turn(replace(path, information=hidden), imu) is None
    assert steady_turn(path, imu.where(imu.time_ns < path.time_ns[10])) is None  # samples of a third of it
    torn = replace(path, segment=np.arange(len(path)))
    assert steady_turn(torn, imu) is None


@pytest.mark.parametrize(("factor", "cause"), [
    (1.0, None),
    (DEGREES, "gyro_unit"),
    (1.0 / DEGREES, "gyro_unit"),
    (-1.0, "gyro_sign"),
])  # fmt: skip
def test_scans_of_a_platform_that_goes_round(factor: float, cause: str | None) -> None:
    """At one rate through a room, of which no change of the turn tells anything."""
    motion = manoeuvres.constant_turn(3.0, (0.0, 0.0, 1.3), 1.2, 0.5)
    lidar = SpinningLidar(channels=16, azimuth_steps=450, vertical_fov_deg=(-30.0, 30.0))
    simulation = Simulation(Scenario("circles", worlds.room((6.0, 5.0, 3.0)), motion, lidar, ImuModel(), np.eye(4)), 1, 3.0)
    scans, imu = data(simulation)
    imu = ImuSamples(imu.time_ns, factor * imu.gyro, imu.accel)
    found = contradictions(compare_sensors(scans, imu, CONFIG, T_declared=np.eye(4)), np.eye(4))
    assert [finding.cause for finding in found] == ([] if cause is None else [cause])
