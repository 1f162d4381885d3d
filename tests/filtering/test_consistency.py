"""The filter's covariance against its errors: average NEES over seeded runs with honest noise (docs/lidar_inertial_odometry.md).

Planes known exactly, points with independent noise: whatever the filter claims must then be true. (In odometry the map is made
from the same estimates; what its covariance means there is said in docs/lidar_inertial_odometry.md.)
"""

import numpy as np
import pytest

from boxplus.evaluation.nees import nees, nees_band
from boxplus.filtering.nav_state import TANGENT, NavState, boxminus_into, boxplus_into
from boxplus.filtering.propagation import NODE, propagate_interval
from boxplus.filtering.update_step import map_step, move_covariance
from boxplus.manifolds import so3

RUNS, SCANS, IMU_RATE, SCAN_S = 200, 12, 200.0, 0.1
DENSITY = np.array([2e-3, 2e-2, 1e-3, 1e-2])  # per √Hz
POINTS, SIGMA = 30, 0.05


def _information(x: np.ndarray, s_imu: np.ndarray, normals: np.ndarray, z_noise: np.ndarray, truth: np.ndarray) -> tuple:
    """A, b of points s_imu (IMU frame) that lie, up to noise along the normal, on planes fixed in the world by the truth."""
    R_true, p_true = truth[:9].reshape(3, 3), truth[9:12]
    offsets = np.einsum("ij,ij->i", normals, s_imu @ R_true.T + p_true)
    R, p = x[:9].reshape(3, 3), x[9:12]
    z = np.einsum("ij,ij->i", normals, s_imu @ R.T + p) - offsets + z_noise
    H = np.zeros((len(z), 12))
    H[:, :3], H[:, 3:6] = np.cross(s_imu, normals @ R), normals
    return H.T @ H / SIGMA**2, H.T @ z / SIGMA**2


def _run(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    dt = 1.0 / IMU_RATE
    sigma0 = np.concatenate([np.full(3, 0.02), np.full(3, 0.05), np.full(3, 0.1), np.full(3, 0.01), np.full(3, 0.1)])
    sigma0 = np.concatenate([sigma0, np.full(9, 1e-4)])
    truth = NavState.identity().pack()
    x = np.zeros_like(truth)
    boxplus_into(truth, rng.normal(size=TANGENT) * sigma0, x)
    # The estimate is the mean, the truth is drawn around it: the prior is honest.
    x, truth = truth.copy(), x
    cov = np.diag(sigma0**2)
    steps = round(SCAN_S * IMU_RATE)
    nodes = np.zeros((steps + 4, NODE))
    unused = np.eye(TANGENT)
    for _ in range(SCANS):
        gyro = np.tile(0.5 * rng.normal(size=3), (steps + 1, 1))
        accel = np.tile(rng.normal(size=3) + np.array([0, 0, 9.81]), (steps + 1, 1))
        for k in range(steps):
            # One held input a step, with noise of its own; the biases walk.
            truth[15:18] += rng.normal(size=3) * DENSITY[2] * np.sqrt(dt)
            truth[18:21] += rng.normal(size=3) * DENSITY[3] * np.sqrt(dt)
            gyro_noise, accel_noise = rng.normal(size=(2, 3)) * DENSITY[:2, None] / np.sqrt(dt)
            held = np.stack([gyro[k] + truth[15:18]] * 2), np.stack([accel[k] + truth[18:21]] * 2)
            ends = np.array([0.0, dt])
            for state, noise in ((truth, (0.0, 0.0)), (x, (gyro_noise, accel_noise))):
                P = cov if state is x else unused
                propagate_interval(state, P, ends, held[0] + noise[0], held[1] + noise[1], dt, DENSITY**2, 1.0, DENSITY**2, nodes)
        s_imu = rng.uniform(-8, 8, size=(POINTS, 3))
        normals = rng.normal(size=(POINTS, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        z_noise = SIGMA * rng.normal(size=POINTS)
        prior, cov_prior = x.copy(), cov.copy()
        delta, posterior = np.zeros(TANGENT), np.zeros((TANGENT, TANGENT))
        for _ in range(5):
            A, b = _information(x, s_imu, normals, z_noise, truth)
            assert map_step(x, prior, cov_prior, A, b, delta, posterior)
            boxplus_into(x, delta, x)
        cov = posterior
        move_covariance(cov, delta)
    error = np.zeros(TANGENT)
    boxminus_into(truth, x, error)
    assert np.allclose(so3.log(x[:9].reshape(3, 3).T @ truth[:9].reshape(3, 3)), error[:3])
    return error, cov


@pytest.mark.slow
def test_average_nees_lies_within_the_band() -> None:
    errors, covariances = (np.array(values) for values in zip(*(_run(seed) for seed in range(RUNS)), strict=True))
    for block, dof in ((slice(0, 6), 6), (slice(0, 9), 9), (slice(0, 15), 15)):
        average = nees(errors[:, block], covariances[:, block, block]).mean()
        low, high = nees_band(dof, RUNS)
        assert low <= average <= high, f"{dof} degrees of freedom: {average:.2f} outside {low:.2f} … {high:.2f}"
