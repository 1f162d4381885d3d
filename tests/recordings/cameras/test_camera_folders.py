"""Folders with a file for each image: times, pixels and calibration as written, and what is missing or wrong is told."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from boxplus import (
    CameraImage,
    CameraRecordingOptions,
    DoubleSphere,
    Equidistant,
    ImuSamples,
    Pinhole,
    RadialTangential,
    open_camera_recording,
    open_recording,
)
from boxplus.errors import RecordingError
from boxplus.recordings import CameraRecording
from boxplus.residuals.inertial.imu_noise import ImuNoise
from tests.camera_recordings import FRAME_NS, IMU_NS, START_NS, D, K, mounting, pgm, picture, sensor_yaml, write_euroc

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")


def images_of(recording: CameraRecording) -> list[CameraImage]:
    return [event for event in recording if isinstance(event, CameraImage)]


def test_a_euroc_folder_as_written(tmp_path: Path) -> None:
    with open_camera_recording(write_euroc(tmp_path)) as recording:
        info = recording.info
        assert info.format == "EuRoC ASL folder" and info.body_frame == "imu"
        for camera, stream in enumerate(info.cameras):
            known = stream.calibrated()
            assert known.model == Pinhole(*K, RadialTangential(*D))
            np.testing.assert_allclose(known.T_body_camera, mounting(camera), atol=1e-12)
            assert stream.sources["T_body_camera"] == f"cam{camera}/sensor.yaml"
        assert info.imu is not None and info.imu.noise == ImuNoise(1.7e-4, 2e-3, 1.9e-5, 3e-3)
        events = list(recording)
        assert recording.rejected == {} and recording.progress == 1.0
        assert [type(event) for event in recording] == [type(event) for event in events]  # every iteration starts anew
    samples = [event for event in events if isinstance(event, ImuSamples)]
    assert samples[0].time_ns.tolist() == [START_NS + k * IMU_NS for k in range(-4, 1)]  # up to the first image, itself included
    np.testing.assert_array_equal(samples[0].gyro[0], (0.01, 0.02, 0.03))
    images = [event for event in events if isinstance(event, CameraImage)]
    assert [(image.time_ns, image.name) for image in images] == [
        (START_NS + index * FRAME_NS, name) for index in range(6) for name in ("cam0", "cam1")
    ]
    for image in images:
        np.testing.assert_array_equal(image.pixels, picture(image.camera, (image.time_ns - START_NS) // FRAME_NS))


def test_mountings_refer_to_the_imu_wherever_the_body_is(tmp_path: Path) -> None:
    """EuRoC's T_BS of the IMU need not be the identity."""
    path = write_euroc(tmp_path)
    T_body_imu = mounting(1)
    stated = path / "mav0" / "imu0" / "sensor.yaml"
    stated.write_text(f"T_BS: {{data: {T_body_imu.ravel().tolist()}}}\n")
    with open_camera_recording(path) as recording:
        expected = np.linalg.inv(T_body_imu) @ mounting(0)
        np.testing.assert_allclose(recording.info.cameras[0].calibrated().T_body_camera, expected, atol=1e-12)
        noise = [evidence for evidence in recording.info.evidence if evidence.key == "imu_noise"]
        assert [evidence.verdict for evidence in noise] == ["warning"]


def test_without_an_imu_the_body_is_the_first_camera(tmp_path: Path) -> None:
    with open_camera_recording(write_euroc(tmp_path, imu=False)) as recording:
        assert recording.info.imu is None and recording.info.body_frame == "cam0"
        np.testing.assert_array_equal(recording.info.cameras[0].calibrated().T_body_camera, np.eye(4))
        expected = np.linalg.inv(mounting(0)) @ mounting(1)
        np.testing.assert_allclose(recording.info.cameras[1].calibrated().T_body_camera, expected, atol=1e-12)
        assert len(images_of(recording)) == 12


def test_images_named_by_their_time_with_a_camchain(tmp_path: Path) -> None:
    """What Kalibr's bagcreater takes; the camchain names the second camera by its place beside the first."""
    for camera in (0, 1):
        folder = tmp_path / f"cam{camera}"
        folder.mkdir()
        for index in range(4):
            (folder / f"{START_NS + index * FRAME_NS}.pgm").write_bytes(pgm(picture(camera, index)))
        (folder / "notes.pgm").write_bytes(b"not an image")
    (tmp_path / "imu0.csv").write_text(
        "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n"
        + "".join(f"{START_NS + k * IMU_NS},0,0,0,0,0,9.8\n" for k in range(20))
    )
    with (
        open_camera_recording(tmp_path) as recording,
        pytest.raises(RecordingError, match=r"no model \(the recording does not say\) and no T_body_camera"),
    ):
        recording.info.cameras[0].calibrated()
    camchain = tmp_path / "camchain.yaml"
    base = "camera_model: pinhole, intrinsics: [10, 10, 5, 4], distortion_model: none, distortion_coeffs: [], resolution: [12, 8]"
    T_c1_c0 = np.linalg.inv(mounting(1)) @ mounting(0)
    camchain.write_text(
        f"cam0: {{{base}, T_cam_imu: {np.linalg.inv(mounting(0)).tolist()}, timeshift_cam_imu: -0.001, line_delay: 0.002}}\n"
        f"cam1: {{{base}, T_cn_cnm1: {T_c1_c0.tolist()}}}\n"
    )
    with open_camera_recording(tmp_path, CameraRecordingOptions(calibration=camchain)) as recording:
        for camera in (0, 1):
            np.testing.assert_allclose(recording.info.cameras[camera].calibrated().T_body_camera, mounting(camera), atol=1e-12)
        assert [image.time_ns for image in images_of(recording)][:2] == [START_NS - 1_000_000, START_NS]
        assert [camera.calibrated().line_delay_s for camera in recording.info.cameras] == [0.002, 0.0]
        (said,) = (one for one in recording.info.evidence if one.key.endswith("line_delay"))
        assert said.value == "+14.0 ms" and "camchain.yaml, cam0" in said.text
    camchain.write_text(camchain.read_text().replace("0.002", "2000.0"))  # µs
    with pytest.raises(RecordingError, match=r"line_delay in seconds.*16000 s for 8 rows, in camchain.yaml, cam0"):
        open_camera_recording(tmp_path, CameraRecordingOptions(calibration=camchain))


def test_a_camchain_without_an_imu_does_not_say_how_cameras_sit_on_one(tmp_path: Path) -> None:
    path = write_euroc(tmp_path)
    for camera in (0, 1):
        (path / "mav0" / f"cam{camera}" / "sensor.yaml").unlink()
    camchain = tmp_path / "camchain.yaml"
    base = "camera_model: pinhole, intrinsics: [10, 10, 5, 4], distortion_model: none"
    camchain.write_text(f"cam0: {{{base}}}\ncam1: {{{base}, T_cn_cnm1: {np.eye(4).tolist()}}}\n")
    options = CameraRecordingOptions(calibration=camchain)
    with (
        open_camera_recording(path, options) as recording,
        pytest.raises(RecordingError, match=r"mounted to each other, not to the IMU"),
    ):
        recording.info.cameras[1].calibrated()
    for file in (path / "mav0" / "imu0").iterdir():
        file.unlink()
    with open_camera_recording(path, options) as recording:
        np.testing.assert_array_equal(recording.info.cameras[1].calibrated().T_body_camera, np.eye(4))


def test_what_is_missing_of_a_folder_is_told(tmp_path: Path) -> None:
    path = write_euroc(tmp_path)
    cam0 = path / "mav0" / "cam0"
    files = sorted((cam0 / "data").iterdir())
    files[1].unlink()
    files[2].write_bytes(files[2].read_bytes()[:50])
    files[3].write_bytes(pgm(np.zeros((3, 3), np.uint8)))
    imu = path / "mav0" / "imu0" / "data.csv"
    imu.write_text(imu.read_text() + "1700000000,0.1,0.\n")
    with open_camera_recording(path) as recording:
        texts = [evidence.text for evidence in recording.info.evidence if evidence.verdict == "warning"]
        assert "1 of the 6 lines of cam0/data.csv have no image: these are gaps" in texts
        assert "1 lines of imu0/data.csv are no sample: not used" in texts
        assert len(images_of(recording)) == 12 - 3
        assert recording.rejected == {
            "messages: image of cam0 (20 bytes in rows of 12 for 12x8 pixels of mono8)": 1,
            "messages: image of cam0 (3x3 pixels where the first image has 12x8)": 1,
        }


def test_a_calibration_for_another_size_is_not_used(tmp_path: Path) -> None:
    path = write_euroc(tmp_path)
    (path / "mav0" / "cam1" / "sensor.yaml").write_text(sensor_yaml(1, resolution=[24, 16]))
    with open_camera_recording(path) as recording:
        assert [e.key for e in recording.info.evidence if e.verdict == "error"] == ["cam1_size"]
        with pytest.raises(RecordingError, match=r"calibrated for 24x16 px in cam1/sensor.yaml, the images have 12x8"):
            recording.info.cameras[1].calibrated()


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"T_BS": "{data: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1]}"}, "a rotation and a translation"),
        ({"T_BS": "{data: [1, 0]}"}, "4x4 numbers"),
        ({"intrinsics": "[0, 1, 2, 3]"}, "fx positive"),
        ({"intrinsics": "[a, 1, 2, 3]"}, "a list of numbers"),
        ({"resolution": "12"}, "a list of numbers"),
        ({"T_BS": "{["}, "a YAML file with a calibration"),
    ],
)
def test_wrong_calibrations_are_refused(tmp_path: Path, changes: dict[str, str], reason: str) -> None:
    path = write_euroc(tmp_path)
    (path / "mav0" / "cam0" / "sensor.yaml").write_text(sensor_yaml(0, **changes))
    with pytest.raises(RecordingError, match=reason):
        open_camera_recording(path)


def test_a_camchain_that_contradicts_itself_is_refused(tmp_path: Path) -> None:
    camchain = tmp_path / "camchain.yaml"
    T = mounting(0).tolist()
    camchain.write_text(f"cam0: {{camera_model: pinhole, intrinsics: [10, 10, 5, 4], T_cam_imu: {T}, T_imu_cam: {T}}}\n")
    with pytest.raises(RecordingError, match="stored as its inverse"):
        open_camera_recording(write_euroc(tmp_path), CameraRecordingOptions(calibration=camchain))


def test_times_that_are_no_nanoseconds_and_accelerations_in_g(tmp_path: Path) -> None:
    path = write_euroc(tmp_path)
    imu = path / "mav0" / "imu0" / "data.csv"
    rows = [f"{START_NS + k * IMU_NS},0,0,0,0,0,1.0" for k in range(50)]
    imu.write_text("\n".join(rows))
    with open_camera_recording(path) as recording:
        assert recording.info.imu is not None and recording.info.imu.accel_unit == "g"
        samples = ImuSamples.joined(event for event in recording if isinstance(event, ImuSamples))
        np.testing.assert_allclose(samples.accel[:, 2], 9.80665)
    imu.write_text("\n".join(f"{(START_NS + k * IMU_NS) // 1000},0,0,0,0,0,9.8" for k in range(50)))
    with pytest.raises(RecordingError, match="convert the times to nanoseconds"):
        open_camera_recording(path)


def test_exposures_are_read_where_they_are_told(tmp_path: Path) -> None:
    path = write_euroc(tmp_path)
    table = "#timestamp [ns],cam0 shutter [s],cam0 gain,cam1 shutter [s]\n"
    (path / "exposure.csv").write_text(table + f"{START_NS},0.005,1.0,0.006\n{START_NS + FRAME_NS},nan,1.0,x\n")
    with open_camera_recording(path) as recording:
        exposures = [image.exposure_s for image in images_of(recording)]
    assert exposures == [0.005, 0.006] + [None] * 10


def test_the_door_says_what_it_takes(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no file or folder"):
        open_camera_recording(tmp_path / "nothing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="a ROS bag or MCAP, a EuRoC folder"):
        open_camera_recording(tmp_path / "empty")
    with pytest.raises(RecordingError, match="open_camera_recording"):
        open_recording(write_euroc(tmp_path))


@needs_cv2
@pytest.mark.parametrize(
    ("name", "frames", "samples"),
    [("mh05_stereo", (310, 310), 3104), ("euroc_mh01_stereo_imu_11s", (220, 219), 2690)],
)
def test_recordings_of_euroc(shared_data: Path, name: str, frames: tuple[int, int], samples: int) -> None:
    path = shared_data / "cameras" / name
    if not path.is_dir():
        pytest.skip(f"cameras/{name} is not on this machine")
    with open_camera_recording(path) as recording:
        assert tuple(camera.count for camera in recording.info.cameras) == frames
        assert recording.info.imu is not None and recording.info.imu.count == samples
        known = [camera.calibrated() for camera in recording.info.cameras]
        between = np.linalg.inv(known[0].T_body_camera) @ known[1].T_body_camera
        assert np.linalg.norm(between[:3, 3]) == pytest.approx(0.110, abs=1e-3)  # EuRoC's baseline
        times = [event.time_ns for _, event in zip(range(30), recording, strict=False) if isinstance(event, CameraImage)]
        assert times == sorted(times) and recording.rejected == {}


@pytest.mark.parametrize(
    ("stated", "model"),
    [
        ("pinhole, intrinsics: [10, 11, 5, 4], distortion_model: equidistant, distortion_coeffs: [0.1, 0.2, 0.3, 0.4]",
         Equidistant(10, 11, 5, 4, 0.1, 0.2, 0.3, 0.4)),
        ("ds, intrinsics: [-0.2, 0.6, 10, 11, 5, 4], distortion_model: none, distortion_coeffs: []",
         DoubleSphere(10, 11, 5, 4, -0.2, 0.6)),
        ("pinhole, intrinsics: [10, 11, 5, 4], distortion_model: radtan, distortion_coeffs: [0.1, 0.2, 0.3, 0.4, 0.5]",
         Pinhole(10, 11, 5, 4, RadialTangential(0.1, 0.2, 0.3, 0.4, 0.5))),
        ("eucm, intrinsics: [0.5, 1.0, 10, 11, 5, 4], distortion_model: none, distortion_coeffs: []", None),
        ("pinhole, intrinsics: [10, 11, 5, 4], distortion_model: fov, distortion_coeffs: [0.9]", None),
        ("pinhole, intrinsics: [10, 11, 5, 4], distortion_model: none, distortion_coeffs: [0.9]", None),
    ],
)  # fmt: skip
def test_models_of_kalibr(tmp_path: Path, stated: str, model: Pinhole | Equidistant | DoubleSphere | None) -> None:
    camchain = tmp_path / "camchain.yaml"
    camchain.write_text(f"cam0: {{camera_model: {stated}, T_cam_imu: {np.eye(4).tolist()}}}\n")
    path = write_euroc(tmp_path, cameras=1)
    (path / "mav0" / "cam0" / "sensor.yaml").unlink()
    with open_camera_recording(path, CameraRecordingOptions(calibration=camchain)) as recording:
        camera = recording.info.cameras[0]
        assert camera.model == model
        if model is None:
            with pytest.raises(RecordingError, match="no model \\(no camera model for"):
                camera.calibrated()
