"""KITTI raw folders, small ones made here."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import RecordingError
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.recordings.gnss_source import read_fixes
from boxplus.recordings.kitti import read_times
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.sensors.lidar.scan import Scan

START = np.datetime64("2011-09-26T13:02:25.100000000", "ns")
R_VELO_IMU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
T_VELO_IMU = np.array([-0.8, 0.3, -0.8])


def stamps(first_s: float, step_s: float, count: int) -> str:
    times = START + (np.rint((first_s + step_s * np.arange(count)) * 1e9)).astype("timedelta64[ns]")
    return "\n".join(str(t).replace("T", " ") for t in times) + "\n"


def directions(count: int = 72) -> np.ndarray:
    """Azimuths of one turn in the order they are measured: clockwise from the rear."""
    return np.pi - 2 * np.pi * (np.arange(count) + 0.5) / count


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    folder = tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync"
    velodyne, oxts = folder / "velodyne_points", folder / "oxts"
    (velodyne / "data").mkdir(parents=True)
    (oxts / "data").mkdir(parents=True)
    (velodyne / "timestamps.txt").write_text(stamps(0.05, 0.1, 5))
    (velodyne / "timestamps_start.txt").write_text(stamps(0.0, 0.1, 5))
    (velodyne / "timestamps_end.txt").write_text(stamps(0.1, 0.1, 5))
    azimuth = directions()
    for k in range(5):
        points = np.stack((10 * np.cos(azimuth), 10 * np.sin(azimuth), 0 * azimuth + 1, 0.5 + 0 * azimuth), axis=1)
        points.astype("<f4").tofile(velodyne / "data" / f"{k:010d}.bin")
    (oxts / "timestamps.txt").write_text(stamps(0.0, 0.01, 50))
    for k in range(50):
        row = np.zeros(30)
        row[11:14], row[17:20] = (0.1, 0.2, 9.81), (0.01, 0.02, 0.03)
        (oxts / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, row)))
    rows = f"calib_time: x\nR: {' '.join(map(str, R_VELO_IMU.ravel()))}\nT: {' '.join(map(str, T_VELO_IMU))}\n"
    (folder.parent / "calib_imu_to_velo.txt").write_text(rows)
    return folder


def test_points_get_their_time_from_their_azimuth(drive: Path) -> None:
    with open_recording(drive) as recording:
        events = list(recording)
        assert recording.progress == 1.0 and recording.rejected == {}
    scans = [e for e in events if isinstance(e, Scan)]
    assert len(scans) == 5
    start_ns = START.astype(np.int64)
    expected = np.rint((np.arange(72) + 0.5) / 72 * 1e8)
    np.testing.assert_allclose(scans[2].time_ns - start_ns - 200_000_000, expected, atol=20)
    np.testing.assert_allclose(scans[0].intensity, 0.5)
    imu = [e for e in events if isinstance(e, ImuSamples)]
    assert len(imu) == 50
    np.testing.assert_allclose(imu[7].accel, [[0.1, 0.2, 9.81]])
    np.testing.assert_allclose(imu[7].gyro, [[0.01, 0.02, 0.03]])
    order = [e.end_ns if isinstance(e, Scan) else int(e.time_ns[0]) for e in events]
    assert all(b - a > -2_000_000 for a, b in pairwise(order))


def test_the_calibration_above_the_drive_is_inverted(drive: Path) -> None:
    T_imu_lidar = open_recording(drive).info.T_imu_lidar
    assert T_imu_lidar is not None
    p_imu = np.array([1.0, 2.0, 3.0])
    np.testing.assert_allclose(T_imu_lidar[:3, :3] @ (R_VELO_IMU @ p_imu + T_VELO_IMU) + T_imu_lidar[:3, 3], p_imu, atol=1e-12)


def test_broken_and_missing_files_are_counted(drive: Path) -> None:
    (drive / "velodyne_points" / "data" / "0000000001.bin").write_bytes(b"123")
    (drive / "oxts" / "data" / "0000000003.txt").write_text("1 2 3")
    (drive / "oxts" / "data" / "0000000004.txt").write_text("no numbers")
    (drive / "oxts" / "data" / "0000000005.txt").unlink()
    with open_recording(drive) as recording:
        events = list(recording)
        assert recording.rejected == {
            "messages: scan file is not a multiple of 16 bytes": 1,
            "messages: oxts file without its 30 columns": 1,
            "messages: unreadable oxts file": 1,
        }
        assert any("1 of the 50 times in oxts have no data file" in e.text for e in recording.info.evidence)
    assert sum(isinstance(e, Scan) for e in events) == 4


def test_data_files_without_a_time_are_counted(drive: Path) -> None:
    """Of a copy that was cut; it passed for a shorter drive."""
    for name in ("timestamps.txt", "timestamps_start.txt", "timestamps_end.txt"):
        file = drive / "velodyne_points" / name
        file.write_text("".join(file.read_text().splitlines(keepends=True)[:3]))
    (drive / "oxts" / "timestamps.txt").write_text(stamps(0.0, 0.01, 40))
    texts = [e.text for e in open_recording(drive).info.evidence if e.verdict == "warning"]
    assert any("2 of the 5 data files in velodyne_points have no time" in text for text in texts)
    assert any("10 of the 50 data files in oxts have no time" in text for text in texts)
    assert read_fixes(drive).rejected["data file without a time"] == 10


def test_without_the_ends_of_the_turns_they_are_reconstructed(drive: Path) -> None:
    with open_recording(drive) as recording:
        measured = [e for e in recording if isinstance(e, Scan)]
    (drive / "velodyne_points" / "timestamps_end.txt").unlink()
    with open_recording(drive) as recording:
        found = {e.key: e for e in recording.info.evidence}["point_time_field"]
        assert found.verdict == "warning" and "reconstructed" in found.text and "--point-time-field none" in found.text
        scans = [e for e in recording if isinstance(e, Scan)]
    assert len(scans) == len(measured)
    for scan, other in zip(scans, measured, strict=True):
        np.testing.assert_allclose(scan.time_ns, other.time_ns, atol=20)


def test_a_gap_between_turns_does_not_stretch_them(drive: Path) -> None:
    velodyne = drive / "velodyne_points"
    for end in ("start", "end"):
        (velodyne / f"timestamps_{end}.txt").unlink()
    (velodyne / "timestamps.txt").write_text(stamps(0.05, 0.1, 2) + stamps(1.05, 0.1, 3))
    with open_recording(drive) as recording:
        scans = [e for e in recording if isinstance(e, Scan)]
    assert all(95_000_000 < scan.end_ns - scan.start_ns < 100_000_000 for scan in scans)
    forward = [(scan.start_ns + scan.end_ns) // 2 - int(START.astype(np.int64)) for scan in scans]
    np.testing.assert_allclose(forward, [50e6, 150e6, 1050e6, 1150e6, 1250e6], atol=20)


def test_without_any_time_of_a_point(drive: Path) -> None:
    with open_recording(drive, RecordingOptions(point_time_field="none")) as recording:
        scans = [e for e in recording if isinstance(e, Scan)]
    assert all(scan.start_ns == scan.end_ns for scan in scans)
    velodyne = drive / "velodyne_points"
    (velodyne / "timestamps_start.txt").unlink()
    (velodyne / "timestamps.txt").write_text(stamps(0.05, 0.0, 5))
    with pytest.raises(RecordingError, match=r"two times one after the other.*--point-time-field none"):
        open_recording(drive)


def test_a_start_beyond_the_end(drive: Path) -> None:
    with pytest.raises(RecordingError, match=r"which ends after 0\.500 s – got --start 60 – skip less of it"):
        open_recording(drive, RecordingOptions(start_s=60.0))


def test_wrong_calibration_and_times(drive: Path) -> None:
    (drive.parent / "calib_imu_to_velo.txt").write_text("R: 1 0 0 0 2 0 0 0 1\nT: 0 0 0\n")
    with pytest.raises(RecordingError, match=r"R \(9 numbers, a rotation\)"):
        open_recording(drive)
    (drive / "oxts" / "timestamps.txt").write_text("yesterday\n")
    with pytest.raises(RecordingError, match="lines like 2011-09-26"):
        read_times(drive / "oxts" / "timestamps.txt")
    (drive / "oxts" / "timestamps.txt").unlink()
    with pytest.raises(RecordingError, match=r"the times timestamps.txt – got none"):
        open_recording(drive)
