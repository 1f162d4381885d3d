"""LiDAR-inertial odometry as a ROS 2 node: clouds and IMU messages in, nav_msgs/Odometry out. See docs/ros2.md.

    python ros2_node.py CHECK.bag

CHECK.bag is a recording of ten seconds from the same robot. Topics, layout of the points, times, units and mounting are found
from it, as `boxplus inspect` finds them, so that nothing is guessed while the robot drives.
"""

import functools
import queue
import sys
import threading

import numpy as np

import boxplus as bp
from boxplus.manifolds import quaternion
from boxplus.recordings.bags.bag import scan_from_cloud
from boxplus.recordings.bags.messages import MalformedMessageError, parse_imu
from boxplus.recordings.bags.probe import CLOUD_PARSERS
from boxplus.recordings.imu_units import ACCEL_SCALE, GYRO_SCALE
from boxplus.recordings.recording import Tally


def type_of(info, topic):
    return next(found.type for found in info.topics if found.name == topic)


class LiveOdometry:
    """The odometry behind two callbacks that take serialised messages; needs no ROS, so that recorded messages test it."""

    def __init__(self, info, publish, warn):
        if info.T_imu_lidar is None:
            raise SystemExit("the recording does not say how the LiDAR is mounted on the IMU: record /tf_static, too")
        self.info, self.publish, self.warn = info, publish, warn
        self.parse = CLOUD_PARSERS[type_of(info, info.lidar_topic)]
        self.options, self.tally, self.contradiction = bp.RecordingOptions(), Tally(), None
        self.odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=info.T_imu_lidar.tolist(), threads=2), live=True)

    def on_imu(self, data):
        try:
            stamp_ns, _, gyro, accel = parse_imu(data, "cdr")
        except MalformedMessageError as error:
            return self.warn(f"IMU message left out: {error}")
        gyro = np.array(gyro) * GYRO_SCALE[self.info.gyro_unit]
        accel = np.array(accel) * ACCEL_SCALE[self.info.accel_unit]
        return self._deliver(self.odometry.push_imu(bp.ImuSamples.from_arrays(stamp_ns, gyro, accel)))

    def on_cloud(self, data):
        try:
            scan = scan_from_cloud(self.parse(data, "cdr"), self.info.point_time, self.options, self.tally)
        except MalformedMessageError as error:
            return self.warn(f"cloud left out: {error}")
        return self._deliver(self.odometry.push_scan(scan))

    def _deliver(self, estimates):
        if self.odometry.contradiction != self.contradiction:
            self.contradiction = self.odometry.contradiction
            self.warn(self.contradiction or "LiDAR and IMU agree again")
        for estimate in estimates:
            for sentence in estimate.warnings:
                self.warn(sentence)
            if estimate.status == "lost" or self.contradiction:
                self.warn("the pose is not to be trusted and was not published")  # a gap is better than a wrong pose
            else:
                self.publish(estimate)


def fill(message, estimate):
    """A nav_msgs/Odometry: pose of the IMU in the world, velocity along the IMU's axes, with covariances (position first)."""
    R, state = estimate.state.R_world_imu, estimate.state
    v_imu = R.T @ state.v_world_imu
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(estimate.time_ns), 1_000_000_000)
    message.header.frame_id, message.child_frame_id = "odom", "imu"
    position, rotation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = map(float, state.p_world_imu)
    rotation.w, rotation.x, rotation.y, rotation.z = map(float, quaternion.from_matrix(R))
    linear = message.twist.twist.linear
    linear.x, linear.y, linear.z = map(float, v_imu)
    J = np.zeros((6, 6))  # from (rotation about the IMU's axes, position) to (position, rotation about the world's axes)
    J[:3, 3:], J[3:, :3] = np.eye(3), R
    message.pose.covariance = (J @ estimate.pose_covariance @ J.T).ravel().tolist()
    K = np.hstack([np.cross(np.eye(3), v_imu), np.zeros((3, 3)), R.T])  # v_imu by rotation, position and velocity
    twist = np.diag([0.0, 0, 0, -1, -1, -1])  # −1: not given, the gyroscope has it
    twist[:3, :3] = K @ estimate.covariance[:9, :9] @ K.T
    message.twist.covariance = twist.ravel().tolist()
    return message


def main(path):
    import rclpy
    from nav_msgs.msg import Odometry
    from rclpy.qos import qos_profile_sensor_data
    from rosidl_runtime_py.utilities import get_message

    with bp.open_recording(path) as recording:
        info = recording.info
    rclpy.init()
    node = rclpy.create_node("boxplus_odometry")
    publisher = node.create_publisher(Odometry, "odometry", 10)
    live = LiveOdometry(info, lambda e: publisher.publish(fill(Odometry(), e)), node.get_logger().warning)
    waiting = queue.SimpleQueue()  # what comes while a scan is processed waits here and is not dropped by DDS
    worker = threading.Thread(target=lambda: [callback(data) for callback, data in iter(waiting.get, None)])
    worker.start()
    for topic, callback in ((info.imu_topic, live.on_imu), (info.lidar_topic, live.on_cloud)):
        kind = get_message(type_of(info, topic).replace("/", "/msg/"))
        put = functools.partial(lambda callback, data: waiting.put((callback, data)), callback)
        node.create_subscription(kind, topic, put, qos_profile_sensor_data, raw=True)  # raw: the bytes as they came
    try:
        rclpy.spin(node)
    finally:
        waiting.put(None)
        worker.join()


if __name__ == "__main__":
    main(*sys.argv[1:])
