"""A stereo rig and its IMU, moved by hand before an AprilGrid: `python examples/camera_calibration.py`."""

import numpy as np

import boxplus as bp
from boxplus.manifolds import se3
from boxplus.residuals.inertial.imu_noise import ImuNoise
from boxplus.simulation.cameras.target_session import simulate_target_session
from boxplus.systems.camera_calibration.findings import judge

target = bp.AprilGrid(rows=4, columns=4, tag_size=0.1, spacing=0.3)
left = bp.Pinhole(458.6, 457.3, 367.2, 248.4, bp.RadialTangential(-0.283, 0.074, 2e-4, 1e-5))
right = bp.Pinhole(457.1, 456.0, 375.3, 252.0, bp.RadialTangential(-0.281, 0.072, -1e-4, 2e-5))
T_imu_left = se3.exp([0.02, -0.01, 1.55, 0.05, -0.03, 0.08])
T_left_right = se3.exp([0.01, -0.02, 0.005, 0.11, 0.0, 0.002])
mountings = np.stack([T_imu_left, se3.compose(T_imu_left, T_left_right)])

# Corners with 0.2 px of noise at 5 Hz; the cameras' clock is 4 ms behind that of the IMU.
session = simulate_target_session(
    [left, right], mountings, (752, 480), target, frames=80, rate_hz=5.0, time_offset_s=0.004, seed=1
)
noise = ImuNoise(gyro=1.7e-4, accel=2e-3, gyro_walk=1.9e-5, accel_walk=3e-3)
found = bp.calibrate_cameras(
    session.corners, target, bp.CameraCalibrationConfig(lens="pinhole-radtan", max_views=20), imu=session.imu, noise=noise
)

for camera, truth in enumerate((left, right)):
    adjustment, number = found.of_camera(camera)
    model, sigma = adjustment.rig.models[number], np.sqrt(np.diag(adjustment.covariance)[adjustment.intrinsics(number)])
    print(f"cam{camera}: fx {model.parameters[0]:.2f} ± {sigma[0]:.2f} px, in truth {truth.fx}")
baseline = np.linalg.norm(found.rig.rig.T_body_camera[1, 4:])
print(f"baseline {baseline * 1e3:.2f} mm, in truth {np.linalg.norm(T_left_right[4:]) * 1e3:.2f}")
print(f"clock {found.imu.time_offset_s * 1e3:.2f} ± {np.sqrt(found.imu.covariance[6, 6]) * 1e3:.2f} ms, in truth 4")
print(f"the IMU measures the target as {found.imu.scale:.4f} of its stated size")
print("findings:", [finding.text for finding in judge(found)] or "none")
