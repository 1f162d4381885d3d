"""Corrections that are as white as noise are not spoken of; those that all push to one side are."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.filtering.nav_state import TANGENT
from boxplus.systems.lidar_inertial_odometry.watches.corrections import Corrections

PERIOD_S, ACCEL_NOISE, POINT_NOISE = 0.1, 0.02, 0.01


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
        told += filter(None, [corrections.update(round((k + 1) * PERIOD_S * 1e9), delta, *full)])
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
    corrections = Corrections()
    one_way = np.zeros(TANGENT)
    one_way[6] = 0.1
    known = np.diag(np.full(TANGENT, 1e-6))
    for k in range(9):
        assert corrections.update(k * 10**8, one_way, 1.01 * known, known) is None
    corrections.clear()
    assert corrections.update(9 * 10**8, one_way, 1.01 * known, known) is None
