"""LiDAR-inertial odometry on arrays: push IMU samples and scans as they arrive, get estimates with their covariance.

The arrays come from the simulator here, so that every estimate can be compared with the exact pose. With sensors of your
own, fill them from your driver: times are absolute nanoseconds (int64), every point has its own.
"""

import numpy as np

import boxplus as bp

simulation = bp.simulate("walk", duration_s=8.0)
odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=simulation.T_imu_lidar.tolist()))
estimates = []


def show(estimate: bp.Estimate) -> None:
    estimates.append(estimate)
    seconds = (estimate.time_ns - simulation.start_ns) * 1e-9
    sigma_mm = 1e3 * np.sqrt(np.diag(estimate.pose_covariance)[3:])  # order: rotation (IMU axes), position (world axes)
    p = estimate.state.p_world_imu
    if len(estimates) % 10 == 1:
        print(f"{seconds:5.2f} s  {estimate.status:4}  p = {np.round(p, 3)} m  sigma = {np.round(sigma_mm, 1)} mm")


for event in simulation:
    if isinstance(event, bp.Scan):
        # What a driver has: (N, 3) points in the LiDAR frame [m] and the time of each [ns].
        scan = bp.Scan.from_arrays(event.p_lidar, event.time_ns, event.intensity, min_range=0.5)
        ready = odometry.push_scan(scan)
    else:
        # (N, 3) angular velocity [rad/s] and specific force [m/s²], IMU frame, and their times [ns].
        ready = odometry.push_imu(bp.ImuSamples.from_arrays(event.time_ns, event.gyro, event.accel))
    for estimate in ready:
        show(estimate)
for estimate in odometry.flush():
    show(estimate)

# The world frame of the odometry begins at the first estimate; the exact motion says where that was.
truth = simulation.ground_truth(np.array([estimate.time_ns for estimate in estimates]))
R_0, p_0 = truth.R_world_imu[0], truth.p_world_imu[0]
first = estimates[0].state
p_estimated = np.array([estimate.state.p_world_imu for estimate in estimates])
p_exact = (truth.p_world_imu - p_0) @ R_0 @ first.R_world_imu.T + first.p_world_imu
error = np.linalg.norm(p_estimated - p_exact, axis=1)
print(f"{len(estimates)} estimates over {np.linalg.norm(np.diff(p_exact, axis=0), axis=1).sum():.1f} m")
print(f"position error: {error.mean() * 1e3:.1f} mm in the mean, {error.max() * 1e3:.1f} mm at most")
print(f"start: {odometry.start.text}" if odometry.start else "no start was found")
