"""Selecting, appending and merging preintegrated intervals: what comes out is what would have been integrated at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.residuals.inertial.imu_preintegration import Preintegration
from tests.residuals.inertial.imu_streams import random_stream

NOISE = ImuNoise(gyro=0.02, accel=0.1, gyro_walk=0.003, accel_walk=0.05)
BIAS_ACCEL, BIAS_GYRO = (0.1, -0.2, 0.05), (-0.02, 0.03, 0.01)
NUMBERS = ("alpha", "beta", "gamma_wxyz", "covariance", "bias_jacobian", "duration_s", "longest_gap_s", "steps", "intervals_ns")
seeds = st.integers(0, 2**32 - 1)


def window(seed: int, count: int) -> Preintegration:
    """`count` neighbouring intervals, whose ends lie anywhere between the samples."""
    stream = random_stream(seed, 40 * count)
    rng = np.random.default_rng(seed)
    span = stream[0][-1] - stream[0][0]
    cuts = stream[0][0] + np.sort(rng.integers(span // 10, span - span // 10, count + 1))
    cuts[1:] += np.arange(1, count + 1)  # no two are equal
    return Preintegration.integrate(
        *stream, noise=NOISE, intervals_ns=np.column_stack([cuts[:-1], cuts[1:]]), bias_accel=BIAS_ACCEL, bias_gyro=BIAS_GYRO
    )


def assert_same(found: Preintegration, expected: Preintegration, tolerance: float = 0.0) -> None:
    for name in NUMBERS:
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=0.0, atol=tolerance * max(1.0, float(np.abs(b).max())), err_msg=name)


@settings(max_examples=20)
@given(seeds, st.integers(2, 6))
def test_slices_merged_are_the_whole(seed: int, count: int) -> None:
    p = window(seed, count)
    whole = Preintegration.integrate(
        p.time_ns, p.gyro, p.accel, noise=NOISE, bias_accel=BIAS_ACCEL, bias_gyro=BIAS_GYRO,
        intervals_ns=[p.intervals_ns[0, 0], p.intervals_ns[-1, 1]],
    )  # fmt: skip
    assert_same(p.merge(0, count - 1), whole, 1e-12)
    joined = p[0]
    for k in range(1, count):
        joined = joined.append(p[k]).merge(0)
        assert len(joined) == 1
    assert_same(joined, whole, 1e-12)
    pieces = p[: count // 2].append(p[count // 2 :])
    assert_same(pieces, p)
    assert_same(pieces.merge(0, count - 1), whole, 1e-12)


@settings(max_examples=10)
@given(seeds)
def test_merging_leaves_the_others_alone(seed: int) -> None:
    p = window(seed, 5)
    before = {name: getattr(p, name).copy() for name in NUMBERS}
    merged = p.merge(2)
    assert len(merged) == 4
    assert_same(merged[:2], p[:2])
    assert_same(merged[3], p[4])
    assert merged.intervals_ns[2].tolist() == [p.intervals_ns[2, 0], p.intervals_ns[3, 1]]
    assert merged.steps[2] in (p.steps[2] + p.steps[3], p.steps[2] + p.steps[3] - 1)
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(p, name), array)


def test_a_slice_keeps_the_samples_it_needs() -> None:
    p = window(3, 6)
    for rows in (2, slice(1, 3), [4, 1], np.arange(6) == 5):
        part = p[rows]
        assert part.time_ns[0] <= part.intervals_ns[:, 0].min() and part.time_ns[-1] >= part.intervals_ns[:, 1].max()
        assert len(part.time_ns) < len(p.time_ns)
        again = part.reintegrated([0.3, 0, 0], [0, 0, 0.1], np.ones(len(part), dtype=bool))
        whole = p.reintegrated([0.3, 0, 0], [0, 0, 0.1], np.ones(len(p), dtype=bool))[rows]
        assert_same(again, whole)
        assert_same(part.shifted(40_000_000), p[rows].shifted(40_000_000))
    # Not a view: what is selected does not change with what it was selected from.
    assert not any(np.shares_memory(getattr(p, name), getattr(p[:], name)) for name in ("alpha", "gyro", "time_ns"))


def test_refusals() -> None:
    p = window(4, 4)
    with pytest.raises(InputError, match="intervals from 0 to 3 – got 4"):
        p[4]
    with pytest.raises(InputError, match="at least one interval"):
        p[2:2]
    with pytest.raises(InputError, match="intervals first < last from 0 to 3 – got 3 and 4"):
        p.merge(3)
    with pytest.raises(InputError, match="intervals that follow each other – got interval 1 from"):
        p[[0, 2]].merge(0)
    other = window(5, 2)
    with pytest.raises(InputError, match="the same samples where both have some"):
        p.append(other)
    louder = Preintegration.integrate(p.time_ns, p.gyro, p.accel, noise=ImuNoise(1.0, 1.0, 1.0, 1.0))
    with pytest.raises(InputError, match="integrate both with the same noise and mode"):
        p.append(louder)
    with pytest.raises(InputError, match="intervals within the samples"):
        p.shifted(10**12)
