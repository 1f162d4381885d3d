"""IMU streams for tests, and docs/residuals/imu_preintegration.md written down as they stand: the oracle of the kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus.manifolds import so3
from boxplus.residuals.inertial.imu_noise import ImuNoise

Stream = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]


def random_stream(seed: int, count: int, shortest_ns: int = 3_000_000, longest_ns: int = 40_000_000) -> Stream:
    """Irregular times and violent motion: errors of second order do not hide in it."""
    rng = np.random.default_rng(seed)
    time_ns = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(shortest_ns, longest_ns, count))
    return time_ns, rng.normal(size=(count, 3)), rng.normal(size=(count, 3)) * 5.0


def dense_preintegration(
    stream: Stream, bias_accel: NDArray[np.float64], bias_gyro: NDArray[np.float64], noise: ImuNoise, merged: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """α, R(γ), β, P (15, 15) and J (15, 15) by the dense matrices of docs/residuals/imu_preintegration.md."""
    time_ns, gyro, accel = stream
    alpha, beta, R0 = np.zeros(3), np.zeros(3), np.eye(3)
    J, P = np.eye(15), np.zeros((15, 15))
    for k, dt in enumerate(np.diff(time_ns) * 1e-9):
        w = 0.5 * (gyro[k] + gyro[k + 1]) - bias_gyro
        a0, a1 = accel[k] - bias_accel, accel[k + 1] - bias_accel
        S0, S1 = so3.hat(a0), so3.hat(a1)
        X, Jr, R1 = so3.exp(-w * dt), so3.right_jacobian(w * dt), R0 @ so3.exp(w * dt)
        F_bt = -0.5 * dt * (R0 @ S0 + R1 @ S1 @ X)
        F_ba, F_bg = -0.5 * dt * (R0 + R1), 0.5 * dt**2 * R1 @ S1 @ Jr
        F = np.eye(15)
        F[0:3, 3:6], F[0:3, 6:9], F[0:3, 9:12], F[0:3, 12:] = 0.5 * dt * F_bt, dt * np.eye(3), 0.5 * dt * F_ba, 0.5 * dt * F_bg
        F[3:6, 3:6], F[3:6, 12:] = X, -dt * Jr
        F[6:9, 3:6], F[6:9, 9:12], F[6:9, 12:] = F_bt, F_ba, F_bg
        M = 0.25 * dt**2 * R1 @ S1 @ Jr
        G = np.zeros((15, 18))
        for column, R in ((0, R0), (6, R1)):
            G[0:3, column : column + 3], G[6:9, column : column + 3] = -0.25 * dt**2 * R, -0.5 * dt * R
            G[0:3, column + 3 : column + 6], G[6:9, column + 3 : column + 6] = 0.5 * dt * M, M
            G[3:6, column + 3 : column + 6] = -0.5 * dt * Jr
        G[9:12, 12:15] = G[12:, 15:] = dt * np.eye(3)
        densities = [noise.accel, noise.gyro, noise.accel, noise.gyro, noise.accel_walk, noise.gyro_walk]
        if merged:
            G, densities = np.hstack([G[:, :6] + G[:, 6:12], G[:, 12:]]), densities[2:]
        Q = np.repeat(np.square(densities), 3) / dt
        P, J = F @ P @ F.T + (G * Q) @ G.T, F @ J
        mean = 0.5 * (R0 @ a0 + R1 @ a1)
        alpha, beta, R0 = alpha + beta * dt + 0.5 * mean * dt**2, beta + mean * dt, R1
    return alpha, R0, beta, P, J
