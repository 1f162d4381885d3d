"""Blocks of IMU samples: shapes and types at the border."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.errors import InputError
from boxplus.sensors.inertial.imu import ImuSamples


def test_a_single_sample_may_be_given_flat() -> None:
    samples = ImuSamples.from_arrays(7, [1, 2, 3], [4, 5, 6])
    assert len(samples) == 1
    assert samples.time_ns.tolist() == [7]
    assert samples.gyro.tolist() == [[1.0, 2.0, 3.0]]
    assert samples.accel.dtype == np.float64


def test_values_are_not_judged() -> None:
    samples = ImuSamples.from_arrays([2, 1], np.full((2, 3), np.nan), np.full((2, 3), np.inf))
    assert samples.time_ns.tolist() == [2, 1]
    assert np.isnan(samples.gyro).all()


def test_rows_are_contiguous() -> None:
    samples = ImuSamples.from_arrays(np.arange(4), np.zeros((3, 4)).T, np.zeros((4, 6))[:, ::2])
    assert samples.gyro.flags.c_contiguous
    assert samples.accel.flags.c_contiguous


def test_no_samples() -> None:
    assert len(ImuSamples.from_arrays(np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3)))) == 0


@pytest.mark.parametrize(
    ("time", "gyro", "accel", "message"),
    [
        ([0.0, 0.1], np.zeros((2, 3)), np.zeros((2, 3)), "expected time_ns as integer nanoseconds of shape (N,) – got float64"),
        ([[0, 1]], np.zeros((2, 3)), np.zeros((2, 3)), "got int64 of shape (1, 2) – convert seconds with np.round"),
        (
            [0, 1],
            np.zeros((3, 2)),
            np.zeros((2, 3)),
            "expected gyro as numbers of shape (2, 3), one row per time stamp – got float64 of shape (3, 2)",
        ),
        (
            [0, 1],
            np.zeros((2, 3)),
            np.zeros(3),
            "expected accel as numbers of shape (2, 3), one row per time stamp – got float64 of shape (3,)",
        ),
        ([0], [["a", "b", "c"]], np.zeros(3), "expected gyro as numbers of shape (1, 3), one row per time stamp – got <U1"),
    ],
)
def test_wrong_shapes_are_explained(time: object, gyro: object, accel: object, message: str) -> None:
    with pytest.raises(InputError) as error:
        ImuSamples.from_arrays(time, gyro, accel)  # type: ignore[arg-type]
    assert message in str(error.value)


@given(st.lists(st.integers(0, 20), max_size=12))
def test_samples_in_order_are_later_than_all_before_them(times: list[int]) -> None:
    samples = ImuSamples(np.array(times, dtype=np.int64), np.zeros((len(times), 3)), np.zeros((len(times), 3)))
    kept = samples.in_order().time_ns.tolist()
    assert kept == [time for k, time in enumerate(times) if all(time > before for before in times[:k])]
