"""IMU-rate prediction between scans."""

import numpy as np

from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import simulate
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry


def test_prediction_runs_ahead_of_the_scans_and_leaves_the_filter_alone() -> None:
    simulation = simulate("walk", seed=3, duration_s=4.0)
    config = LioConfig(T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar)))
    asked, silent = LidarInertialOdometry(config), LidarInertialOdometry(config)
    assert asked.predict() is None
    estimates, others, predictions = [], [], []
    for event in simulation.events():
        if isinstance(event, Scan):
            estimates += asked.push_scan(event)
            others += silent.push_scan(event)
            continue
        estimates += asked.push_imu(event)
        others += silent.push_imu(event)
        prediction = asked.predict()
        if prediction is not None:
            assert prediction.time_ns == event.time_ns[-1]
            predictions.append(prediction)
    assert len(predictions) > 20
    assert all(np.array_equal(a.state.pack(), b.state.pack()) for a, b in zip(estimates, others, strict=True))
    # Against the truth, in the world that the first estimate defines.
    truth = simulation.ground_truth(np.array([estimates[0].time_ns]))
    R_world_truth = estimates[0].state.R_world_imu @ truth.R_world_imu[0].T
    for prediction in predictions[::5]:
        now = simulation.ground_truth(np.array([prediction.time_ns]))
        p_expected = R_world_truth @ (now.p_world_imu[0] - truth.p_world_imu[0]) + estimates[0].state.p_world_imu
        assert np.linalg.norm(prediction.state.p_world_imu - p_expected) < 0.1
        turned = so3.boxminus(prediction.state.R_world_imu, R_world_truth @ now.R_world_imu[0])
        assert np.degrees(np.linalg.norm(turned)) < 1.0
        assert np.linalg.eigvalsh(prediction.covariance).min() > 0


def test_prediction_widens_with_time() -> None:
    simulation = simulate("walk", seed=3, duration_s=3.0)
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=tuple(map(tuple, simulation.T_imu_lidar))))
    last = None
    for event in simulation.events():
        ready = odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event)
        last = ready[-1] if ready else last
    prediction = odometry.predict()
    assert last is not None and prediction is not None
    if prediction.time_ns > last.time_ns:
        assert np.trace(prediction.covariance[3:6, 3:6]) > np.trace(last.covariance[3:6, 3:6])
    else:
        assert np.array_equal(prediction.covariance, last.covariance)
