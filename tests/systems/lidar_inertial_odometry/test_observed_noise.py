"""What an IMU's samples say about its noise, against noise that was put there."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.observed_noise import ObservedNoise


def _scan(begin_s: float, rate_hz: float, gyro: float, accel: float, rng: np.random.Generator, motion: float = 1.0) -> ImuSamples:
    """A tenth of a second of an IMU of these densities that swings at one hertz."""
    time = begin_s + np.arange(int(0.1 * rate_hz)) / rate_hz
    swing = motion * np.sin(2.0 * np.pi * time)[:, None] * np.array([1.0, -0.5, 0.3])
    noise = rng.normal(size=(2, len(time), 3)) * np.sqrt(rate_hz)
    return ImuSamples(np.round(time * 1e9).astype(np.int64), 0.5 * swing + gyro * noise[0], 9.8 + swing + accel * noise[1])


_STEADY = LioConfig(gyro_scale_noise=0.0)  # whatever the IMU turns


def _after(scans: int, config: LioConfig, rate_hz: float, gyro: float, accel: float, seed: int = 0) -> ObservedNoise:
    rng, noise = np.random.default_rng(seed), ObservedNoise(config)
    for k in range(scans):
        noise.update(_scan(0.1 * k, rate_hz, gyro, accel, rng))
    return noise


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 400.0])
@pytest.mark.parametrize("seed", range(3))
def test_five_times_what_differs_from_sample_to_sample_whatever_the_rate(rate_hz: float, seed: int) -> None:
    density = np.sqrt(_after(30, _STEADY, rate_hz, 2e-4, 2e-3, seed).density)
    # Eight differences a scan scatter, and the larger ones are kept for a while.
    assert 0.9 < density[0] / (5.0 * 2e-4) < 1.5
    assert 0.9 < density[1] / (5.0 * 2e-3) < 1.5
    np.testing.assert_allclose(density[2:], [LioConfig().gyro_bias_walk, LioConfig().accel_bias_walk])


def test_a_quiet_and_a_shaken_imu_reach_the_ends() -> None:
    np.testing.assert_allclose(np.sqrt(_after(20, _STEADY, 200.0, 1e-6, 1e-5).density[:2]), [5e-4, 5e-3])
    np.testing.assert_allclose(np.sqrt(_after(20, _STEADY, 200.0, 1e-2, 1e-1).density[:2]), [2e-3, 5e-2])


def test_shaking_is_believed_at_once_and_forgotten_slowly() -> None:
    rng, noise = np.random.default_rng(0), _after(20, _STEADY, 200.0, 1e-6, 1e-5)
    before = noise.density
    shaken = noise.update(_scan(2.0, 200.0, 1e-6, 5e-2, rng))
    assert shaken[1] == pytest.approx(0.05**2) and shaken[0] == before[0]
    assert noise.update(_scan(2.1, 200.0, 1e-6, 1e-5, rng))[1] == pytest.approx(0.05**2)
    for k in range(150):
        noise.update(_scan(2.2 + 0.1 * k, 200.0, 1e-6, 1e-5, rng))
    np.testing.assert_allclose(noise.density, before)


def test_what_is_given_is_used_as_it_is() -> None:
    config = LioConfig(accel_noise=3e-3, gyro_scale_noise=0.0)
    for accel in (1e-5, 1e-1):
        density = np.sqrt(_after(20, config, 200.0, 1e-6, accel).density)
        np.testing.assert_allclose(density[:2], [5e-4, 3e-3])


@pytest.mark.parametrize("count", [0, 1, 4])
def test_too_few_samples_say_nothing(count: int) -> None:
    noise = _after(20, _STEADY, 200.0, 1e-6, 1e-5)
    few = ImuSamples(np.arange(count) * 10**7, np.zeros((count, 3)), np.zeros((count, 3)))
    np.testing.assert_allclose(np.sqrt(noise.update(few)[:2]), [2e-3, 5e-2])


@pytest.mark.parametrize("given", [None, 1e-4])
@pytest.mark.parametrize("share", [0.005, 0.02])
def test_turning_adds_its_share_of_the_rate_whether_noise_is_given_or_told(given: float | None, share: float) -> None:
    rng, config = np.random.default_rng(3), LioConfig(gyro_noise=given, gyro_scale_noise=share)
    turning, resting = ObservedNoise(config), ObservedNoise(config)
    samples = _scan(0.0, 200.0, 1e-5, 1e-4, rng, motion=0.0)
    rate = np.array([0.3, -0.4, 1.2])  # 1.3 rad/s
    density = turning.update(ImuSamples(samples.time_ns, samples.gyro + rate, samples.accel)) - resting.update(samples)
    np.testing.assert_allclose(np.sqrt(density[0]), share * 1.3, rtol=1e-3)
    np.testing.assert_allclose(density[1:], 0.0, atol=1e-15)
    # The next scan turns no more, and so few samples as leave the noise untold still tell the rate.
    few = ImuSamples(samples.time_ns[:2], samples.gyro[:2] + rate, samples.accel[:2])
    assert turning.update(samples)[0] < 1e-5 and turning.update(few)[0] > (share * 1.29) ** 2
