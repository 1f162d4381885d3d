"""The scale between LiDAR and accelerometer, and whether its standard deviation covers what a bent path does to it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.systems.lidar_inertial_agreement.lidar_motion import LidarPath
from boxplus.systems.lidar_inertial_agreement.translation import TranslationFit, compare_accelerations, wide_prior
from tests.systems.lidar_inertial_agreement.small_platforms import data, handheld
from tests.systems.lidar_inertial_agreement.test_explained_scans import true_path


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


@pytest.mark.parametrize("length", [0.8, 1.25, 3.28084])
def test_a_wrong_unit_of_lengths_still_shows(length: float) -> None:
    found = fit(0, length=length)
    assert abs(found.slope / length - 1.0) < 0.03
    assert abs(found.slope - 1.0) > 5.0 * found.slope_std
