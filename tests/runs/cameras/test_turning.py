"""The stretch of a recording in which a camera turns."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.runs.cameras.turning import Turning
from boxplus.sensors.inertial.imu import ImuSamples

START_NS = 1_700_000_000_000_000_000


def turning(rates: list[float], block: int = 70, bias: float = 0.0, noise: float = 0.0, gap_s: int = 0) -> Turning:
    """Of an IMU that swings about y, each second with another amplitude [rad/s], in blocks that do not end with the seconds.

    After half of the seconds nothing is recorded for `gap_s`.
    """
    number = np.arange(100 * len(rates))
    late = np.where(number >= 50 * len(rates), gap_s, 0) * 1_000_000_000
    time_ns = START_NS + number * 10_000_000 + late
    gyro = bias + noise * np.random.default_rng(0).standard_normal((len(number), 3))
    gyro[:, 1] += np.sqrt(2.0) * np.repeat(rates, 100) * np.sin(2.0 * np.pi * number / 100.0)
    found = Turning(14.0)
    for begin in range(0, len(time_ns), block):
        chosen = slice(begin, begin + block)
        found.add(ImuSamples(time_ns[chosen], gyro[chosen], gyro[chosen]))
    return found


def seconds(found: Turning) -> float | None:
    until = found.until_ns()
    return None if until is None else (until - START_NS) * 1e-9


@pytest.mark.parametrize(
    ("rates", "earliest_s", "latest_s"),
    [
        ([0.6] * 5, 4.9, 5.0),  # all of a short one
        ([0.02] * 20 + [0.5] * 20, 22.0, 25.0),  # the first that turns enough, not the one that turns most
        ([0.1] * 20 + [0.2] * 20, 33.0, 40.0),  # none does: the one that turns most
    ],
)
def test_the_first_stretch_that_turns_a_lot_or_the_one_that_turns_most(
    rates: list[float], earliest_s: float, latest_s: float
) -> None:
    found = seconds(turning(rates))
    assert found is not None and earliest_s - 0.01 <= found <= latest_s + 0.01


def test_rest_a_bias_and_vibration_are_no_turning() -> None:
    assert turning([]).until_ns() is None
    assert turning([0.0] * 40).until_ns() is None
    assert turning([0.0] * 40, bias=0.06).until_ns() is None
    assert turning([0.0] * 40, noise=0.05).until_ns() is None
    shaken = seconds(turning([0.0] * 20 + [0.4] * 20, noise=0.1))
    assert shaken is not None and shaken > 22.0


def test_a_stretch_is_one_of_time() -> None:
    """Five seconds that turn before a gap and nine at rest after it are no fourteen seconds."""
    found = seconds(turning([0.5] * 10 + [0.0] * 10, gap_s=100))
    assert found is not None and found < 20.0


def test_samples_that_are_not_finite_do_not_count() -> None:
    found = turning([0.1] * 20)
    before = found.until_ns()
    found.add(ImuSamples(np.array([START_NS + 500_000_000]), np.full((1, 3), np.nan), np.zeros((1, 3))))
    assert found.until_ns() == before is not None
