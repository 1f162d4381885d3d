"""Scans keep only returns, and everything of a point together."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from boxplus.errors import InputError
from boxplus.sensors.lidar.scan import Scan, in_order

coordinates = st.one_of(st.floats(width=32), st.just(0.0))


@given(
    st.integers(0, 30).flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=coordinates)), st.floats(0, 5), st.floats(5, 100)
)
def test_points_are_kept_or_counted(points: np.ndarray, near: float, far: float) -> None:
    n = len(points)
    time = np.arange(n, dtype=np.int64)[::-1] + 10**18
    scan = Scan.from_arrays(points, time, np.arange(n, dtype=np.float32), min_range=near, max_range=far)
    assert len(scan) + sum(scan.rejected.values()) == n
    assert np.isfinite(scan.p_lidar).all()
    distance = np.linalg.norm(scan.p_lidar.astype(np.float64), axis=1)
    assert np.all((distance > 0) & (distance >= near * (1 - 1e-12)) & (distance <= far * (1 + 1e-12)))
    # A point's time and intensity stay with it.
    rows = (10**18 + n - 1 - scan.time_ns).astype(int)
    assert scan.intensity is not None
    assert np.array_equal(scan.intensity, rows)
    assert np.array_equal(scan.p_lidar, points[rows])
    if n:
        assert (scan.start_ns, scan.end_ns) == (10**18, 10**18 + n - 1)  # of all points, rejected ones included


def test_each_reason_has_a_name() -> None:
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0.1, 0, 0], [200, 0, 0], [3, 0, 0]])
    scan = Scan.from_arrays(points, np.arange(6), min_range=0.5, max_range=100.0)
    assert scan.rejected == {
        "not finite": 2,
        "zero (no return)": 1,
        "nearer than min_range": 1,
        "farther than max_range": 1,
    }
    assert scan.time_ns.tolist() == [5]
    assert scan.intensity is None


def test_an_empty_scan() -> None:
    scan = Scan.from_arrays(np.zeros((0, 3)), np.zeros(0, int))
    assert len(scan) == 0
    assert (scan.start_ns, scan.end_ns) == (0, 0)


@pytest.mark.parametrize(
    ("points", "time", "intensity", "message"),
    [
        (
            np.zeros((2, 4)),
            [0, 1],
            None,
            "expected p_lidar as numbers of shape (N, 3) – got float64 of shape (2, 4) – give one row",
        ),
        (np.zeros(3), [0], None, "got float64 of shape (3,)"),
        ([["a", "b", "c"]], [0], None, "expected p_lidar as numbers"),
        (np.ones((2, 3)), [0.0, 0.1], None, "expected time_ns as integer nanoseconds of shape (2,), one per point – got float64"),
        (np.ones((2, 3)), [0], None, "got int64 of shape (1,) – give every point its own absolute time"),
        (
            np.ones((2, 3)),
            [0, 1],
            [1.0],
            "expected intensity as numbers of shape (2,), one per point – got float64 of shape (1,)",
        ),
        (np.ones((1, 3)), [0], [1j], "expected intensity as numbers of shape (1,), one per point – got complex128 of shape (1,)"),
    ],
)
def test_wrong_shapes_are_explained(points: object, time: object, intensity: object, message: str) -> None:
    with pytest.raises(InputError) as error:
        Scan.from_arrays(points, time, intensity)  # type: ignore[arg-type]
    assert message in str(error.value)


def test_the_numbers_of_lidars_stay_with_their_points() -> None:
    points = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 0.0], [30.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    scan = Scan.from_arrays(points, np.arange(5), max_range=10.0, lidar=[7, 1, 2, 3, 255])
    assert scan.lidar is not None and scan.lidar.dtype == np.uint8 and scan.lidar.tolist() == [7, 255]
    assert Scan.from_arrays(points, np.arange(5)).lidar is None
    for wrong in ([1, 2], [0.5] * 5, [0, 1, 2, 3, 256], [-1, 0, 0, 0, 0]):
        with pytest.raises(InputError, match=r"lidar as integers of shape \(5,\)|numbers of LiDARs from 0 to 255"):
            Scan.from_arrays(points, np.arange(5), lidar=wrong)


@given(st.lists(st.integers(0, 20), max_size=12))
def test_scans_in_order_end_after_all_before_them(ends: list[int]) -> None:
    scans = [Scan.from_arrays([[4.0, 1.0, 0.2]], [end]) for end in ends]
    kept = [scan.end_ns for scan in in_order(scans)]
    assert kept == sorted(set(kept))
    assert kept == [end for k, end in enumerate(ends) if all(end > before for before in ends[:k])]
