"""A gap of all data, or of the scans alone: nothing is integrated across it, and it is said."""

from __future__ import annotations

import numpy as np
import pytest

from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.estimate import Estimate
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry
from tests.systems.lidar_inertial_odometry.simulated_runs import SPARSE

HOUR_NS = 3_600_000_000_000


def _later(event: Scan | ImuSamples, shift_ns: int) -> Scan | ImuSamples:
    if isinstance(event, ImuSamples):
        return ImuSamples(event.time_ns + shift_ns, event.gyro, event.accel)
    times = event.time_ns + shift_ns
    return Scan(event.p_lidar, times, event.intensity, event.start_ns + shift_ns, event.end_ns + shift_ns, event.rejected)


def _run(events: list[Scan | ImuSamples], T_imu_lidar: np.ndarray) -> tuple[LidarInertialOdometry, list[Estimate]]:
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=T_imu_lidar.tolist()))
    estimates: list[Estimate] = []
    for event in events:
        estimates += odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
    return odometry, estimates + odometry.flush()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["everything for ten hours", "the scans for seven seconds"])
def test_after_a_long_gap_it_starts_anew_and_says_so(kind: str) -> None:
    simulation = simulate("walk", 3, duration_s=16.0, lidar=SPARSE)
    begin = simulation.start_ns
    if kind.startswith("everything"):
        first = [e for e in simulation.events() if (e.time_ns[-1] - begin) * 1e-9 < 4.0]
        events = first + [_later(e, 10 * HOUR_NS) for e in simulation.events() if (e.time_ns[0] - begin) * 1e-9 > 5.0]
    else:
        inside = lambda e: isinstance(e, Scan) and 4.0 < (e.start_ns - begin) * 1e-9 < 11.0  # noqa: E731
        events = [e for e in simulation.events() if not inside(e)]
    odometry, estimates = _run(events, simulation.T_imu_lidar)
    gaps = [i for i, e in enumerate(estimates) if any("where the platform went meanwhile is not known" in w for w in e.warnings)]
    assert len(gaps) == 1
    before, after = estimates[gaps[0] - 1], estimates[gaps[0]]
    assert (after.time_ns - before.time_ns) * 1e-9 > 5.0
    assert after.status == "lost"
    assert odometry.contradiction is not None
    assert "run the parts of the recording separately" in odometry.contradiction
    # No integration across the gap: it goes on at the last position, at walking speed, and never claims to know it.
    p = np.array([e.state.p_world_imu for e in estimates])
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() < 0.5
    for estimate in estimates[gaps[0] :]:
        sigma = np.sqrt(estimate.pose_covariance.diagonal())
        assert np.allclose(sigma[:3], np.pi, rtol=0.01) and np.allclose(sigma[3:], 1e4, rtol=0.01)
    assert np.sqrt(before.pose_covariance.diagonal()[3:]).max() < 0.1
    # Within the second part it is followed like any other.
    part = estimates[gaps[0] :]
    assert len(part) > 30
    shift = 10 * HOUR_NS if kind.startswith("everything") else 0
    truth = simulation.ground_truth(np.array([e.time_ns - shift for e in part])).p_world_imu
    way = np.linalg.norm(p[gaps[0] + 1 :] - p[gaps[0]], axis=1)
    assert np.allclose(way, np.linalg.norm(truth[1:] - truth[0], axis=1), atol=0.1)
