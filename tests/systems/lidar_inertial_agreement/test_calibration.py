"""What a calibration claims is right, and as right as it claims."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.runs.calibration import _quantities
from boxplus.simulation import faults
from boxplus.systems.lidar_inertial_agreement import calibration
from boxplus.systems.lidar_inertial_agreement.agreement import compare_sensors, usable
from boxplus.systems.lidar_inertial_agreement.calibration import ARM, OFFSET, SCALE, SLOPE, THETA, calibrate
from tests.systems.lidar_inertial_agreement.small_platforms import CONFIG, data, handheld

SEEDS = (0, 2, 4, 6)


def errors(seed: int, offset_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (9,) of a calibration in the order of its covariance (9, 9), and those of `RotationFit`, whitened (4,)."""
    simulation = handheld(seed)
    T = simulation.T_imu_lidar
    scans, imu = data(simulation, faults.clock_offset(offset_s))
    agreement = compare_sensors(scans, imu, CONFIG, refine=True)
    found = calibrate([(agreement, usable(imu))])
    rotation = agreement.rotation
    assert found is not None and rotation is not None
    error = np.zeros(9)
    error[THETA] = so3.log(found.T_imu_lidar[:3, :3] @ T[:3, :3].T)
    error[ARM] = found.T_imu_lidar[:3, 3] - T[:3, 3]
    error[OFFSET], error[SCALE], error[SLOPE] = found.offset_s - offset_s, np.log(found.gyro_scale), found.slope - 1.0
    alone = np.concatenate([so3.log(rotation.R_imu_lidar @ T[:3, :3].T), [rotation.offset_s - offset_s]])
    index = [0, 1, 2, 7]
    return error, found.covariance, np.linalg.solve(np.linalg.cholesky(rotation.covariance[np.ix_(index, index)]), alone)


@pytest.fixture(scope="module")
def calibrations() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    return [errors(seed, 0.03 * (-1) ** seed * (seed + 1) / 8) for seed in SEEDS]


@pytest.mark.slow
def test_mounting_clocks_and_scales_are_found(calibrations: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    for error, _, _ in calibrations:
        assert np.degrees(np.linalg.norm(error[THETA])) < 0.5
        assert np.linalg.norm(error[ARM]) < 0.03
        assert abs(error[OFFSET]) < 2e-3
        assert abs(error[SCALE]) < 0.005


@pytest.mark.slow
def test_the_stated_covariances_hold(calibrations: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> None:
    """NEES per degree of freedom, over all seeds: not overconfident, and not so wide that it says nothing."""
    joint = [error @ np.linalg.solve(covariance, error) / 9 for error, covariance, _ in calibrations]
    alone = [white @ white / 4 for _, _, white in calibrations]
    assert 0.05 < np.mean(joint) < 1.5
    assert 0.05 < np.mean(alone) < 2.0


@pytest.mark.slow
def test_a_second_stretch_adds_to_the_first() -> None:
    simulation = handheld(1, seconds=10.0)
    scans, imu = data(simulation)
    middle = len(scans) // 2
    parts = [(compare_sensors(part, imu, CONFIG, refine=True), usable(imu)) for part in (scans[:middle], scans[middle:])]
    one, both = calibrate(parts[:1]), calibrate(parts)
    assert one is not None and both is not None
    assert both.poses > 1.5 * one.poses
    assert both.std[ARM].max() < one.std[ARM].max()
    assert np.linalg.norm(both.T_imu_lidar[:3, 3] - simulation.T_imu_lidar[:3, 3]) < 0.02


def test_nothing_to_calibrate_from() -> None:
    scans, imu = data(handheld(0))
    assert calibrate([]) is None
    assert calibrate([(compare_sensors(scans[:4], imu, CONFIG), usable(imu))]) is None


def test_a_search_that_did_not_come_to_rest_says_what_was_still_moving(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = handheld(3)
    scans, imu = data(simulation, faults.clock_offset(0.03))
    stretches = [(compare_sensors(scans, imu, CONFIG, refine=True), usable(imu))]
    settled = calibrate(stretches)
    assert settled is not None and settled.moving.max() < 0.02
    assert not [row.advice for row in _quantities(settled, 0.0) if "come to rest" in row.advice]
    monkeypatch.setattr(calibration, "_ROUNDS", 1)
    started = calibrate(stretches)
    assert started is not None and started.moving[ARM].max() > 1.0
    (row,) = [row for row in _quantities(started, 0.0) if row.name == "p_imu_lidar"]
    assert not row.determined and "the search did not come to rest" in row.advice
