"""What no sensor in order delivers is told from what a motion, however violent, makes of its samples."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.inertial.imu_values import EMPTY, GLITCH, beyond, empty, finite, glitches
from boxplus.sensors.lidar.scan import Scan
from boxplus.sensors.sequencer import Sequencer

rates = st.sampled_from([50.0, 100.0, 200.0, 400.0, 1000.0])


def moving(seed: int, rate_hz: float, shaken: float = 0.0, samples: int = 60) -> ImuSamples:
    """Tumbling at up to 20 rad/s, pushed by up to 100 m/s², turning over within 0.2 s; shaken from sample to sample."""
    random = np.random.default_rng(seed)
    time_s = np.arange(samples) / rate_hz
    wave = np.sin(2.0 * np.pi * random.uniform(0.1, 2.5, 6) * time_s[:, None] + random.uniform(-np.pi, np.pi, 6))
    values = wave * np.repeat([20.0, 100.0], 3) * random.uniform(0.0, 1.0, 6) + np.repeat([0.0, 3.0], 3)
    values += shaken * random.normal(size=values.shape) * np.repeat([1.0, 20.0], 3)
    return ImuSamples(np.round(1e9 * time_s).astype(np.int64), values[:, :3].copy(), values[:, 3:].copy())


@given(st.integers(0, 10_000), rates, st.sampled_from([0.0, 0.1, 1.0, 5.0]))
@settings(deadline=None)
def test_no_motion_looks_like_a_glitch(seed: int, rate_hz: float, shaken: float) -> None:
    assert not glitches(moving(seed, rate_hz, shaken)).any()


@given(st.integers(0, 10_000), st.sampled_from([200.0, 400.0, 1000.0]), st.integers(10, 58), st.booleans())
@settings(deadline=None)
def test_a_sample_that_its_neighbours_deny_is_found_and_no_other(seed: int, rate_hz: float, at: int, of_gyro: bool) -> None:
    imu, random = moving(seed, rate_hz), np.random.default_rng(seed)
    direction = random.normal(size=3)
    values = imu.gyro if of_gyro else imu.accel
    usual = np.median(np.linalg.norm(np.diff(values, axis=0), axis=1))
    values[at] += direction / np.linalg.norm(direction) * (12.0 * usual + (6.0 if of_gyro else 200.0)) * random.uniform(1.0, 10.0)
    assert np.flatnonzero(glitches(imu)).tolist() == [at]


def test_steps_that_stay_are_no_glitches_and_far_samples_tell_nothing() -> None:
    gyro = np.zeros((20, 3))
    gyro[10:, 2] = 30.0
    time_ns = 5_000_000 * np.arange(20)
    assert not glitches(ImuSamples(time_ns, gyro, np.ones((20, 3)))).any()
    gyro[11:] = 0.0
    assert np.flatnonzero(glitches(ImuSamples(time_ns, gyro, np.ones((20, 3))))).tolist() == [10]
    assert not glitches(ImuSamples(10 * time_ns, gyro, np.ones((20, 3)))).any()
    gyro[19] = 30.0
    assert np.flatnonzero(glitches(ImuSamples(time_ns, gyro, np.ones((20, 3))))).tolist() == [10, 19]


def test_masks_of_what_is_no_measurement() -> None:
    gyro, accel = np.zeros((4, 3)), np.full((4, 3), 5.0)
    gyro[1, 0], accel[2, 1], accel[3] = np.nan, 401.0, 0.0
    imu = ImuSamples(np.arange(4), gyro, accel)
    assert finite(imu).tolist() == [True, False, True, True]
    assert beyond(imu).tolist() == [False, False, True, False]
    assert empty(imu).tolist() == [False, False, False, True]


@pytest.mark.parametrize("block", [1, 7, 200])
@given(st.integers(0, 1000), st.integers(12, 196))
@settings(deadline=None, max_examples=20)
def test_a_glitch_is_counted_once_and_in_no_frame_however_samples_arrive(block: int, seed: int, at: int) -> None:
    imu = moving(seed, 200.0, samples=200)
    imu.gyro[at] += 60.0
    imu.gyro[at - 1] = imu.accel[at - 1] = 0.0
    sequencer, frames = Sequencer(), []
    for begin in range(0, 200, block):
        sequencer.add_imu(imu.where(slice(begin, begin + block)))
        frames += sequencer.frames()
    for k in range(9):
        start_ns = 100_000_000 * k
        sequencer.add_scan(Scan.from_arrays(np.ones((2, 3)), np.array([start_ns, start_ns + 99_999_999])))
        frames += sequencer.frames()
    assert sequencer.rejected == {GLITCH: 1, EMPTY: 1}
    times = np.concatenate([frame.imu.time_ns for frame in frames])
    assert imu.time_ns[at] not in times and imu.time_ns[at - 1] not in times
    assert len(frames) == 9 and all(frame.covered for frame in frames)
