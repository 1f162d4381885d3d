"""Points on planes whose normals are noisy, and what they say of the pose: the same sums as the filter's, written out."""

from __future__ import annotations

import numpy as np

from boxplus.filtering.nav_state import NavState
from tests.filtering.random_states import random_state

TILT = 0.02  # of the normals [rad]
LEVER_ARM = 7.0


def information(x: NavState, normals: np.ndarray, p_imu: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and b (pose only) of points at `p_imu` on planes with `normals` (world), residuals `z`, unit weights of 1 cm."""
    C = normals @ x.R_world_imu
    H = np.hstack([np.cross(p_imu, C), normals])
    A, b = np.zeros((12, 12)), np.zeros(12)
    A[:6, :6], b[:6] = 1e4 * H.T @ H, 1e4 * H.T @ z
    return A, b


def noise(x: NavState, normals: np.ndarray, p_imu: np.ndarray, tilt: float = TILT) -> np.ndarray:
    """N of the same points: what normals that are off by `tilt` about each axis in the plane contribute by themselves."""
    # [θ, p] moves a point by p_imu × (Rᵀ g) + g along a tilt g; tilts of both axes together are tilt² (I − u uᵀ).
    lever = np.cross(p_imu[:, None, :], x.R_world_imu[None, :, :]).transpose(0, 2, 1)
    rows = np.concatenate([lever, np.broadcast_to(np.eye(3), lever.shape)], axis=1)
    across = np.eye(3) - normals[:, :, None] * normals[:, None, :]
    total: np.ndarray = 1e4 * tilt**2 * np.einsum("nij,njk,nlk->il", rows, across, rows, optimize=True)
    return total


def tilted(random: np.random.Generator, normals: np.ndarray, tilt: float = TILT) -> np.ndarray:
    noisy = normals + tilt * random.normal(size=normals.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    return noisy


def tube(seed: int, axis: np.ndarray, count: int = 400) -> tuple[NavState, np.ndarray, np.ndarray]:
    """Points on the four walls of a tube along `axis` (world), seen from within."""
    random = np.random.default_rng(seed)
    x = random_state(random)
    _, _, frame = np.linalg.svd(axis[None, :])
    across, up = frame[1], frame[2]
    side = random.integers(4, size=count)
    normals = np.where((side % 2 == 0)[:, None], across, up) * np.where(side < 2, 1.0, -1.0)[:, None]
    other = np.where((side % 2 == 0)[:, None], up, across)
    along = random.uniform(-12.0, 12.0, (count, 1))
    p_world = 2.0 * normals + random.uniform(-2.0, 2.0, (count, 1)) * other + along * axis
    return x, normals, p_world @ x.R_world_imu


def unit_vector(seed: int) -> np.ndarray:
    axis = np.random.default_rng(seed).normal(size=3)
    return axis / np.linalg.norm(axis)
