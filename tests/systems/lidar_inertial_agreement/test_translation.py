"""The scale between LiDAR and accelerometer, and whether its standard deviation covers what a bent path does to it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from boxplus.filtering.nav_state import STANDARD_GRAVITY
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.lidar_path.path import LidarPath
from boxplus.systems.lidar_inertial_agreement.translation import TranslationFit, compare_accelerations, few_groups, wide_prior
from tests.systems.lidar_inertial_agreement.lidar_path.test_explained_scans import true_path
from tests.systems.lidar_inertial_agreement.small_platforms import data, handheld


def fit(seed: int, bend_m: float = 0.0, at: float = 0.5, length: float = 1.0) -> TranslationFit:
    """Of the true path over four seconds, scaled and bent aside for a while."""
    simulation = handheld(seed)
    scans, imu = data(simulation)
    path = true_path(simulation, scans[:40])
    seconds = (path.time_ns - path.time_ns[0]) * 1e-9
    noise = 1e-3 * np.random.default_rng(seed).normal(size=(len(path), 3))
    aside = bend_m * np.exp(-0.5 * ((seconds - at * seconds[-1]) / 0.25) ** 2)[:, None] * [0.8, -0.5, 0.3]
    p = length * path.p_path_lidar + aside + noise
    bent = LidarPath(path.time_ns, path.R_path_lidar, p, path.information, path.segment, path.weak, path.misfit, path.cost, 0)
    found = compare_accelerations(bent, imu, simulation.T_imu_lidar[:3, :3], np.zeros(3), 0.0, wide_prior())
    assert found is not None
    return found


@given(seed=st.integers(0, 3), bend_m=st.floats(0.01, 0.06), at=st.floats(0.1, 0.9))
@settings(max_examples=25, deadline=None)
def test_the_standard_deviation_covers_a_path_that_is_bent_for_a_moment(seed: int, bend_m: float, at: float) -> None:
    found = fit(seed, bend_m, at)
    assert abs(found.slope - 1.0) < 4.0 * found.slope_std + 0.01


@pytest.mark.parametrize("groups", [4, 8, 13, 30, 100])
def test_three_of_a_standard_deviation_from_few_groups_hold_as_often_as_of_a_known_one(groups: int) -> None:
    quantile = stats.t(groups - 1).ppf(stats.norm.cdf(3.0))
    assert 3.0 * few_groups(groups) == pytest.approx(quantile, rel=0.05)


@pytest.mark.parametrize("scan_s", [0.1, 0.0])
def test_a_pose_is_the_mean_of_where_the_lidar_was_during_its_scan(scan_s: float) -> None:
    seconds = np.arange(0.0, 6.0, 0.005)
    time_ns = np.rint(seconds * 1e9).astype(np.int64)
    size, way = np.array([0.3, 0.7, 1.0]) * 0.02, 2.0 * np.pi * np.array([1.1, 0.9, 1.8])  # a walk: sway, and bobbing with steps
    accel = -size * way**2 * np.sin(seconds[:, None] * way) + [0.0, 0.0, STANDARD_GRAVITY]
    at = np.arange(20, 1180, 20)
    means = np.array([np.sin(seconds[k - 10 : k + 11, None] * way).mean(axis=0) for k in at])
    p = size * (means if scan_s else np.sin(seconds[at, None] * way))
    K = len(at)
    information = np.tile(1e7 * np.eye(6), (K, 1, 1))
    information[0] = 0.0
    path = LidarPath(
        time_ns[at], np.tile(np.eye(3), (K, 1, 1)), p, information,
        np.zeros(K, dtype=int), np.zeros(K, dtype=bool), np.zeros(K), np.zeros(K), 0, scan_s,
    )  # fmt: skip
    imu = ImuSamples(time_ns, np.zeros((len(seconds), 3)), accel)
    found = compare_accelerations(path, imu, np.eye(3), np.zeros(3), 0.0, wide_prior())
    assert found is not None and abs(found.slope - 1.0) < 0.01


@pytest.mark.parametrize("length", [0.8, 1.25, 3.28084])
def test_a_wrong_unit_of_lengths_still_shows(length: float) -> None:
    found = fit(0, length=length)
    assert abs(found.slope / length - 1.0) < 0.03
    assert abs(found.slope - 1.0) > 5.0 * found.slope_std
