"""Every layout in every container comes back as it was written."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan
from tests.bags import CONTAINERS, LAYOUTS, PERIOD_NS, START_NS, Content, write_bag


def read(path: Path, options: RecordingOptions | None = None) -> tuple[list[Scan], list[ImuSamples]]:
    with open_recording(path, options) as recording:
        events = list(recording)
    return [e for e in events if isinstance(e, Scan)], [e for e in events if isinstance(e, ImuSamples)]


@pytest.mark.parametrize("container", CONTAINERS)
@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_and_times_come_back(tmp_path: Path, layout: str, container: str) -> None:
    content = Content(layout=layout)
    scans, imu = read(write_bag(tmp_path, container, content))
    assert len(scans) == content.scans
    for index, scan in enumerate(scans):
        np.testing.assert_array_equal(scan.p_lidar, content.p_lidar(index))
        # float32 seconds resolve 7 ns within a scan, float64 seconds since 1970 resolve 240 ns, after rounding twice.
        np.testing.assert_allclose(scan.time_ns, content.times_ns(index), rtol=0, atol=500)
    assert sum(len(block) for block in imu) == content.scans * PERIOD_NS // 10_000_000 + 1
    np.testing.assert_array_equal(imu[0].accel[0], content.accel)
    assert imu[0].time_ns[0] == START_NS


def test_events_keep_the_order_of_the_file(tmp_path: Path) -> None:
    content = Content()
    with open_recording(write_bag(tmp_path, "mcap", content)) as recording:
        received = [e.start_ns + content.lidar_delay_ns if isinstance(e, Scan) else int(e.time_ns[-1]) for e in recording]
    assert received == sorted(received)


def test_counts_progress_and_second_pass(tmp_path: Path) -> None:
    with open_recording(write_bag(tmp_path, "ros1"), RecordingOptions(min_range=5.0)) as recording:
        progress = []
        for _ in recording:
            progress.append(recording.progress)
        first = recording.rejected
        kept = sum(len(e) for e in recording if isinstance(e, Scan))
    assert progress == sorted(progress) and 0.0 < progress[0] < 1.0 and recording.progress == 1.0
    assert first == recording.rejected
    content = Content()
    near = sum(int((np.linalg.norm(content.p_lidar(k), axis=1) < 5.0).sum()) for k in range(content.scans))
    assert first == {"points: nearer than min_range": near}
    assert kept == content.scans * content.points - near


def test_start_and_duration_cut_the_stream(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(scans=20))
    options = RecordingOptions(start_s=0.5, duration_s=1.0)
    scans, imu = read(path, options)
    with open_recording(path, options) as recording:
        assert abs(recording.info.message_count - len(scans) - sum(map(len, imu))) < 20
    assert 9 <= len(scans) <= 11
    assert all(START_NS + 500_000_000 <= block.time_ns[0] <= START_NS + 1_500_000_000 for block in imu)


@pytest.mark.parametrize("container", ["ros1", "sqlite3"])
def test_a_start_beyond_the_end(tmp_path: Path, container: str) -> None:
    path = write_bag(tmp_path, container)
    with open_recording(path) as recording:
        duration_s = recording.info.duration_s
    with pytest.raises(RecordingError, match=rf"which ends after {duration_s:.3f} s – got --start 60 – skip less of it"):
        open_recording(path, RecordingOptions(start_s=60.0))


@pytest.mark.parametrize("container", ["mcap", "sqlite3"])
def test_ros2_files_without_metadata(tmp_path: Path, container: str) -> None:
    folder = write_bag(tmp_path, container)
    expected, _ = read(folder)
    (folder / "metadata.yaml").unlink()
    for path in (folder, next(folder.iterdir())):
        scans, _ = read(path)
        assert [len(s) for s in scans] == [len(s) for s in expected]


def test_extrinsic_from_static_transforms(tmp_path: Path) -> None:
    q_xyzw = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_quat()
    base_from_imu = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    base_from_lidar = np.concatenate(([1.0, 0.0, 0.5], q_xyzw))
    content = Content(transforms=[("base", "imu", base_from_imu), ("base", "lidar", base_from_lidar)])
    for container in CONTAINERS:
        folder = tmp_path / container
        folder.mkdir()
        with open_recording(write_bag(folder, container, content)) as recording:
            T_imu_lidar = recording.info.T_imu_lidar
            assert T_imu_lidar is not None and "static transforms" in recording.info.T_imu_lidar_source
            np.testing.assert_allclose(T_imu_lidar[:3, :3], Rotation.from_quat(q_xyzw).as_matrix(), atol=1e-12)
            np.testing.assert_allclose(T_imu_lidar[:3, 3], [0.9, -0.2, 0.2], atol=1e-12)


def test_without_transforms_the_extrinsic_is_unknown(tmp_path: Path) -> None:
    with open_recording(write_bag(tmp_path, "ros1")) as recording:
        assert recording.info.T_imu_lidar is None
        found = {e.key: e for e in recording.info.evidence}["T_imu_lidar"]
    assert found.verdict == "warning" and "--T-imu-lidar" in found.text


def test_units_are_converted(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(accel=(0.0, 0.6, 0.8), gyro=(10.0, 0.0, 0.0)))
    _, imu = read(path, RecordingOptions(gyro_unit="deg/s"))
    np.testing.assert_allclose(imu[0].accel[0], [0.0, 0.6 * 9.80665, 0.8 * 9.80665])
    np.testing.assert_allclose(imu[0].gyro[0], [np.radians(10.0), 0.0, 0.0])


def test_several_topics_are_refused_and_decided(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(extra_topics={"/other": "ouster"}))
    with pytest.raises(AmbiguityError, match=r"one LiDAR topic.*/other.*/points.*--lidar-topic"):
        open_recording(path)
    scans, _ = read(path, RecordingOptions(lidar_topic="/other"))
    assert len(scans) == 6
    with pytest.raises(RecordingError, match=r"on /none – got topics .*/points.* – choose another --lidar-topic"):
        open_recording(path, RecordingOptions(lidar_topic="/none"))


def test_the_only_topic_with_point_times_is_chosen(tmp_path: Path) -> None:
    content = Content(extra_topics={"/registered": "velodyne"}, layout="ouster")
    path = write_bag(tmp_path, "ros1", content)
    with open_recording(path, RecordingOptions(point_time_field="t")) as recording:
        assert recording.info.lidar_topic == "/points"


def test_no_point_times(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap", Content(drop_fields=("time",)))
    with pytest.raises(
        RecordingError, match=r"a time for every point .* – got a cloud with the fields x, y, z, intensity, ring – "
    ):
        open_recording(path)
    scans, _ = read(path, RecordingOptions(point_time_field="none"))
    assert all((scan.time_ns == Content().stamp_ns(index)).all() for index, scan in enumerate(scans))


def test_constant_point_times(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(static_time=True))
    with pytest.raises(RecordingError, match="times in the field 'time' that differ from point to point – got the same value 0"):
        open_recording(path)


@pytest.mark.parametrize("container", CONTAINERS)
def test_no_imu(tmp_path: Path, container: str) -> None:
    with open_recording(write_bag(tmp_path, container, Content(with_imu=False))) as recording:
        events = list(recording)
        said = {evidence.key: evidence for evidence in recording.info.evidence}
    assert recording.info.imu_topic == "" and recording.info.message_count == len(events) == Content().scans
    assert all(isinstance(event, Scan) for event in events)
    assert said["imu_topic"].verdict == "warning" and "the recording holds none" in said["imu_topic"].text
    assert not {"T_imu_lidar", "gyro_unit", "accel_unit", "clocks"} & set(said)


def test_an_imu_can_be_left_out(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "mcap")
    with open_recording(path, RecordingOptions(imu_topic="none")) as recording:
        assert all(isinstance(event, Scan) for event in recording)
        assert recording.progress == 1.0
        said = {evidence.key: evidence for evidence in recording.info.evidence}
    assert said["imu_topic"].verdict == "ok" and "left out, as asked for" in said["imu_topic"].text


def test_early_reception_is_ambiguous(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(lidar_delay_ns=5_000_000))
    with pytest.raises(AmbiguityError, match=r"0.005 s after their stamps.*--point-time-reference scan_start"):
        open_recording(path)
    scans, _ = read(path, RecordingOptions(point_time_reference="scan_end"))
    assert abs(scans[3].end_ns - Content().stamp_ns(3)) < 100
    scans, _ = read(path, RecordingOptions(point_time_reference="scan_start"))
    assert scans[3].start_ns == Content().stamp_ns(3)


def test_gravity_missing_from_the_accelerometer(tmp_path: Path) -> None:
    with pytest.raises(AmbiguityError, match=r"median \|acceleration\|.*got 0.01 .*--accel-unit"):
        open_recording(write_bag(tmp_path, "ros1", Content(accel=(0.01, 0.0, 0.0))))


def test_gyro_too_fast_for_radians(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Content(gyro=(0.0, 0.0, 100.0)))
    with open_recording(path) as recording:
        assert recording.info.gyro_unit == "deg/s"
        block = next(event for event in recording if isinstance(event, ImuSamples))
        np.testing.assert_allclose(block.gyro[:, 2], np.radians(100.0))


@pytest.mark.parametrize("name", ["missing.bag", "notes.txt"])
def test_wrong_paths(tmp_path: Path, name: str) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(RecordingError, match=r"expected a .* – got .*" + name.replace(".", r"\.")):
        open_recording(tmp_path / name)


def test_a_folder_without_recordings(tmp_path: Path) -> None:
    (tmp_path / "flight.bag").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"a folder with .* – got .* with flight.bag – .* of ROS 1 bags give one file"):
        open_recording(tmp_path)


class UnstampedContent(Content):
    def written_stamp_ns(self, index: int) -> int:
        return 0


class OtherClockContent(Content):
    def written_stamp_ns(self, index: int) -> int:
        return self.stamp_ns(index) - 1_000_000_000_000


def test_stamps_that_stand_still(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"stamps on /points that go on .* – got the same stamp 0.000 s on the first 6 messages"
    ):
        open_recording(write_bag(tmp_path, "ros1", UnstampedContent()))


def test_different_clocks_are_an_error(tmp_path: Path) -> None:
    with open_recording(write_bag(tmp_path, "ros1", OtherClockContent())) as recording:
        found = {e.key: e for e in recording.info.evidence}["clocks"]
    assert found.verdict == "error" and "stamped by different clocks" in found.text


class WildImuContent(Content):
    def imu(self, stamp_ns: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        count = (stamp_ns - START_NS) // 10_000_000
        gyro = {40: (1e300, 0.0, 0.0), 41: (float("nan"), 0.0, 0.0)}.get(count, (0.0, 0.0, 0.0))
        return gyro, self.accel


def test_values_beyond_any_sensor_are_dropped_and_nan_is_passed_on(tmp_path: Path) -> None:
    with open_recording(write_bag(tmp_path, "ros1", WildImuContent())) as recording:
        gyro = np.concatenate([e.gyro for e in recording if isinstance(e, ImuSamples)])
        assert recording.rejected == {"messages: IMU values beyond any sensor": 1}
    assert len(gyro) == 60 and np.isnan(gyro).any(axis=1).sum() == 1


def test_the_lidar_can_be_shifted_to_the_clock_of_the_imu(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1")
    with open_recording(path) as recording:
        before = list(recording)
    with open_recording(path, RecordingOptions(lidar_time_offset_s=-0.05)) as recording:
        for _ in range(2):
            after = list(recording)
        assert ("lidar_time_offset", "-50.0 ms") in [(e.key, e.value) for e in recording.info.evidence]
    assert len(before) == len(after)
    for one, other in zip(before, after, strict=True):
        shift = -50_000_000 if isinstance(one, Scan) else 0
        np.testing.assert_array_equal(one.time_ns + shift, other.time_ns)
        if isinstance(one, Scan) and isinstance(other, Scan):
            assert (one.start_ns + shift, one.end_ns + shift) == (other.start_ns, other.end_ns)
            np.testing.assert_array_equal(one.p_lidar, other.p_lidar)


def test_an_imu_whose_messages_arrive_ten_at_a_time(tmp_path: Path) -> None:
    """All but the last of ten have waited; the LiDAR's messages have not."""
    with open_recording(write_bag(tmp_path, "ros1", Content(scans=20, imu_burst=10))) as recording:
        said = {evidence.key: evidence for evidence in recording.info.evidence}
    assert said["point_time_reference"].value == "scan_start" and said["clocks"].verdict == "ok"


def test_static_transforms_that_disagree_are_told(tmp_path: Path) -> None:
    first = np.array([0.1, 0.2, 0.3, 0.0, 0.0, 0.0, 1.0])
    content = Content(transforms=[("imu", "lidar", first), ("imu", "lidar", first + np.array([0.3, 0, 0, 0, 0, 0, 0]))])
    with open_recording(write_bag(tmp_path, "mcap", content)) as recording:
        assert recording.info.T_imu_lidar is not None and recording.info.T_imu_lidar[0, 3] == 0.4
        found = {e.key: e for e in recording.info.evidence}["T_imu_lidar"]
    assert found.verdict == "warning" and "0.300 m from what the others say" in found.text and "--T-imu-lidar" in found.text


@pytest.mark.parametrize("topic", ["/points", "/imu"])
@pytest.mark.parametrize("container", CONTAINERS)
def test_sensors_that_share_a_topic_are_refused(tmp_path: Path, container: str, topic: str) -> None:
    content = Content(scans=8, frames={topic: ("first", "second")})
    with pytest.raises(
        RecordingError, match=rf"one sensor on {topic} – got .* in turn, in the frames 'first', 'second' – record"
    ):
        open_recording(write_bag(tmp_path, container, content))
