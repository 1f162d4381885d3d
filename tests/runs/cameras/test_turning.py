"""The stretch of a recording in which a camera turns."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.runs.cameras.turning import Turning
from boxplus.sensors.imu import ImuSamples


def turning(rates: list[float], block: int = 70) -> Turning:
    """Of an IMU that turns at each of these rates for a second [rad/s], in blocks that do not end with the seconds."""
    time_ns = 1_700_000_000_000_000_000 + np.arange(100 * len(rates)) * 10_000_000
    gyro = np.zeros((len(time_ns), 3))
    gyro[:, 1] = np.repeat(rates, 100)
    found = Turning(14.0)
    for begin in range(0, len(time_ns), block):
        chosen = slice(begin, begin + block)
        found.add(ImuSamples(time_ns[chosen], gyro[chosen], gyro[chosen]))
    return found


def seconds(found: Turning) -> float | None:
    until = found.until_ns()
    return None if until is None else (until - 1_700_000_000_000_000_000) * 1e-9


@pytest.mark.parametrize(
    ("rates", "expected_s"),
    [
        ([0.0] * 40, None),
        ([], None),
        ([0.6] * 5, 5.0),  # all of a short one
        ([0.02] * 20 + [0.5] * 20, 24.0),  # the first that turns enough, not the one that turns most
        ([0.1] * 20 + [0.2] * 20, 34.0),  # none does: the one that turns most
    ],
)
def test_the_first_stretch_that_turns_a_lot_or_the_one_that_turns_most(rates: list[float], expected_s: float | None) -> None:
    assert seconds(turning(rates)) == expected_s


def test_samples_that_are_not_finite_do_not_count() -> None:
    found = turning([0.1] * 20)
    found.add(ImuSamples(np.array([1_700_000_000_500_000_000]), np.full((1, 3), np.nan), np.zeros((1, 3))))
    assert seconds(found) is not None
