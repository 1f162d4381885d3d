"""IMU propagation of the navigation state and its covariance (docs/lidar_inertial_odometry.md, sections 2 and 3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from boxplus._jit import kernel
from boxplus.filtering.nav_state import BA, BW, RL, TANGENT, G, P, R, V
from boxplus.manifolds.so3 import exp_into, right_jacobian_into

# A node of the trajectory inside a scan: time [s], R (9), p, v, a_world, ω.
NODE = 22
N_TIME, N_R, N_P, N_V, N_A, N_W = 0, 1, 10, 13, 16, 19
FOLLOWED = 18  # components of the state that change by themselves: all but the mounting


@kernel
def propagate_step(
    x: NDArray[np.float64],
    cov: NDArray[np.float64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    dt: float,
    density: NDArray[np.float64],
    node: NDArray[np.float64],
) -> None:
    """One step with the input held over `dt`; `x` (36,) and `cov` (24, 24) are replaced.

    `density` (4,): power spectral densities of gyro noise, accelerometer noise, gyro bias walk, accelerometer bias walk
    (squares of the values per √Hz), so the result does not depend on the IMU rate. `node` (22,) receives the state at the
    head of the step and the input in world terms; its time is the caller's.
    """
    wx, wy, wz = gyro[0] - x[BW], gyro[1] - x[BW + 1], gyro[2] - x[BW + 2]
    ax, ay, az = accel[0] - x[BA], accel[1] - x[BA + 1], accel[2] - x[BA + 2]
    R0 = np.empty((3, 3))
    for i in range(9):
        R0.flat[i] = x[R + i]
        node[N_R + i] = x[R + i]
    for i in range(3):
        node[N_P + i] = x[P + i]
        node[N_V + i] = x[V + i]
        node[N_A + i] = R0[i, 0] * ax + R0[i, 1] * ay + R0[i, 2] * az + x[G + i]
    node[N_W], node[N_W + 1], node[N_W + 2] = wx, wy, wz

    step = np.empty((3, 3))
    Jr = np.empty((3, 3))
    exp_into(wx * dt, wy * dt, wz * dt, step)
    right_jacobian_into(wx * dt, wy * dt, wz * dt, Jr)
    for i in range(3):
        for j in range(3):
            x[R + 3 * i + j] = R0[i, 0] * step[0, j] + R0[i, 1] * step[1, j] + R0[i, 2] * step[2, j]
        x[P + i] += x[V + i] * dt + 0.5 * node[N_A + i] * dt * dt
        x[V + i] += node[N_A + i] * dt

    Ra = np.empty((3, 3))  # R [a]x
    for i in range(3):
        Ra[i, 0] = R0[i, 1] * az - R0[i, 2] * ay
        Ra[i, 1] = R0[i, 2] * ax - R0[i, 0] * az
        Ra[i, 2] = R0[i, 0] * ay - R0[i, 1] * ax

    # cov <- F cov Fᵀ: to the columns of cov, then of covᵀ.
    _through_step(step, Jr, R0, Ra, dt, cov)
    _through_step(step, Jr, R0, Ra, dt, cov.T)

    # + F_w Q F_wᵀ with Q = density / dt. R Rᵀ = I keeps the accelerometer's blocks diagonal.
    qw, qa = density[0] * dt, density[1] * dt
    for i in range(3):
        for j in range(3):
            cov[i, j] += qw * (Jr[i, 0] * Jr[j, 0] + Jr[i, 1] * Jr[j, 1] + Jr[i, 2] * Jr[j, 2])
        cov[3 + i, 3 + i] += 0.25 * qa * dt * dt
        cov[3 + i, 6 + i] += 0.5 * qa * dt
        cov[6 + i, 3 + i] += 0.5 * qa * dt
        cov[6 + i, 6 + i] += qa
        cov[9 + i, 9 + i] += density[2] * dt
        cov[12 + i, 12 + i] += density[3] * dt
    for i in range(TANGENT):
        for j in range(i):
            mean = 0.5 * (cov[i, j] + cov[j, i])
            cov[i, j] = mean
            cov[j, i] = mean


@kernel
def _through_step(
    step: NDArray[np.float64],
    Jr: NDArray[np.float64],
    R0: NDArray[np.float64],
    Ra: NDArray[np.float64],
    dt: float,
    M: NDArray[np.float64],
) -> None:
    """M <- F M for M (18 or more, n). F differs from the identity in its first nine rows only."""
    head = np.empty(9)
    for c in range(M.shape[1]):
        for i in range(3):
            theta, v, p = 0.0, 0.0, 0.0
            for k in range(3):
                d_theta, d_bw, d_ba = M[k, c], M[9 + k, c], M[12 + k, c]
                theta += step[k, i] * d_theta - Jr[i, k] * dt * d_bw
                push = -(Ra[i, k] * d_theta + R0[i, k] * d_ba)
                v += push * dt
                p += 0.5 * push * dt * dt
            d_p, d_v, d_g = M[3 + i, c], M[6 + i, c], M[15 + i, c]
            head[i] = theta
            head[3 + i] = d_p + d_v * dt + p + 0.5 * d_g * dt * dt
            head[6 + i] = d_v + v + d_g * dt
        for i in range(9):
            M[i, c] = head[i]


@kernel
def propagate_interval(
    x: NDArray[np.float64],
    cov: NDArray[np.float64],
    imu_time: NDArray[np.float64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
    duration: float,
    density: NDArray[np.float64],
    max_gap: float,
    gap_density: NDArray[np.float64],
    nodes: NDArray[np.float64],
) -> int:
    """Propagate over (0, duration] through the IMU samples around it; returns the number of nodes written.

    Times are seconds from the last posterior. Over each interval between two samples their mean is the input. Before the
    first and after the last sample the nearest one is held. Across a gap longer than `max_gap` nothing is known of the
    input: the velocity and the last turn rate are held and the noise is `gap_density`.

    Args:
        imu_time: (n,), increasing, n ≥ 1; gyro, accel: (n, 3).
        nodes: (at least n + 2, 22), receives one node a step.
    """
    n = imu_time.shape[0]
    mean_gyro = np.empty(3)
    mean_accel = np.empty(3)
    now = 0.0
    count = 0
    upper = 0
    while now < duration or count == 0:  # a scan of one instant has a node too
        while upper < n and imu_time[upper] <= now:
            upper += 1
        end = duration if upper >= n else min(duration, imu_time[upper])
        first = max(upper - 1, 0)
        second = min(upper, n - 1)
        following = end if upper >= n else imu_time[upper]
        blind = end - now > max_gap or (upper > 0 and following - imu_time[upper - 1] > max_gap)
        for i in range(3):
            mean_gyro[i] = 0.5 * (gyro[first, i] + gyro[second, i])
            mean_accel[i] = 0.5 * (accel[first, i] + accel[second, i])
        if blind:
            for i in range(3):
                mean_gyro[i] = gyro[first, i]
                mean_accel[i] = x[BA + i] - (x[R + i] * x[G] + x[R + 3 + i] * x[G + 1] + x[R + 6 + i] * x[G + 2])
        nodes[count, N_TIME] = now
        propagate_step(x, cov, mean_gyro, mean_accel, end - now, gap_density if blind else density, nodes[count])
        now = end
        count += 1
    _orthonormalise(x)
    return count


@kernel
def _orthonormalise(x: NDArray[np.float64]) -> None:
    """One step of R <- R (3 I − RᵀR) / 2: removes the rounding that thousands of products leave in the rotation."""
    M = np.empty((3, 3))
    new = np.empty(9)
    for offset in (R, RL):
        for i in range(3):
            for j in range(3):
                dot = 0.0
                for k in range(3):
                    dot += x[offset + 3 * k + i] * x[offset + 3 * k + j]
                M[i, j] = (1.5 if i == j else 0.0) - 0.5 * dot
        for i in range(3):
            for j in range(3):
                new[3 * i + j] = x[offset + 3 * i] * M[0, j] + x[offset + 3 * i + 1] * M[1, j] + x[offset + 3 * i + 2] * M[2, j]
        for i in range(9):
            x[offset + i] = new[i]


@kernel
def transition(nodes: NDArray[np.float64], duration: float, gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Φ (18, 18): how errors of pose, velocity, biases and gravity go on from the first of the nodes (n, 22) to `duration` [s].

    Args:
        nodes: as `propagate_interval` has written them; gravity: (3,) of the state.
    """
    Phi, Jr, step = np.eye(FOLLOWED), np.empty((3, 3)), np.empty((3, 3))
    R0, Ra = np.empty((3, 3)), np.empty((3, 3))
    for n in range(nodes.shape[0]):
        node = nodes[n]
        dt = (nodes[n + 1, N_TIME] if n + 1 < nodes.shape[0] else duration) - node[N_TIME]
        exp_into(node[N_W] * dt, node[N_W + 1] * dt, node[N_W + 2] * dt, step)
        right_jacobian_into(node[N_W] * dt, node[N_W + 1] * dt, node[N_W + 2] * dt, Jr)
        fx, fy, fz = node[N_A] - gravity[0], node[N_A + 1] - gravity[1], node[N_A + 2] - gravity[2]
        for j in range(3):
            for i in range(3):
                R0[i, j] = node[N_R + 3 * i + j]
            # R [a]ₓ = [R a]ₓ R, and R a is what the accelerometer feels along the world's axes
            Ra[0, j] = fy * node[N_R + 6 + j] - fz * node[N_R + 3 + j]
            Ra[1, j] = fz * node[N_R + j] - fx * node[N_R + 6 + j]
            Ra[2, j] = fx * node[N_R + 3 + j] - fy * node[N_R + j]
        _through_step(step, Jr, R0, Ra, dt, Phi)
    return Phi
