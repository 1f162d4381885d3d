"""What a caller has put together without `from_arrays` is checked where an estimator takes it in."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import boxplus as bp
from boxplus.sensors.checked import checked_imu, checked_scan

TIMES = 10**18 + np.arange(4) * 5_000_000
SAMPLES = bp.ImuSamples(TIMES, np.zeros((4, 3)), np.ones((4, 3)))
SCAN = bp.Scan.from_arrays(np.arange(1.0, 13.0).reshape(4, 3), TIMES)


def test_what_is_right_is_taken_as_it_is() -> None:
    assert checked_imu(SAMPLES) is SAMPLES
    assert checked_scan(SCAN) is SCAN


def test_other_types_are_converted() -> None:
    found = bp.ImuSamples(TIMES.tolist(), SAMPLES.gyro.astype(np.float32), SAMPLES.accel.tolist())  # type: ignore[arg-type]
    assert (found.time_ns.dtype, found.gyro.dtype, found.accel.dtype) == (np.int64, np.float64, np.float64)
    assert (
        checked_imu(found) is found and bp.ImuSamples(TIMES[::2], SAMPLES.gyro[::2], SAMPLES.accel[::2]).gyro.flags.c_contiguous
    )
    wide: Any = replace(SCAN, p_lidar=SCAN.p_lidar.astype(np.float64), start_ns=SCAN.start_ns - 5)
    scan = checked_scan(wide)
    assert scan.p_lidar.dtype == np.float32 and scan.p_lidar.tolist() == SCAN.p_lidar.tolist()
    assert (scan.start_ns, scan.end_ns) == (SCAN.start_ns - 5, SCAN.end_ns)


def test_points_that_are_not_finite_are_left_out_and_counted() -> None:
    points = SCAN.p_lidar.copy()
    points[2, 1] = np.nan
    scan = checked_scan(replace(SCAN, p_lidar=points, intensity=np.arange(4, dtype=np.float32), rejected={"not finite": 1}))
    assert scan.time_ns.tolist() == TIMES[[0, 1, 3]].tolist() and dict(scan.rejected) == {"not finite": 2}
    assert scan.intensity is not None and scan.intensity.tolist() == [0.0, 1.0, 3.0]


def test_what_is_converted_keeps_what_belongs_to_it() -> None:
    """Columns cut from a wider array lie apart in memory; the number of its LiDAR stays with every point."""
    wide = np.column_stack([SCAN.p_lidar, np.ones(4, np.float32)]).astype(np.float32)
    apart = wide[:, :3]
    scan = checked_scan(replace(SCAN, p_lidar=apart))
    assert scan.p_lidar.flags.c_contiguous and scan.p_lidar.tolist() == SCAN.p_lidar.tolist()
    numbered = replace(SCAN, p_lidar=np.array(apart, np.float64), lidar=np.arange(4, dtype=np.uint8), rejected={"far": 2})
    numbered.p_lidar[1] = 0.0
    scan = checked_scan(numbered)
    assert scan.lidar is not None and scan.lidar.tolist() == [0, 2, 3]
    assert dict(scan.rejected) == {"far": 2, "zero (no return)": 1}
    listed: Any = replace(SCAN, intensity=[1.0, 2.0, 3.0, 4.0])
    strength = checked_scan(listed).intensity
    assert strength is not None and strength.dtype == np.float32


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"accel": np.zeros((3, 3))}, r"accel as numbers of shape \(4, 3\).* got float64 of shape \(3, 3\)"),
        ({"gyro": np.zeros((4, 2))}, r"gyro as numbers of shape \(4, 3\)"),
        ({"time_ns": TIMES * 1e-9}, r"time_ns as integer nanoseconds .* got float64 .* convert seconds"),
    ],
)
def test_samples_that_do_not_fit_together(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(bp.InputError, match=told):
        replace(SAMPLES, **changes)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"p_lidar": SCAN.p_lidar[:, :2]}, r"p_lidar as numbers of shape \(N, 3\)"),
        ({"time_ns": TIMES[:2]}, r"time_ns as integer nanoseconds of shape \(4,\)"),
        ({"time_ns": TIMES * 1e-9}, r"time_ns as integer nanoseconds .* got float64"),
        ({"start_ns": SCAN.end_ns, "end_ns": SCAN.start_ns}, r"between start_ns, 10+15000000, and end_ns, 10+ – got points"),
        ({"intensity": np.zeros(3, np.float32)}, r"intensity as numbers of shape \(4,\)"),
        ({"lidar": np.zeros(5, np.uint8)}, r"lidar of shape \(4,\), as time_ns – got shape \(5,\)"),
        (
            {"time_ns": TIMES - TIMES[0]},
            r"between start_ns, 1\d+, .* got points from 0 to 15000000 – give all of them as absolute",
        ),
    ],
)
def test_scans_that_do_not_fit_together(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(bp.InputError, match=told):
        bp.LidarInertialOdometry().push_scan(replace(SCAN, **changes))
    with pytest.raises(bp.InputError, match=told):
        bp.LidarOdometry().push_scan(replace(SCAN, **changes))


def test_things_of_another_kind() -> None:
    odometry: Any = bp.LidarInertialOdometry()
    with pytest.raises(bp.InputError, match=r"expected a Scan – got ndarray of shape \(5, 3\) – build it with Scan.from_arrays"):
        odometry.push_scan(np.zeros((5, 3)))
    with pytest.raises(bp.InputError, match="expected ImuSamples – got Scan – build them with"):
        odometry.push_imu(SCAN)
