"""KITTI raw drives as recordings of cameras, small ones made here by the layout of the development kit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import RecordingError
from boxplus.manifolds import so3
from boxplus.recordings.cameras.open import has_cameras_only, open_camera_recording
from boxplus.sensors.images.camera_image import CameraImage

START = np.datetime64("2011-09-26T13:02:25.100000000", "ns")
RNG = np.random.default_rng(0)
TAKEN, RECTIFIED = (24, 12), (20, 10)
K = np.array([[14.0, 0.0, 11.5], [0.0, 13.0, 5.5], [0.0, 0.0, 1.0]])
D = np.array([-0.3, 0.1, 1e-3, -1e-3, 0.02])
R_RECT = so3.exp([0.01, -0.02, 0.03])
R_1, T_1 = so3.exp([0.02, 0.01, -0.01]), np.array([-0.54, 0.003, -0.002])
P_1 = np.hstack([K, K @ np.array([[-0.54], [0.0], [0.0]])])
R_CAM_VELO, T_CAM_VELO = so3.exp([1.2, -1.2, 1.2]), np.array([0.01, -0.08, -0.27])
R_VELO_IMU, T_VELO_IMU = so3.exp([0.01, 0.0, 0.02]), np.array([-0.81, 0.32, -0.8])


def row(name: str, values: object) -> str:
    return f"{name}: {' '.join(repr(float(value)) for value in np.ravel(values))}\n"


def stamps(step_s: float, count: int) -> str:
    return "".join(f"{str(START + np.timedelta64(round(k * step_s * 1e9), 'ns')).replace('T', ' ')}\n" for k in range(count))


def make(folder: Path, size: tuple[int, int], *, oxts_hz: float | None = 100.0) -> Path:
    drive = folder / "2011_09_26" / "2011_09_26_drive_0005"
    for camera in range(2):
        data = drive / f"image_0{camera}" / "data"
        data.mkdir(parents=True)
        (data.parent / "timestamps.txt").write_text(stamps(0.1, 4))
        for k in range(4):
            pixels = RNG.integers(0, 255, size[0] * size[1], dtype=np.uint8)
            (data / f"{k:010d}.png").write_bytes(f"P5 {size[0]} {size[1]} 255\n".encode() + pixels.tobytes())
    if oxts_hz is not None:
        (drive / "oxts" / "data").mkdir(parents=True)
        (drive / "oxts" / "timestamps.txt").write_text(stamps(1.0 / oxts_hz, 40))
        for k in range(40):
            values = np.zeros(30)
            values[11:14], values[17:20] = (0.1, 0.2, 9.81), (0.01, 0.02, 0.03)
            (drive / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, values)))
    cameras = "calib_time: 09-Jan-2012 13:57:47\n"
    for number, (R, T, P) in (("00", (np.eye(3), np.zeros(3), P_1 * [1, 1, 1, 0])), ("01", (R_1, T_1, P_1))):
        cameras += row(f"S_{number}", TAKEN) + row(f"K_{number}", K) + row(f"D_{number}", D)
        cameras += row(f"R_{number}", R) + row(f"T_{number}", T)
        cameras += row(f"S_rect_{number}", RECTIFIED) + row(f"R_rect_{number}", R_RECT) + row(f"P_rect_{number}", P)
    (drive.parent / "calib_cam_to_cam.txt").write_text(cameras)
    (drive.parent / "calib_velo_to_cam.txt").write_text(row("R", R_CAM_VELO) + row("T", T_CAM_VELO))
    (drive.parent / "calib_imu_to_velo.txt").write_text(row("R", R_VELO_IMU) + row("T", T_VELO_IMU))
    return drive


def in_camera_0(p_imu: np.ndarray) -> np.ndarray:
    return (p_imu @ R_VELO_IMU.T + T_VELO_IMU) @ R_CAM_VELO.T + T_CAM_VELO


@pytest.mark.parametrize("size", [RECTIFIED, TAKEN])
def test_points_of_the_imu_appear_where_the_files_say(tmp_path: Path, size: tuple[int, int]) -> None:
    with open_camera_recording(make(tmp_path, size)) as recording:
        assert recording.info.format == "KITTI raw drive" and recording.info.body_frame == "imu"
        cameras = [camera.calibrated() for camera in recording.info.cameras]
        events = list(recording)
        assert recording.rejected == {}
    # Points that camera 0 sees, told in the frame of the IMU.
    p_camera = RNG.uniform([-0.4, -0.3, 1.0], [0.4, 0.3, 3.0], (20, 3))
    p_imu = ((p_camera - T_CAM_VELO) @ R_CAM_VELO - T_VELO_IMU) @ R_VELO_IMU
    np.testing.assert_allclose(in_camera_0(p_imu), p_camera, atol=1e-12)
    for camera, (R, T, P) in zip(cameras, ((np.eye(3), np.zeros(3), P_1 * [1, 1, 1, 0]), (R_1, T_1, P_1)), strict=True):
        seen_at, _ = camera.model.project((p_imu - camera.T_body_camera[:3, 3]) @ camera.T_body_camera[:3, :3])
        if size == RECTIFIED:
            h = np.column_stack([p_camera @ R_RECT.T, np.ones(20)]) @ P.T
            expected = h[:, :2] / h[:, 2:]
        else:
            a, b = ((p_camera @ R.T + T) / (p_camera @ R.T + T)[:, 2:])[:, :2].T
            r2 = a * a + b * b
            s = 1 + D[0] * r2 + D[1] * r2**2 + D[4] * r2**3
            x = a * s + 2 * D[2] * a * b + D[3] * (r2 + 2 * a * a)
            y = b * s + D[2] * (r2 + 2 * b * b) + 2 * D[3] * a * b
            expected = np.column_stack([x * K[0, 0] + K[0, 2], y * K[1, 1] + K[1, 2]])
        np.testing.assert_allclose(seen_at, expected, atol=1e-9)
        assert (camera.width, camera.height) == size
    images = [event for event in events if isinstance(event, CameraImage)]
    assert len(images) == 8 and images[2].time_ns - images[0].time_ns == 100_000_000
    samples = [event for event in events if not isinstance(event, CameraImage)]
    np.testing.assert_allclose(samples[0].accel[0], (0.1, 0.2, 9.81))
    np.testing.assert_allclose(samples[0].gyro[0], (0.01, 0.02, 0.03))


def test_a_synchronised_drive_has_too_slow_an_imu_and_without_one_the_body_is_the_first_camera(tmp_path: Path) -> None:
    with open_camera_recording(make(tmp_path / "sync", RECTIFIED, oxts_hz=10.0)) as recording:
        assert any(e.key == "imu_rate" and e.verdict == "warning" for e in recording.info.evidence)
    drive = make(tmp_path / "alone", RECTIFIED, oxts_hz=None)
    with open_camera_recording(drive) as recording:
        first, second = (camera.calibrated() for camera in recording.info.cameras)
        assert recording.info.body_frame == "image_00"
    np.testing.assert_allclose(first.T_body_camera, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(second.T_body_camera[:3, 3], (0.54, 0.0, 0.0), atol=1e-12)
    assert has_cameras_only(drive)
    (drive / "velodyne_points").mkdir()
    assert not has_cameras_only(drive)


def test_missing_and_broken_files_are_named(tmp_path: Path) -> None:
    drive = make(tmp_path, RECTIFIED)
    (drive / "image_01" / "data" / "0000000002.png").unlink()
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    with open_camera_recording(drive) as recording:
        camera = recording.info.cameras[0]
        assert camera.model is not None and "no calib_velo_to_cam.txt" in camera.missing["T_body_camera"]
        assert any("1 of the 4 times in image_01 have no image" in e.text for e in recording.info.evidence)
    cameras = drive.parent / "calib_cam_to_cam.txt"
    text = cameras.read_text()
    cameras.write_text(text.replace("P_rect_01", "P_01"))
    with pytest.raises(RecordingError, match=r"P_rect_01 \(12 numbers\) – got 0"):
        open_camera_recording(drive)
    cameras.write_text(text.replace("R_rect_00", "R_rec_00"))
    with pytest.raises(RecordingError, match=r"R_rect_00 \(9 numbers\)"):
        open_camera_recording(drive)
    cameras.unlink()
    with open_camera_recording(drive) as recording:
        assert recording.info.cameras[0].model is None
        assert any(e.key == "calibration" and "download the calibration" in e.text for e in recording.info.evidence)
    (drive / "image_00" / "timestamps.txt").write_text("yesterday\n")
    with pytest.raises(RecordingError, match="lines like 2011-09-26"):
        open_camera_recording(drive)
