"""A pose that fits a part of what it sees and misses the rest is contradicted within about a second."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.filtering.nav_state import BA, BW, T_P, TANGENT, NavState, P
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.watches.consistency import Consistency

PERIOD_NS = 100_000_000


def follow(shares: list[float]) -> tuple[Consistency, list[str]]:
    """The shares of the points that lie on their planes, a scan each at 10 Hz."""
    consistency, told = Consistency(LioConfig()), []
    for number, share in enumerate(shares):
        frame: Any = SimpleNamespace(scan=SimpleNamespace(start_ns=number * PERIOD_NS, end_ns=(number + 1) * PERIOD_NS))
        told += consistency._fit(frame, share)
    return consistency, told


@pytest.mark.parametrize("shares", [[0.95] * 50, [0.2] * 9, ([0.3] * 9 + [0.9]) * 5])
def test_what_fits_or_misses_for_a_moment_is_no_contradiction(shares: list[float]) -> None:
    consistency, told = follow(shares)
    assert not told and consistency.contradiction is None


def test_a_second_of_misses_is_a_contradiction_and_stays_one() -> None:
    consistency, told = follow([0.98] * 20 + [0.4] * 30 + [0.98] * 10)
    assert len(told) == 1 and told[0].startswith("for 1.0 s only 40% of the points near surfaces of the map lie on them")
    assert consistency.contradiction == told[0]


@pytest.mark.parametrize(
    ("gyro", "accel", "sigma", "told"),
    [(0.085, 0.6, 0.0, 0), (0.12, 0.0, 0.0, 1), (0.0, 0.8, 0.0, 1), (0.12, 0.8, 0.3, 0)],
)
def test_biases_that_no_sensor_in_order_has_are_named_once(gyro: float, accel: float, sigma: float, told: int) -> None:
    """The gyroscope of EuRoC's flights has 0.085 rad/s and is in order; what is not known yet is not held against it."""
    x = NavState.identity().pack()
    x[BW], x[BA + 1] = gyro, accel
    consistency = Consistency(LioConfig())
    found = consistency._biases(x, sigma**2 * np.eye(TANGENT)) + consistency._biases(x, sigma**2 * np.eye(TANGENT))
    assert len(found) == told
    assert all("T_imu_lidar is wrong" in text for text in found)


@pytest.mark.parametrize(("first", "then", "contradicted"), [(0.0, 0.8, True), (0.8, 0.85, False), (0.0, 0.6, False)])
def test_a_bias_that_changes_by_more_than_any_sensor_does_is_a_contradiction(
    first: float, then: float, contradicted: bool
) -> None:
    """One that was large from the start is that of a bad sensor, and a warning."""
    consistency, x, told = Consistency(LioConfig()), NavState.identity().pack(), []
    for accel in (first, then, then):
        x[BA + 1] = accel
        told += consistency._biases(x, np.zeros((TANGENT, TANGENT)))
    assert (consistency.contradiction is not None) == contradicted
    assert len(told) == (max(first, then) > 0.7)


@pytest.mark.parametrize(("off_m", "samples", "told"), [(0.02, 10, 1), (0.005, 10, 0), (0.02, 1, 0)])
def test_corrections_beyond_noise_are_named_once_after_two_seconds(off_m: float, samples: int, told: int) -> None:
    """2 cm a scan, where the prediction and a registration are good for 1 cm; with one IMU sample a scan nobody knows."""
    x, correction = NavState.identity().pack(), np.zeros(TANGENT)
    x[P] += off_m
    correction[T_P] = off_m
    directions = SimpleNamespace(weak=np.zeros(6, bool), vectors=np.eye(6), lever_arm=1.0)
    posterior: Any = SimpleNamespace(x=x, valid=True, last=SimpleNamespace(directions=directions))
    consistency, found = Consistency(LioConfig()), []
    for number in range(40):
        frame: Any = SimpleNamespace(scan=SimpleNamespace(end_ns=number * PERIOD_NS), imu=range(samples))
        found.append(consistency._innovate(frame, correction, 1e-8 * np.eye(TANGENT), posterior))
    assert sum(map(len, found)) == told and consistency.contradiction is None
    assert not any(found[:20])
