"""The noise that samples show, against noise that was put there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_noise import sample_noise


@given(st.sampled_from((50.0, 200.0, 1000.0)), st.floats(1e-5, 1e-1), st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_the_density_is_that_of_the_noise_by_axis_and_whatever_the_rate(rate_hz: float, density: float, seed: int) -> None:
    n, by_axis = 4000, np.array([[1.0, 2.0, 4.0], [3.0, 1.0, 0.5]])
    rng = np.random.default_rng(seed)
    gyro, accel = rng.normal(size=(2, n, 3)) * density * by_axis[:, None] * np.sqrt(rate_hz)
    times = np.round(np.arange(n) * 1e9 / rate_hz).astype(np.int64)
    # Second differences overlap: 4000 of them are worth about half as many.
    np.testing.assert_allclose(sample_noise(ImuSamples(times, gyro, accel)) / (density * by_axis), 1.0, atol=5.0 / np.sqrt(n))


@pytest.mark.parametrize("turn_rate", [0.5, 2.0])
def test_a_motion_is_hardly_noise(turn_rate: float) -> None:
    time = np.arange(2000) / 200.0
    gyro = turn_rate * np.sin(2.0 * np.pi * time)[:, None] * np.ones(3)
    accel = 9.8 + 3.0 * np.cos(2.0 * np.pi * time)[:, None] * np.ones(3)
    noise = sample_noise(ImuSamples(np.round(time * 1e9).astype(np.int64), gyro, accel))
    assert noise[0].max() < 2e-5 * turn_rate / 0.5 and noise[1].max() < 1.2e-4


@pytest.mark.parametrize("samples", range(3))
def test_fewer_than_three_samples_show_none(samples: int) -> None:
    few = ImuSamples(1_000_000 * np.arange(samples), np.ones((samples, 3)), np.ones((samples, 3)))
    assert np.array_equal(sample_noise(few), np.zeros((2, 3)))
