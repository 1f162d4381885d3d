"""Corrections that are as white as noise are not spoken of; those that all push to one side are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.filtering.nav_state import TANGENT, NavState, V
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.watches.consistency import Consistency
from boxplus.systems.lidar_inertial_odometry.watches.corrections import _FLOOR, Corrections, _deviations

PERIOD_S, ACCEL_NOISE, POINT_NOISE = 0.1, 0.02, 0.01


ONE_WAY = np.zeros(TANGENT)
ONE_WAY[6] = 0.03


def an_update(before: np.ndarray, after: np.ndarray, *, moved: float = 0.0, lever_m: float = 0.0) -> Any:
    """Covariances (24, 24) before and after a scan, which takes `moved` [1/s] of a lever known to `lever_m` off the velocity."""
    before, B_prior, B = before.copy(), np.zeros((18, 6)), np.zeros((18, 6))
    before[18:, 18:] = np.diag(np.repeat([1e-6, lever_m**2], 3))
    B_prior[6:9, 3:] = 0.5 * np.eye(3)
    B[6:9, 3:] = (0.5 - moved) * np.eye(3)
    x = NavState.identity().pack()
    x[V] = ONE_WAY[6]
    whole = after.copy()
    whole[:18, :18] += B @ before[18:, 18:] @ B.T
    return SimpleNamespace(
        cov_prior=before, cov=after, B_prior=B_prior, B=B, posterior=SimpleNamespace(x=x, cov=whole, valid=True)
    )


def told_of(seed: int, *, factor: float = 1.0, amplitude: float = 1.0, seconds: float = 20.0) -> list[str]:
    """A Kalman filter of position and velocity along x, y, z, whose accelerometer shows `factor` times what is."""
    random = np.random.default_rng(seed)
    F, G = np.array([[1.0, PERIOD_S], [0.0, 1.0]]), np.array([0.5 * PERIOD_S**2, PERIOD_S])
    truth, x = np.zeros((2, 3)), np.zeros((2, 3))
    P = np.diag([0.01**2, 0.02**2])
    corrections, told = Corrections(), []
    for k in range(round(seconds / PERIOD_S)):
        accel = amplitude * np.sin(0.5 * k * PERIOD_S + np.arange(3)) if k * PERIOD_S > 2.0 else np.zeros(3)
        truth = F @ truth + np.outer(G, accel)
        shown = factor * accel + ACCEL_NOISE * random.standard_normal(3)
        x, P = F @ x + np.outer(G, shown), F @ P @ F.T + ACCEL_NOISE**2 * np.outer(G, G)
        gain = P[:, :1] / (P[0, 0] + POINT_NOISE**2)
        correction = gain * (truth[0] + POINT_NOISE * random.standard_normal(3) - x[0])
        after = P - gain @ P[:1]
        full = [np.zeros((TANGENT, TANGENT)) for _ in range(2)]
        for matrix, small in zip(full, (P, after), strict=True):
            matrix[6:9, 6:9] = small[1, 1] * np.eye(3)
        delta = np.zeros(TANGENT)
        delta[6:9] = correction[1]
        told += filter(None, [corrections.update(round((k + 1) * PERIOD_S * 1e9), delta, an_update(*full))])
        x, P = x + correction, after
    return told


@pytest.mark.parametrize("amplitude", [0.0, 1.0, 5.0])
def test_of_white_corrections_nothing_is_said(amplitude: float) -> None:
    assert not any(told_of(seed, amplitude=amplitude) for seed in range(20))


@pytest.mark.parametrize("factor", [-1.0, 0.5, 2.0])
@pytest.mark.parametrize("seed", range(4))
def test_an_accelerometer_of_another_sign_or_scale_is_told(seed: int, factor: float) -> None:
    told = told_of(seed, factor=factor)
    assert told and " s the LiDAR has corrected the velocity by " in told[0]
    assert "the sign, the scale or the axes of the accelerometer" in told[0]


def test_what_was_corrected_before_a_gap_is_forgotten() -> None:
    corrections, known = Corrections(), 1e-6 * np.eye(TANGENT)
    for k in range(9):
        assert corrections.update(k * 10**8, ONE_WAY, an_update(1.01 * known, known)) is None
    corrections.clear()
    assert corrections.update(9 * 10**8, ONE_WAY, an_update(1.01 * known, known)) is None


@pytest.mark.parametrize(("moved", "lever_m", "told"), [(0.0, 0.1, True), (0.1, 0.1, False), (0.1, 0.005, True)])
def test_a_lever_that_is_hardly_known_pushes_to_one_side_too(moved: float, lever_m: float, told: bool) -> None:
    """33 cm/s within a second, of which the lever may have made 11 (1 sigma)."""
    corrections, known = Corrections(), 1e-6 * np.eye(TANGENT)
    found = [
        corrections.update(k * 10**8, ONE_WAY, an_update(1.01 * known, known, moved=moved, lever_m=lever_m)) for k in range(11)
    ]
    assert any(found) == told


@pytest.mark.parametrize(("unmatched", "told"), [(0, 1), (2, 1), (3, 0)])
def test_corrections_that_are_not_taken_up_do_not_add_up(unmatched: int, told: int) -> None:
    """Off the map the estimate stays where the IMU predicts it, and every scan asks for the same correction anew."""
    consistency, known, found = Consistency(LioConfig()), 1e-6 * np.eye(TANGENT), []
    consistency._unmatched = unmatched
    for k in range(20):
        frame: Any = SimpleNamespace(scan=SimpleNamespace(end_ns=k * 10**8), imu=range(10), largest_gap_s=0.01)
        found += consistency._pushes(frame, ONE_WAY, an_update(1.01 * known, known))
    assert len(found) == told and (consistency.contradiction is not None) == bool(told)


def test_what_an_uncertain_mounting_adds_to_the_covariance_is_no_loss_of_it() -> None:
    """The prior with the mounting known, less the posterior with it unknown, would leave nothing of what noise adds up to."""
    consistency = Consistency(LioConfig(extrinsic_estimation="gated"))
    consistency._watch.mounting_borne_out = True
    after = 1e-6 * np.eye(TANGENT)
    after[6:9, 6:9] = 0.02**2 * np.eye(3)
    before, found = after.copy(), []
    before[6:9, 6:9] = 2.0 * after[6:9, 6:9]
    for k in range(20):
        frame: Any = SimpleNamespace(scan=SimpleNamespace(end_ns=k * 10**8), imu=range(10), largest_gap_s=0.01)
        found += consistency._pushes(frame, ONE_WAY, an_update(before, after, lever_m=0.1))
    assert not found


@pytest.mark.parametrize("seed", range(10))
def test_a_sum_is_measured_by_its_covariance_and_what_the_mounting_adds(seed: int) -> None:
    random = np.random.default_rng(seed)
    total, D, root, of_mounting = (random.normal(size=size) for size in (3, (3, 6), (3, 3), (6, 6)))
    C = root @ root.T + D @ of_mounting @ of_mounting.T @ D.T + _FLOOR**2 * np.eye(3)
    found = _deviations(total, root @ root.T, D, of_mounting @ of_mounting.T)
    assert found == pytest.approx(np.sqrt(total @ np.linalg.solve(C, total)))
