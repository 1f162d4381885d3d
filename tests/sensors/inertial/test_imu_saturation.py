"""A limit that is reached again and again is told; the rounded top of a motion is not."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_saturation import Saturation, limits_of

STEP = 0.0081722  # m/s², of the accelerometer that the values below are from
SCAN = 20  # samples


def told(accel_z: NDArray[np.float64]) -> list[str]:
    """What is said of these values (N,), scan by scan; neighbouring scans share a sample."""
    saturation = Saturation()
    accel = np.zeros((len(accel_z), 3))
    accel[:, 2] = accel_z
    time_ns = 5_000_000 * np.arange(1, len(accel_z) + 1)
    found: list[str] = []
    for k in range(0, len(accel_z) - 1, SCAN):
        part = slice(k, k + SCAN + 1)
        reached = saturation.update(ImuSamples(time_ns[part], np.zeros((len(time_ns[part]), 3)), accel[part]))
        found += [limit.text for limit in reached]
    return found


def vibration(peaks: list[float], limit: float = np.inf) -> NDArray[np.float64]:
    """One period of 0.1 s after another of these heights over 2 m/s², rounded to steps, clipped."""
    wave = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(SCAN) / SCAN)
    return -np.minimum(np.round((2.0 + np.concatenate([height * wave for height in peaks])) / STEP) * STEP, limit)


def test_the_rounded_top_of_a_motion_is_no_limit() -> None:
    z = vibration([1.5, 2.0])
    # EuRoC MH_05 at 6.2 s: larger than anything in the second before, and the same three times.
    z[27:33] = [-4.37213146, -4.42116471, -4.52740342, -4.52740342, -4.52740342, -4.47837017]
    assert not told(z)
    assert not told(np.concatenate([z, vibration([2.0, 3.0, 3.0])]))


@pytest.mark.parametrize("shift", range(0, SCAN, 3))
def test_a_limit_is_told_when_it_is_reached_again(shift: int) -> None:
    # For three samples, across the border of scans as well.
    z = np.concatenate([np.full(shift, -2.0), vibration([2.0, 3.0, 2.0, 3.0], limit=4.9)])
    assert np.count_nonzero(z == -4.9) == 6
    assert set(told(z)) == {"accelerometer z saturated at 4.90 m/s²"}


def test_a_long_plateau_is_told_at_once() -> None:
    z = vibration([2.0, 6.0], limit=5.5)
    assert np.count_nonzero(z == -5.5) >= 6
    assert len(told(z)) == 1


@pytest.mark.parametrize("step", [0.001, 0.01, 0.03])
@pytest.mark.parametrize("seed", range(3))
def test_a_steady_turn_in_coarse_steps_is_no_limit(step: float, seed: int) -> None:
    """A vehicle whose accelerometer has less noise than a step: plateaus as long as the turn, and again in the next one."""
    random, time = np.random.default_rng(seed), np.arange(1200) * 0.005
    pull = 2.7 * np.clip(1.5 * np.sin(2.0 * np.pi * time / random.uniform(2.0, 6.0)), 0.0, 1.0)
    smooth = np.convolve(np.pad(pull, 40, mode="edge"), np.hanning(81) / np.hanning(81).sum(), "valid")
    z = np.round((smooth + 0.1 * step * random.normal(size=1200)) / step) * step
    assert np.count_nonzero(z == z.max()) > 20
    assert not told(z)


def saturated_gyroscope(rate_hz: int, step: float, bias: float) -> tuple[list[float], NDArray[np.float64]]:
    """Times [s] at which scans of 0.1 s were told to be saturated, of a swing to 6 rad/s beyond 16 bits; and the rates (N,)."""
    random, count = np.random.default_rng(rate_hz), 10 * rate_hz
    time_ns = np.arange(count) * (1_000_000_000 // rate_hz)
    gyro = 2e-3 * random.normal(size=(count, 3))
    gyro[:, 2] += 6.0 * np.sin(np.pi * time_ns * 1e-9)
    gyro = np.clip(np.round(gyro / step), -(2**15), 2**15 - 1) * step - bias
    accel = 0.02 * random.normal(size=(count, 3)) + [0.0, 0.0, 9.81]
    saturation, when = Saturation(), []
    for begin in range(0, count - 1, rate_hz // 10):
        part = slice(begin, begin + rate_hz // 10 + 1)
        if saturation.update(ImuSamples(time_ns[part], gyro[part], accel[part])):
            when.append(float(time_ns[begin]) * 1e-9)
    return when, gyro[:, 2]


@pytest.mark.parametrize("rate_hz", [50, 100, 200, 400, 1000])
@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_a_limit_either_way_is_told_amid_a_motion_that_is_never_slow(rate_hz: int, bias: float) -> None:
    """Swinging from the first sample on, the axis itself never changes by a single step, nor is it as far up as down."""
    when, rates = saturated_gyroscope(rate_hz, 4.3633 / 2**15, bias)
    at_limit = (np.isclose(rates, rates.min()) | np.isclose(rates, rates.max())).reshape(-1, rate_hz // 10)
    clipped = np.flatnonzero(at_limit.all(axis=1)) * 0.1
    assert len(clipped) > 30 and np.isclose(clipped[:, None], when).any(axis=1).mean() > 0.95
    clear = np.flatnonzero(~at_limit.any(axis=1)) * 0.1
    assert not np.isclose(clear[:, None], when).any()


@pytest.mark.parametrize("limit", [0.55, 1.3, 4.36])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_limits_of_a_whole_recording_are_those_that_nothing_exceeds(limit: float, way: float) -> None:
    random, time_s = np.random.default_rng(3), np.arange(2000) * 0.005
    swing = np.outer(np.sin(2.0 * time_s), [0.0, 2.0 * limit * way, 0.0]) + 1e-3 * random.normal(size=(2000, 3))
    swing[:, 1] = np.minimum(way * swing[:, 1], limit) * way
    imu = ImuSamples((1e9 * time_s).astype(np.int64), swing, 0.02 * random.normal(size=(2000, 3)) + [0.0, 0.0, 9.81])
    (found,) = limits_of(imu)
    assert found.text == f"gyroscope y saturated at {limit:.2f} rad/s" and found.of_gyro
    assert (found.reached(imu) == np.isclose(way * swing[:, 1], limit)).all()
    beyond = swing.copy()
    beyond[-1, 1] = 1.5 * limit * way
    assert not limits_of(ImuSamples(imu.time_ns, beyond, imu.accel))


class InWholeBlocks:
    """The same rule, a block of samples (n, 12) at a time along and against the axes, as the one that is compiled is not."""

    def __init__(self) -> None:
        self.peak, self.step, self.run, self.plateaus = np.zeros(12), np.full(2, np.inf), np.zeros(12, int), np.zeros(12, int)
        self.cut_off, self.low, self.last = np.zeros(12, bool), [], np.empty((0, 6))

    def update(self, along: NDArray[np.float64]) -> list[tuple[int, float]]:
        self.low = [*self.low, np.abs(along).min(axis=0)][-20:]
        first = self.last if len(self.last) else along[:1]
        changes, self.last = np.abs(np.diff(np.vstack([first, along]), axis=0)), along[-1:]
        values, limit = np.hstack([along, -along]), np.zeros(12, bool)
        largest = np.maximum(values.max(axis=0), self.peak).reshape(2, 6).max(axis=0)
        least = np.where(changes > 1e-6 * largest, changes, np.inf).min(axis=0)
        self.step = np.minimum(self.step, least.reshape(2, 3).min(axis=1))
        if (values.max(axis=0) < self.peak * (1.0 - 1e-6)).all():
            self.run[:] = 0
            return []
        for value, is_cut in zip(values, np.tile(changes > 2.5 * np.repeat(self.step, 3), 2), strict=True):
            higher = value > self.peak * (1.0 + 1e-6)
            for forgotten in (self.plateaus, self.run, limit, self.cut_off):
                forgotten[higher] = 0
            at_peak = value >= self.peak * (1.0 - 1e-6)
            self.peak = np.maximum(self.peak, value)
            self.cut_off |= at_peak & (self.run == 0) & is_cut
            self.run = np.where(at_peak, self.run + 1, 0)
            self.plateaus += self.cut_off & (self.run == 3)
            limit |= self.cut_off & (self.run >= 3) & ((self.plateaus >= 2) | (self.run >= 6))
        limit &= self.peak - np.tile(np.min(self.low, axis=0), 2) > np.tile(np.repeat([0.5, 1.5], 3), 2)
        return [(int(way), float(self.peak[way])) for way in np.flatnonzero(limit)]


def test_limits_are_those_of_whole_arrays_however_samples_are_cut_into_blocks() -> None:
    assert sum(_limits_reached(seed) > 0 for seed in range(60)) > 20


def _limits_reached(seed: int) -> int:
    """Swings clipped at random, in coarse or fine steps, by both; how many limits both have told."""
    random, count = np.random.default_rng(seed), 500
    time_s = np.arange(count) * 0.005
    swings = np.sin(random.uniform(1.0, 20.0, 6) * time_s[:, None] + random.uniform(0.0, 6.0, 6))
    noise = random.choice([0.0, 0.02]) * random.normal(size=(count, 6))
    along = random.uniform(0.0, 3.0, 6) * np.repeat([1.0, 3.0], 3) * swings + noise
    along[:, :3] = np.clip(along[:, :3], -random.uniform(0.5, 2.0), random.uniform(0.5, 2.0))
    along[:, 3:] = np.clip(along[:, 3:], -random.uniform(2.0, 9.0), random.uniform(2.0, 9.0))
    step = random.choice([1e-4, 0.01, 0.05])
    along = np.round(along / step) * step
    cuts = np.unique(np.concatenate([[0, count], random.integers(1, count, 25)]))
    compiled, whole, reached = Saturation(), InWholeBlocks(), 0
    for begin, end in itertools.pairwise(cuts.tolist()):
        part = slice(max(begin - int(random.integers(0, 3)), 0), end)  # blocks may share samples at their border
        imu = ImuSamples(np.arange(count)[part] * 5_000_000, along[part, :3].copy(), along[part, 3:].copy())
        found = compiled.update(imu)
        assert [(limit.way, limit.value) for limit in found] == whole.update(along[begin:end])
        reached += len(found)
    return reached
