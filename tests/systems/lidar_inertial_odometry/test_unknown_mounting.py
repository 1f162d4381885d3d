"""A mounting that is off turns and shifts the path as its Jacobian says, and the covariance covers it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.unknown_mounting import UnknownMounting, mounting_jacobian


def transform(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


def state(T_world_imu: np.ndarray, T_imu_lidar: np.ndarray) -> np.ndarray:
    made = NavState.identity(T_imu_lidar)
    x = made.pack()
    x[:9], x[9:12] = T_world_imu[:3, :3].ravel(), T_world_imu[:3, 3]
    return x


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    T_world_first, T_world_imu, T_imu_lidar = (
        transform(so3.exp(random.normal(size=3)), scale * random.normal(size=3)) for scale in (3.0, 10.0, 0.3)
    )
    return T_world_first, T_world_imu, T_imu_lidar


@given(st.integers(0, 10_000))
def test_the_jacobian_is_that_of_the_path(seed: int) -> None:
    T_world_first, T_world_imu, T_imu_lidar = drawn(seed)
    A = np.linalg.inv(T_world_first) @ T_world_imu
    L = np.linalg.inv(T_imu_lidar) @ A @ T_imu_lidar

    def pose(delta: np.ndarray) -> np.ndarray:
        T = transform(T_imu_lidar[:3, :3] @ so3.exp(delta[:3]), T_imu_lidar[:3, 3] + delta[3:])
        moved = T_world_first @ T @ L @ np.linalg.inv(T)
        turned = so3.log(T_world_imu[:3, :3].T @ moved[:3, :3])
        return np.concatenate([turned, moved[:3, 3] - T_world_imu[:3, 3]])

    step = 1e-5
    numeric = np.stack([(pose(step * e) - pose(-step * e)) / (2.0 * step) for e in np.eye(6)], axis=1)
    analytic = mounting_jacobian(state(T_world_first, T_imu_lidar), state(T_world_imu, T_imu_lidar))
    assert np.allclose(analytic, numeric, atol=1e-6 * max(1.0, float(np.abs(numeric).max())))


def test_a_mounting_that_is_given_widens_nothing() -> None:
    T_world_first, T_world_imu, T_imu_lidar = drawn(0)
    known = UnknownMounting(state(T_world_first, T_imu_lidar), LioConfig())
    assert np.array_equal(known.widened(np.eye(6), state(T_world_imu, T_imu_lidar)), np.eye(6))


@pytest.mark.parametrize("distance", [1.0, 10.0])
def test_half_a_degree_turns_a_straight_path_by_half_a_degree(distance: float) -> None:
    config = LioConfig(extrinsic_estimation="gated", extrinsic_rotation_sigma_deg=0.5, extrinsic_translation_sigma=0.02)
    first, last = state(np.eye(4), np.eye(4)), state(transform(np.eye(3), np.array([distance, 0.0, 0.0])), np.eye(4))
    sigma = np.sqrt(np.diag(UnknownMounting(first, config).widened(np.zeros((6, 6)), last)))
    assert np.allclose(sigma, [0.0, 0.0, 0.0, 0.0, np.deg2rad(0.5) * distance, np.deg2rad(0.5) * distance])
