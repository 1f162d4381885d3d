"""Motion compensation against its formula in NumPy and against exact simulated motion.

Derivation: docs/lidar_inertial_odometry.md, section 3.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from boxplus.filtering.nav_state import TANGENT, NavState
from boxplus.filtering.propagation import N_A, N_P, N_R, N_TIME, N_V, N_W, NODE, propagate_interval
from boxplus.manifolds import so3
from boxplus.sensors.lidar.deskew import deskew_into
from boxplus.simulation import ImuModel, SpinningLidar, simulate

seeds = st.integers(0, 2**32 - 1)


def _reference(points: np.ndarray, time: np.ndarray, nodes: np.ndarray, x_end: NavState) -> np.ndarray:
    """ℓ' = R_Lᵀ (R_kᵀ (R_t (R_L ℓ + p_L) + p_t − p_k) − p_L), point by point."""
    moved = np.zeros((len(points), 3))
    for n, (point, t) in enumerate(zip(points.astype(np.float64), time, strict=True)):
        node = nodes[max(int(np.searchsorted(nodes[:, N_TIME], t, side="right")) - 1, 0)]
        s = t - node[N_TIME]
        R_t = node[N_R:N_P].reshape(3, 3) @ so3.exp(node[N_W:] * s)
        p_t = node[N_P:N_V] + node[N_V:N_A] * s + 0.5 * node[N_A:N_W] * s**2
        p_world = R_t @ (x_end.R_imu_lidar @ point + x_end.p_imu_lidar) + p_t
        p_imu = x_end.R_world_imu.T @ (p_world - x_end.p_world_imu)
        moved[n] = x_end.R_imu_lidar.T @ (p_imu - x_end.p_imu_lidar)
    return moved


@settings(max_examples=30)
@given(seeds, st.sampled_from([0.0, 1.0, 20.0]), st.booleans())
def test_against_the_formula(seed: int, rate: float, in_order: bool) -> None:
    random = np.random.default_rng(seed)
    R, R_L = so3.exp(random.normal(size=(2, 3)))
    x = NavState(R, *random.normal(size=(5, 3)), R_L, random.normal(size=3))
    imu_time = np.arange(-0.003, 0.12, 0.01)
    gyro, accel = rate * random.normal(size=(len(imu_time), 3)), 10.0 * random.normal(size=(len(imu_time), 3))
    packed, nodes = x.pack(), np.zeros((len(imu_time) + 2, NODE))
    count = propagate_interval(packed, np.eye(TANGENT), imu_time, gyro, accel, 0.1, np.ones(4), 1.0, np.ones(4), nodes)
    points = (10.0 * random.normal(size=(60, 3))).astype(np.float32)
    origin_ns = 1_700_000_000_123_456_789
    time_ns = random.integers(-10_000_000, 110_000_000, 60)  # in any order, and a little outside of the scan
    if in_order:
        time_ns.sort()
    out = np.zeros_like(points)
    deskew_into(points, origin_ns + time_ns, origin_ns, nodes, count, packed, out)
    assert np.allclose(out, _reference(points, time_ns * 1e-9, nodes[:count], NavState.unpack(packed)), atol=5e-6)


def test_points_at_the_end_of_the_scan_stay() -> None:
    random = np.random.default_rng(0)
    packed, nodes = NavState.identity().pack(), np.zeros((5, NODE))
    gyro, accel = random.normal(size=(3, 3)), random.normal(size=(3, 3))
    count = propagate_interval(
        packed, np.eye(TANGENT), np.array([0.0, 0.05, 0.1]), gyro, accel, 0.1, np.ones(4), 1.0, np.ones(4), nodes
    )
    points = random.normal(size=(4, 3)).astype(np.float32)
    out = np.zeros_like(points)
    deskew_into(points, np.full(4, 100_000_000), 0, nodes, count, packed, out)
    assert np.allclose(out, points, atol=1e-6)


def test_the_polynomials_turn_as_the_exponential_does() -> None:
    # 1000 deg/s held for 0.1 s, which no sample interrupts: over 100 m, less than half the spacing of float32 (7.6e-6 m) is
    # the bound of the series, the rest is rounding.
    packed, nodes = NavState.identity().pack(), np.zeros((5, NODE))
    gyro, accel = np.tile([10.0, -10.0, 10.2], (2, 1)), np.zeros((2, 3))
    packed[21:24] = 0.0
    count = propagate_interval(
        packed, np.eye(TANGENT), np.array([0.0, 0.1]), gyro, accel, 0.1, np.ones(4), 1.0, np.ones(4), nodes
    )
    assert count == 1
    time_ns = np.arange(0, 100_000_000, 100_000)
    points = np.tile(np.array([[60.0, -80.0, 5.0]], np.float32), (len(time_ns), 1))
    out = np.zeros_like(points)
    deskew_into(points, time_ns, 0, nodes, count, packed, out)
    exact = _reference(points, time_ns * 1e-9, nodes[:count], NavState.unpack(packed))
    assert np.linalg.norm(out - exact, axis=1).max() < 100.0 * 3.4e-8 + 7e-6


def test_without_points_nothing_happens() -> None:
    deskew_into(
        np.zeros((0, 3), np.float32), np.zeros(0, np.int64), 0, np.zeros((1, NODE)), 1, np.zeros(36), np.zeros((0, 3), np.float32)
    )


@pytest.mark.parametrize("scenario", ["walk", "stress_fast", "spin"])
def test_a_moving_scan_becomes_the_rigid_one(scenario: str) -> None:
    lidar = SpinningLidar(channels=4, azimuth_steps=90, range_sigma_m=0.0)
    simulation = simulate(scenario, duration_s=6.0, lidar=lidar, imu=ImuModel().noise_free())
    index = simulation.scan_count - 1
    points, time_ns = simulation.exact_points(index)
    begin_ns, end_ns = simulation.scan_start_ns(index), int(time_ns.max())
    imu = simulation.imu_samples(begin_ns - 10_000_000, end_ns + 10_000_000, 0)
    at_begin, at_end, at_points = (simulation.ground_truth(t) for t in ([begin_ns], [end_ns], time_ns))
    T = simulation.T_imu_lidar
    zero = np.zeros(3)
    gravity = np.array([0.0, 0.0, -9.81])
    x = NavState(
        at_begin.R_world_imu[0], at_begin.p_world_imu[0], at_begin.v_world_imu[0], zero, zero, gravity, T[:3, :3], T[:3, 3]
    )
    packed, nodes = x.pack(), np.zeros((len(imu) + 2, NODE))
    seconds = (imu.time_ns - begin_ns) * 1e-9
    duration = (end_ns - begin_ns) * 1e-9
    count = propagate_interval(
        packed, np.eye(TANGENT), seconds, imu.gyro, imu.accel, duration, np.ones(4), 0.1, np.ones(4), nodes
    )
    out = np.zeros(points.shape, np.float32)
    deskew_into(points.astype(np.float32), time_ns, begin_ns, nodes, count, packed, out)
    world = np.einsum("nij,nj->ni", at_points.R_world_imu, points @ T[:3, :3].T + T[:3, 3]) + at_points.p_world_imu
    rigid = ((world - at_end.p_world_imu[0]) @ at_end.R_world_imu[0] - T[:3, 3]) @ T[:3, :3]
    assert np.linalg.norm(points - rigid, axis=1).max() > 0.05  # there is something to correct
    # Samples 5 ms apart as the mean of two leave far below a millimetre at 20 m.
    assert np.linalg.norm(out - rigid, axis=1).max() < 1e-3
