"""Scans seconds apart, laid upon each other: they find a drift that single scans do not show, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.long_baseline import Drift, LongBaseline

PERIOD_NS, BASELINE_S = 100_000_000, 1.25
SIGMA_M = 0.01
SMALL = np.diag(np.repeat([1e-6, 1e-5], 3) ** 2)


def surfaces(random: np.random.Generator, count: int, half: tuple[float, float, float]) -> np.ndarray:
    """Points (count, 3) on the sides of a box about the origin; a side farther away than 20 m is open."""
    points = random.uniform(-1.0, 1.0, (count, 3)) * np.minimum(half, 12.0)
    closed = [axis for axis in range(3) if half[axis] < 20.0]
    axes = random.choice(closed, count)
    points[np.arange(count), axes] = random.choice((-1.0, 1.0), count) * np.array(half)[axes]
    return points + random.normal(0.0, SIGMA_M, points.shape)


def drive(drift: np.ndarray, half: tuple[float, float, float] = (5.0, 4.0, 2.0), *, seed: int = 0) -> list[Drift]:
    """A platform on its way through a box for six seconds, placed wrongly by drift (6,) a second."""
    random = np.random.default_rng(seed)
    baseline, found, covariance = LongBaseline(LioConfig(threads=1)), [], np.zeros((6, 6))
    for scan in range(60):
        t = scan * 0.1
        R, p = so3.exp(np.array([0.0, 0.0, 0.3 * t])), np.array([0.2 * t, 0.1 * np.sin(t), 0.02 * t])
        p_lidar = ((surfaces(random, 900, half) - p) @ R).astype(np.float32)
        x = NavState.identity().pack()
        R_placed, p_placed = R @ so3.exp(drift[:3] * t), p + drift[3:] * t
        x[:9], x[9:12] = R_placed.ravel(), p_placed
        covariance = covariance + SMALL
        result = baseline.add(scan * PERIOD_NS, x, covariance, p_lidar, p_lidar @ R_placed.T + p_placed)
        found += [result] if result is not None else []
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_scans_where_they_were_seen_fit_each_other(seed: int) -> None:
    found = drive(np.zeros(6), seed=seed)
    assert len(found) == 4
    for drift in found:
        assert not drift.text
        assert np.sqrt(drift.excess[3:, 3:].trace()) < SIGMA_M


@pytest.mark.parametrize("axis", range(6))
def test_a_drift_is_told_and_covered(axis: int) -> None:
    """1 degree or 8 cm in a baseline, less in a scan than the noise of a point."""
    drift = np.zeros(6)
    drift[axis] = np.deg2rad(0.8) if axis < 3 else 0.064
    found = drive(drift, seed=axis)
    assert len(found) == 4
    for last in found:
        assert "1.25 s apart do not fit each other" in last.text
        # A tilt that grows while the platform turns changes its axis; the others are what they were made.
        if axis >= 2:
            assert np.sqrt(last.excess[axis, axis]) > 0.5 * drift[axis] * BASELINE_S


def test_nothing_is_said_along_what_the_old_scans_do_not_determine() -> None:
    """Along a corridor without an end, drift is nobody's to see; across it, it is."""
    corridor = (1000.0, 3.0, 2.0)
    for drift in drive(np.array([0.0, 0.0, 0.0, 0.05, 0.0, 0.0]), corridor):
        assert not drift.text
        assert np.sqrt(drift.excess[3, 3]) < SIGMA_M
    assert all(drift.text for drift in drive(np.array([0.0, 0.0, 0.0, 0.05, 0.08, 0.0]), corridor))


def test_no_baseline_has_passed() -> None:
    baseline, x = LongBaseline(LioConfig(threads=1)), NavState.identity().pack()
    points = surfaces(np.random.default_rng(0), 900, (5.0, 4.0, 2.0))
    for scan in range(16):
        assert baseline.add(scan * PERIOD_NS, x, np.zeros((6, 6)), points.astype(np.float32), points) is None
