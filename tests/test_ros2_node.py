"""The ROS 2 node of the examples with the messages of a recording: the same callbacks and bytes, a stand-in for rclpy."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

import boxplus as bp
from boxplus.manifolds import quaternion
from boxplus.simulation import SpinningLidar, simulate, write_recording

SCRIPT = Path(__file__).resolve().parents[1] / "examples" / "ros2_node.py"


@pytest.fixture(scope="module")
def node() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ros2_node", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    simulation = simulate("walk", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=500))
    return write_recording(simulation, tmp_path_factory.mktemp("robot") / "check")


def messages(bag: Path) -> list[tuple[str, bytes]]:
    """Topic and serialised message, in the order of arrival."""
    with AnyReader([bag]) as reader:
        return [(connection.topic, bytes(data)) for connection, _, data in reader.messages()]


@pytest.fixture(scope="module")
def offline(bag: Path) -> list[bp.Estimate]:
    """What the same odometry says about the recording."""
    with bp.open_recording(bag) as recording:
        assert recording.info.T_imu_lidar is not None
        odometry = bp.LidarInertialOdometry(bp.LioConfig(T_imu_lidar=recording.info.T_imu_lidar.tolist(), threads=2))
        return [
            estimate
            for event in recording
            for estimate in (odometry.push_scan(event) if isinstance(event, bp.Scan) else odometry.push_imu(event))
        ]


def blank_message() -> Any:
    """What a nav_msgs/Odometry has."""
    vector = SimpleNamespace
    return vector(
        header=vector(stamp=vector(sec=0, nanosec=0), frame_id=""),
        child_frame_id="",
        pose=vector(pose=vector(position=vector(), orientation=vector()), covariance=None),
        twist=vector(twist=vector(linear=vector(), angular=vector()), covariance=None),
    )


def test_the_node_publishes_what_the_odometry_says_of_the_recording(
    node: ModuleType, bag: Path, offline: list[bp.Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    published: list[Any] = []
    warned: list[str] = []
    callbacks: dict[str, Any] = {}

    def subscribe(kind: str, topic: str, callback: Any, qos: str, *, raw: bool) -> None:
        assert raw and qos == "sensor data"
        assert kind == {"/points": "sensor_msgs/msg/PointCloud2", "/imu": "sensor_msgs/msg/Imu"}.get(topic, kind)
        callbacks[topic] = callback

    def spin(_: Any) -> None:
        for topic, data in messages(bag):
            if topic in callbacks:
                callbacks[topic](data)

    ros_node = SimpleNamespace(
        create_publisher=lambda *_: SimpleNamespace(publish=published.append),
        create_subscription=subscribe,
        get_logger=lambda: SimpleNamespace(warning=warned.append),
    )
    stand_ins: dict[str, dict[str, Any]] = {
        "rclpy": {"init": lambda: None, "create_node": lambda _: ros_node, "spin": spin},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "nav_msgs.msg": {"Odometry": blank_message},
        "rosidl_runtime_py.utilities": {"get_message": lambda kind: kind},
    }
    for name, members in stand_ins.items():
        for parent in (name.split(".")[0], name):
            monkeypatch.setitem(sys.modules, parent, sys.modules.get(parent) or ModuleType(parent))
        vars(sys.modules[name]).update(members)

    node.main(str(bag))

    assert len(callbacks) == 2 and not warned
    assert len(published) == len(offline) > 15
    for message, estimate in zip(published, offline, strict=True):
        assert message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec == estimate.time_ns
        position, q = message.pose.pose.position, message.pose.pose.orientation
        np.testing.assert_array_equal([position.x, position.y, position.z], estimate.state.p_world_imu)
        np.testing.assert_allclose(quaternion.to_matrix([q.w, q.x, q.y, q.z]), estimate.state.R_world_imu, atol=1e-12)


def test_covariances_of_the_message_are_those_of_moved_states(node: ModuleType, offline: list[bp.Estimate]) -> None:
    """Against samples: errors drawn in the estimate's tangent, measured as the message defines its axes."""
    estimate = offline[-1]
    message = node.fill(blank_message(), estimate)
    rng = np.random.default_rng(0)
    scale = 1e-3  # small steps: the covariance is that of the linearised error
    errors = scale * rng.multivariate_normal(np.zeros(6), estimate.pose_covariance, 20_000, method="cholesky")
    R = estimate.state.R_world_imu
    turned = bp.SO3.boxplus(np.tile(R.ravel(), (len(errors), 1)), errors[:, :3]).reshape(-1, 3, 3)
    about_world = bp.SO3.boxminus((turned @ R.T).reshape(-1, 9), np.eye(3).ravel())
    sampled = np.cov(np.hstack([errors[:, 3:], about_world]).T) / scale**2
    told = np.array(message.pose.covariance).reshape(6, 6)
    sigma = np.sqrt(np.diag(told))
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma), told / np.outer(sigma, sigma), atol=0.05)
    errors = scale * rng.multivariate_normal(np.zeros(9), estimate.covariance[:9, :9], 20_000, method="cholesky")
    turned = bp.SO3.boxplus(np.tile(R.ravel(), (len(errors), 1)), errors[:, :3]).reshape(-1, 3, 3)
    v_imu = np.einsum("nji,nj->ni", turned, estimate.state.v_world_imu + errors[:, 6:])
    sampled = np.cov(v_imu.T) / scale**2
    told = np.array(message.twist.covariance).reshape(6, 6)
    sigma = np.sqrt(np.diag(told)[:3])
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma), told[:3, :3] / np.outer(sigma, sigma), atol=0.05)
    assert np.array_equal(told[3:, 3:], -np.eye(3))


def test_broken_messages_and_doubtful_poses_are_not_published(node: ModuleType, bag: Path) -> None:
    published: list[Any] = []
    warned: list[str] = []
    with bp.open_recording(bag) as recording:
        live = node.LiveOdometry(recording.info, published.append, warned.append)
    live.on_imu(b"\0\1\0\0")
    live.on_cloud(b"\0\1\0\0\0\0")
    assert [sentence.split(":")[0] for sentence in warned] == ["IMU message left out", "cloud left out"]
    lost = SimpleNamespace(status="lost", warnings=("too few points",))
    live._deliver([lost])
    assert not published and warned[2:] == ["too few points", "the pose is not to be trusted and was not published"]


def test_a_recording_without_a_mounting_is_refused(node: ModuleType, bag: Path) -> None:
    with bp.open_recording(bag) as recording:
        recording.info.T_imu_lidar = None
        with pytest.raises(SystemExit, match="record /tf_static"):
            node.LiveOdometry(recording.info, print, print)
