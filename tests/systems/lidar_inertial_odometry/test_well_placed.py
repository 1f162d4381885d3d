"""Points far away go into the map only where the rotation is known well enough to say where they lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.well_placed import LARGEST_SIGMA_M, NEAR_M, well_placed


def _covariance(degrees: list[float], metres: float = 0.0) -> np.ndarray:
    cov = np.zeros((24, 24))
    cov[:3, :3] = np.diag(np.deg2rad(degrees) ** 2)
    cov[3:6, 3:6] = metres**2 * np.eye(3)
    return cov


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 1.0))
def test_left_out_is_what_samples_of_the_rotation_spread_by_more(seed: int, degrees: float) -> None:
    rng = np.random.default_rng(seed)
    state = replace(NavState.identity(), R_world_imu=so3.exp(rng.normal(size=3)), p_world_imu=rng.normal(size=3) * 100.0)
    p_imu = rng.normal(size=(40, 3)) * [30.0, 30.0, 3.0]
    cov = _covariance([degrees, 0.5 * degrees, 0.1 * degrees])
    turns = rng.multivariate_normal(np.zeros(3), cov[:3, :3], size=4000)
    moved = np.cross(turns[:, None], p_imu[None])  # to first order, in the frame of the IMU
    sigma = np.sqrt((moved**2).sum(axis=2).mean(axis=0))
    p_world = p_imu @ state.R_world_imu.T + state.p_world_imu
    began = state.p_world_imu + np.array([2.0, 0.0, 0.0])
    kept = {tuple(p) for p in well_placed(p_world, state, cov, began)}
    for p, spread in zip(p_world, sigma, strict=True):
        if abs(spread / LARGEST_SIGMA_M - 1.0) > 0.1:
            assert (tuple(p) in kept) == (spread < LARGEST_SIGMA_M)


@pytest.mark.parametrize("metres", [0.0, 50.0])
def test_a_position_that_is_unknown_leaves_nothing_out(metres: float) -> None:
    p_world = np.random.default_rng(0).normal(size=(100, 3)) * 30.0
    assert well_placed(p_world, NavState.identity(), _covariance([0.01] * 3, metres), np.zeros(3)) is p_world


def test_there_may_be_no_points() -> None:
    assert len(well_placed(np.zeros((0, 3)), NavState.identity(), _covariance([1.0] * 3), np.zeros(3))) == 0


@given(st.floats(0.0, 10.0), st.integers(0, 1000))
def test_on_the_way_everything_goes_in(metres: float, seed: int) -> None:
    """Over a bare plain the rotation about the vertical opens, and a map that took in nothing for it ended `lost`."""
    rng = np.random.default_rng(seed)
    p_world, towards = rng.normal(size=(100, 3)) * 30.0, rng.normal(size=3)
    began = towards / np.linalg.norm(towards) * metres
    inserted = well_placed(p_world, NavState.identity(), _covariance([5.0] * 3), began)
    if abs(metres - NEAR_M) > 1e-6:
        assert (inserted is p_world) == (metres > NEAR_M)
