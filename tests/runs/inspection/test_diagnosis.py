"""The data doctor finds what is wrong, and only that."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import typer
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from boxplus.cli.inspect import inspect
from boxplus.manifolds import so3
from boxplus.recordings import Evidence, RecordingOptions
from boxplus.recordings.stream_checks import check_rate
from boxplus.runs.inspection.diagnosis import Diagnosis, diagnose
from boxplus.runs.inspection.imu_checks import check_rest, check_saturation, first_second, quiet_stretch
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.systems.lidar_inertial_agreement.rest import Rest
from tests.bags import PERIOD_NS, START_NS, Content, write_bag

IMU_FROM_LIDAR = Rotation.from_euler("xyz", [0.5, -0.4, 1.2])
AMPLITUDE, SPEED, PHASE = np.array([0.25, 0.2, 0.3]), np.array([2.1, 2.7, 1.7]), np.array([0.0, 1.0, 2.0])


@dataclass
class Room(Content):
    """A sensor that swings through a room of 8 x 6 x 3 m, resting for the first second."""

    scans: int = 45
    points: int = 1500
    imu_rate: int = 200
    late_s: float = 0.0
    gyro_factor: float = 1.0
    accel_factor: float = 1.0
    lost_imu: tuple[int, int] = (0, 0)
    lost_scans: tuple[int, int] = (0, 0)
    not_finite: int = 0
    swing: float = 1.0

    def moving(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smooth time that stands still for the first second."""
        t = np.maximum(time_s - 1.0, 0.0)
        return t - np.arctan(3 * t) / 3

    def attitude(self, time_s: NDArray[np.float64]) -> Rotation:
        phase = np.outer(self.moving(time_s), SPEED)
        return Rotation.from_rotvec(self.swing * AMPLITUDE * (np.sin(phase + PHASE) - np.sin(PHASE)))

    def position(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([0.5, 0.4, 0.3]) * (1 - np.cos(np.outer(self.moving(time_s), [3.0, 2.5, 3.5])))

    def p_lidar(self, index: int) -> NDArray[np.float32]:
        rng = np.random.default_rng(index)
        time_s = (self.times_ns(index) - START_NS) * 1e-9 + self.late_s
        azimuth = np.linspace(np.pi, -9 * np.pi, self.points)
        elevation = np.radians(rng.uniform(-35, 35, self.points))
        ray = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), axis=1)
        world = (self.attitude(time_s) * IMU_FROM_LIDAR).apply(ray)
        walls = np.where(world > 0, np.array([4.0, 3.0, 1.6]), np.array([-4.0, -3.0, -1.4]))
        distance = ((walls - self.position(time_s)) / world).min(axis=1) + rng.normal(size=self.points) * 0.005
        points = (ray * distance[:, None]).astype(np.float32)
        points[: self.not_finite] = np.nan
        return points

    def imu(self, stamp_ns: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        time_s = (stamp_ns - START_NS) * 1e-9 + np.array([-1e-3, 0.0, 1e-3])
        R, p = self.attitude(time_s), self.position(time_s)
        rng = np.random.default_rng(stamp_ns % 2**32)
        gyro = (R[0].inv() * R[2]).as_rotvec() / 2e-3 + rng.normal(size=3) * 1e-3
        accel = R[1].inv().apply((p[2] - 2 * p[1] + p[0]) / 1e-6 + [0.0, 0.0, 9.81]) + rng.normal(size=3) * 0.02
        return tuple(self.gyro_factor * gyro), tuple(self.accel_factor * accel)

    def keeps(self, topic: str, index: int) -> bool:
        first, stop = self.lost_imu if topic == "/imu" else self.lost_scans
        return not first <= index < stop


def examine(folder: Path, content: Content, options: RecordingOptions | None = None) -> tuple[Diagnosis, dict[str, Evidence]]:
    diagnosis = diagnose(write_bag(folder, "ros1", content), options)
    return diagnosis, {e.key: e for e in diagnosis.evidence}


def extrinsic(R: Rotation) -> list[tuple[str, str, NDArray[np.float64]]]:
    return [("imu", "lidar", np.concatenate((np.zeros(3), R.as_quat())))]


def test_a_healthy_recording(tmp_path: Path) -> None:
    diagnosis, found = examine(tmp_path, Room(transforms=extrinsic(IMU_FROM_LIDAR)))
    assert diagnosis.verdict == "ok", [e for e in diagnosis.evidence if e.verdict != "ok"]
    assert found["lidar_rate"].value == "10.0 Hz" and found["imu_rate"].value == "200.0 Hz"
    assert found["lidar_gaps"].value == found["imu_gaps"].value == "0"
    assert found["up_axis"].value == "+z" and found["gravity_sign"].value == "right"
    assert 0.8 < float(found["standstill"].value.split()[0]) < 1.6
    assert abs(float(found["gyro_noise"].value.split()[0]) - 1e-3) < 3e-4
    assert abs(float(found["accel_noise"].value.split()[0]) - 0.02) < 6e-3
    assert "rad/s is right" in found["gyro_scale"].text
    assert diagnosis.R_imu_lidar is not None and diagnosis.time_offset_s is not None
    assert np.degrees(np.linalg.norm(so3.log(diagnosis.R_imu_lidar.T @ IMU_FROM_LIDAR.as_matrix()))) < 2.0
    assert abs(diagnosis.time_offset_s) < 0.01


def test_a_wrong_extrinsic_and_its_inverse(tmp_path: Path) -> None:
    diagnosis, found = examine(tmp_path, Room(transforms=extrinsic(IMU_FROM_LIDAR.inv())))
    assert diagnosis.verdict == "error" and found["R_imu_lidar"].verdict == "error"
    assert "its inverse fits" in found["R_imu_lidar"].text


def test_without_an_extrinsic_it_is_estimated(tmp_path: Path) -> None:
    _, found = examine(tmp_path, Room())
    assert found["T_imu_lidar"].verdict == "warning" and found["R_imu_lidar"].verdict == "ok"
    assert found["R_imu_lidar"].text.startswith("estimate R_imu_lidar = [")


@pytest.mark.slow
def test_a_mounting_can_be_given(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Room())
    T = np.eye(4)
    T[:3, :3] = IMU_FROM_LIDAR.as_matrix()
    for T_imu_lidar, verdict in ((T, "ok"), (np.linalg.inv(T), "error")):
        found = {e.key: e for e in diagnose(path, T_imu_lidar=T_imu_lidar).evidence}
        assert (found["T_imu_lidar"].value, found["R_imu_lidar"].verdict) == ("given", verdict)


@pytest.mark.slow
def test_a_clock_offset(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", Room(late_s=0.05))
    found = {e.key: e for e in diagnose(path).evidence}
    assert found["time_offset"].verdict == "error" and "synchronise the clocks" in found["time_offset"].text
    named = float(found["time_offset"].text.split("--lidar-time-offset ")[1].split(";")[0])
    assert abs(named - 0.05) < 0.008
    # What it says, given back, makes it agree; half of it makes it ask for the rest.
    found = {e.key: e for e in diagnose(path, RecordingOptions(lidar_time_offset_s=named)).evidence}
    assert found["time_offset"].verdict == "ok" and abs(float(found["time_offset"].value.split()[0])) < 3.0
    found = {e.key: e for e in diagnose(path, RecordingOptions(lidar_time_offset_s=0.02)).evidence}
    assert abs(float(found["time_offset"].text.split("that makes ")[1].split()[0]) - 0.05) < 0.008


def test_degrees_are_found(tmp_path: Path) -> None:
    room = Room(gyro_factor=180 / np.pi, swing=0.4)
    diagnosis, found = examine(tmp_path, room)
    assert found["gyro_unit"].value == "rad/s"
    assert diagnosis.verdict == "error" and "--gyro-unit deg/s" in found["gyro_scale"].text
    (tmp_path / "again").mkdir()
    _, found = examine(tmp_path / "again", room, RecordingOptions(gyro_unit="deg/s"))
    assert found["gyro_unit"].value == "deg/s" and found["gyro_scale"].verdict == "ok"


def test_radians_that_are_declared_degrees_are_an_error_that_names_the_unit(tmp_path: Path) -> None:
    """Its factor, 1/57, must not pass for a sound recording."""
    diagnosis, found = examine(tmp_path, Room(transforms=extrinsic(IMU_FROM_LIDAR)), RecordingOptions(gyro_unit="deg/s"))
    assert diagnosis.verdict == "error" and found["gyro_unit"].value == "deg/s"
    assert found["gyro_scale"].verdict == "error" and "--gyro-unit rad/s" in found["gyro_scale"].text


def test_a_slow_swing_says_nothing_of_the_scale_of_the_gyroscope(tmp_path: Path) -> None:
    """At less than 2 deg/s its bias and noise are as large as what it measures."""
    room = Room(transforms=extrinsic(IMU_FROM_LIDAR), swing=0.03)
    rates = np.linalg.norm([room.imu(START_NS + k * 5_000_000)[0] for k in range(200, 900)], axis=1)
    assert np.degrees(np.sqrt(np.mean(rates**2))) < 2.0
    diagnosis, found = examine(tmp_path, room)
    assert diagnosis.verdict == "ok", [e for e in diagnosis.evidence if e.verdict != "ok"]
    assert "gyro_scale" not in found or found["gyro_scale"].verdict == "ok"


def test_gravity_with_the_wrong_sign(tmp_path: Path) -> None:
    diagnosis, found = examine(tmp_path, Room(accel_factor=-1.0))
    assert diagnosis.verdict == "error"
    assert found["gravity_sign"].value == "inverted" and "negate the accelerations" in found["gravity_sign"].text
    assert found["up_axis"].value == "-z" and found["up_axis"].verdict == "warning"


def test_gaps_and_missing_returns(tmp_path: Path) -> None:
    _, found = examine(tmp_path, Room(lost_imu=(300, 340), lost_scans=(30, 33), not_finite=900))
    assert found["imu_gaps"].verdict == found["lidar_gaps"].verdict == "warning"
    assert "longest 0.205 s" in found["imu_gaps"].text and "about 40 messages are missing" in found["imu_gaps"].text
    assert "longest 0.400 s" in found["lidar_gaps"].text and "about 3 messages" in found["lidar_gaps"].text
    assert found["points_not_finite"].verdict == "warning" and found["points_not_finite"].value == "60.00 %"


def test_what_cannot_be_opened_becomes_a_finding(tmp_path: Path) -> None:
    diagnosis = diagnose(tmp_path / "nothing.bag")
    assert [e.verdict for e in diagnosis.evidence] == ["error"]


def test_a_lidar_alone(tmp_path: Path) -> None:
    diagnosis = diagnose(write_bag(tmp_path, "ros1", Content(with_imu=False)))
    found = {evidence.key: evidence for evidence in diagnosis.evidence}
    assert found["imu_topic"].verdict == "warning" and "odometry of the LiDAR alone" in found["imu_topic"].text
    assert "lidar_rate" in found and "imu_rate" not in found


def test_order_of_times() -> None:
    time_ns = np.array([0, 10, 20, 15, 25, 25, 35, 45], np.int64) * 1_000_000
    found = {e.key: e for e in check_rate("imu", time_ns, 3.0)}
    assert found["imu_order"].value == "2 out of order"
    assert "1 steps backwards (largest 0.005 s), 1 repeated times" in found["imu_order"].text
    assert check_rate("imu", np.zeros(5, np.int64), 3.0)[0].verdict == "error"


def test_saturation() -> None:
    time_ns = np.arange(400) * 5_000_000
    gyro = 8.0 * np.sin(np.arange(400) * 0.05)[:, None] * np.ones(3)
    still = np.tile([0.0, 0.0, 9.81], (400, 1))
    assert check_saturation(ImuSamples(time_ns, gyro, still)).verdict == "ok"
    clipped = check_saturation(ImuSamples(time_ns, np.clip(gyro, -4.36, 4.36), still))
    assert clipped.verdict == "warning" and "gyroscope x saturated at 4.36 rad/s" in clipped.text and "4.36" in clipped.text


def steady(rate_hz: int) -> ImuSamples:
    time_ns = np.arange(10 * rate_hz) * (10**9 // rate_hz)
    return ImuSamples(time_ns, np.tile([0.0, 0.0, 0.05], (len(time_ns), 1)), np.tile([0.0, 0.0, 9.81], (len(time_ns), 1)))


def test_a_smooth_drive_of_a_slow_imu_is_no_standstill() -> None:
    assert quiet_stretch(steady(10)) is None
    assert check_rest(steady(10), first_second(steady(10)), quiet=False, rest=None)[0].value == "none"


@pytest.mark.parametrize(("rest", "value", "words"), [
    (None, "10.0 s", "by the IMU alone"),
    (Rest(True, True, np.empty((0, 3)), 0.001, 0.0), "10.0 s", "the LiDAR moves with 0.1 cm/s"),
    (Rest(False, True, np.empty((0, 3)), 1.2, 0.0), "none", "the LiDAR moves with 120.0 cm/s: a steady motion"),
])  # fmt: skip
def test_a_quiet_imu_rests_if_the_lidar_does(rest: Rest | None, value: str, words: str) -> None:
    imu = steady(200)
    stretch = quiet_stretch(imu)
    assert stretch is not None
    found = check_rest(imu, stretch, quiet=True, rest=rest)[0]
    assert found.value == value and words in found.text
    assert found.verdict == "ok"  # the odometry starts at rest as in motion


@pytest.fixture
def app() -> typer.Typer:
    app = typer.Typer()
    app.command()(inspect)
    return app


def test_command(tmp_path: Path, app: typer.Typer) -> None:
    path = write_bag(tmp_path, "mcap", Content())
    result = CliRunner().invoke(app, [str(path), "--json", "-o", str(tmp_path / "out" / "findings.json")])
    assert result.exit_code == 0, result.output
    printed = json.loads(result.stdout)
    assert printed == json.loads((tmp_path / "out" / "findings.json").read_text())
    assert printed["verdict"] == "warning" and printed["duration_s"] > 0.5
    assert {e["key"] for e in printed["evidence"]} >= {"lidar_topic", "imu_topic", "point_time_unit", "gyro_unit", "accel_unit"}
    result = CliRunner().invoke(app, [str(path)])
    assert result.exit_code == 0 and "warnings, 0 errors" in result.stdout and "/points" in result.stdout


def test_command_exits_with_one_on_errors(tmp_path: Path, app: typer.Typer) -> None:
    torn = tmp_path / "torn.bag"
    torn.write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    result = CliRunner().invoke(app, [str(torn)])
    assert result.exit_code == 1 and "cannot be read" in result.stdout
    path = write_bag(tmp_path, "ros1", Content())
    result = CliRunner().invoke(app, [str(path), "--point-time-unit", "hours"])
    assert result.exit_code == 2


@pytest.mark.parametrize(
    ("name", "scans", "imu_samples", "unit", "accel_unit"),
    [
        ("v103_velodyne.bag", 219, 4401, "s", "m/s2"),
        ("mh05_ouster_ros2", 249, 5001, "ns", "m/s2"),
        ("v201_livox.bag", 149, 3001, "ns", "g"),
        ("kitti_0926_0005_ros2", 154, 154, "s", "m/s2"),
    ],
)
def test_shared_recordings(shared_data: Path, name: str, scans: int, imu_samples: int, unit: str, accel_unit: str) -> None:
    from boxplus.recordings import open_recording
    from boxplus.sensors.lidar.scan import Scan

    with open_recording(shared_data / "recordings" / name) as recording:
        events = list(recording)
        info = recording.info
    assert sum(isinstance(e, Scan) for e in events) == scans
    assert sum(len(e) for e in events if isinstance(e, ImuSamples)) == imu_samples
    assert (info.point_time.unit, info.point_time.reference) == (unit, "scan_start")
    assert (info.gyro_unit, info.accel_unit) == ("rad/s", accel_unit)
    norms = np.concatenate([np.linalg.norm(e.accel, axis=1) for e in events if isinstance(e, ImuSamples)])
    assert 9.5 < np.median(norms) < 10.2
    assert info.message_count == scans + imu_samples and info.duration_s > scans * PERIOD_NS * 1e-9 - 0.2
