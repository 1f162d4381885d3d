"""Folders of TUM RGB-D, KITTI odometry and 7-Scenes: times, pixels, depths and calibration, and what they do not say."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from boxplus import CameraImage, CameraRecordingOptions, Pinhole, open_camera_recording
from boxplus.errors import RecordingError
from boxplus.recordings import CameraRecording
from tests.camera_recordings import pgm, picture

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
DEPTH = np.arange(96, dtype=np.uint16).reshape(8, 12) * 100


def images_of(recording: CameraRecording) -> list[CameraImage]:
    return [event for event in recording if isinstance(event, CameraImage)]


def write_tum(path: Path) -> Path:
    lists: dict[str, list[str]] = {"rgb": ["# color images", "# timestamp filename"], "depth": ["# depth maps"]}
    for name in lists:
        (path / name).mkdir(parents=True)
        for index in range(4):
            stamp = f"13050310{index}.379057{'' if name == 'rgb' else '5'}"
            file = f"{name}/{stamp}.pgm"
            (path / file).write_bytes(pgm(picture(0, index, (8, 12, 3)) if name == "rgb" else DEPTH))
            lists[name].append(f"{stamp} {file}")
        (path / f"{name}.txt").write_text("\n".join(lists[name]))
    return path


def test_tum_times_are_exact_and_depths_are_registered(tmp_path: Path) -> None:
    path = write_tum(tmp_path / "tum")
    with open_camera_recording(path) as recording:
        assert [camera.kind for camera in recording.info.cameras] == ["intensity", "depth"]
        for camera in recording.info.cameras:
            assert camera.missing["model"] == "the recording does not say"
            np.testing.assert_array_equal(camera.T_body_camera, np.eye(4))
        with pytest.raises(RecordingError, match="give a Kalibr camchain"):
            recording.info.camera("depth").calibrated()
        images = images_of(recording)
        assert recording.rejected == {}
    assert [image.time_ns for image in images[:2]] == [130503100379057000, 130503100379057500]
    np.testing.assert_array_equal(images[0].pixels, picture(0, 0, (8, 12, 3)))
    metres = images[1].depth()
    assert np.isnan(metres[0, 0])
    np.testing.assert_allclose(metres.ravel()[1:], DEPTH.ravel()[1:] / 5000.0, rtol=1e-6)


def test_tum_intrinsics_are_read_where_their_columns_are_named(tmp_path: Path) -> None:
    path = write_tum(tmp_path / "tum")
    intrinsics = path / "intrinsics.txt"
    intrinsics.write_text("# fx fy cx cy width height depth_factor\n10 11 5 4 12 8 1000\n")
    with open_camera_recording(path) as recording:
        assert [camera.calibrated().model for camera in recording.info.cameras] == [Pinhole(10, 11, 5, 4)] * 2
        assert recording.info.cameras[1].depth_unit_m == 1e-3
        assert recording.info.cameras[1].sources["model"] == "intrinsics.txt (of rgb)"
    with open_camera_recording(path, CameraRecordingOptions(depth_unit_m=2e-3)) as recording:
        assert recording.info.cameras[1].depth_unit_m == 2e-3
    camchain = tmp_path / "camchain.yaml"
    camchain.write_text("rgb: {}\ncam0: {camera_model: pinhole, intrinsics: [10, 11, 5, 4.5], distortion_model: none}\n")
    with open_camera_recording(path, CameraRecordingOptions(calibration=camchain)) as recording:
        assert [camera.calibrated().model for camera in recording.info.cameras] == [Pinhole(10, 11, 5, 4.5)] * 2
    intrinsics.write_text("10 11 5 4\n")
    with pytest.raises(RecordingError, match="the head line '# fx fy cx cy width height depth_factor'"):
        open_camera_recording(path)


def write_kitti(path: Path, names: tuple[str, ...], calib: str, times: str | None) -> Path:
    for camera, name in enumerate(names):
        (path / name).mkdir(parents=True)
        for index in range(3):
            (path / name / f"{index:06d}.pgm").write_bytes(pgm(picture(camera, index)))
    (path / "calib.txt").write_text(calib)
    if times is not None:
        (path / "times.txt").write_text(times)
    return path


def test_kitti_projections_become_models_and_a_baseline(tmp_path: Path) -> None:
    rows = ["700 0 600 0 0 700 180 0 0 0 1 0", "700 0 600 -378 0 700 180 0 0 0 1 0"]
    named = "".join(f"P{k}: {row}\n" for k, row in enumerate(rows)) + "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n"
    cases = [
        (("image_0", "image_1"), named, "calib.txt, P1"),
        (("image_l", "image_r"), "\n".join(rows), "calib.txt, row 1"),
    ]
    for number, (names, calib, source) in enumerate(cases):
        path = write_kitti(tmp_path / str(number), names, calib, "0.000000e+00\n1.036224e-01\n2.072999e-01\n")
        with open_camera_recording(path) as recording:
            known = recording.info.cameras[1].calibrated()
            assert known.model == Pinhole(700, 700, 600, 180)
            np.testing.assert_allclose(known.T_body_camera[:3], [[1, 0, 0, 0.54], [0, 1, 0, 0], [0, 0, 1, 0]], atol=1e-12)
            assert recording.info.cameras[1].sources["T_body_camera"] == source
            assert [image.time_ns for image in images_of(recording)] == [0, 0, 103622400, 103622400, 207299900, 207299900]
    with pytest.raises(RecordingError, match="the projection of image_1"):
        open_camera_recording(write_kitti(tmp_path / "short", ("image_0", "image_1"), f"P0: {rows[0]}\n", "0\n1\n2\n"))
    with pytest.raises(RecordingError, match=r"a time of image 1 in times\.txt"):
        open_camera_recording(write_kitti(tmp_path / "times", ("image_0",), f"P0: {rows[0]}\n", "0\n"))


def test_without_times_the_rate_has_to_be_given(tmp_path: Path) -> None:
    row = "700 0 600 0 0 700 180 0 0 0 1 0"
    path = write_kitti(tmp_path / "kitti", ("image_0",), row, None)
    with pytest.raises(RecordingError, match="give their rate: --frame-rate"):
        open_camera_recording(path)
    with open_camera_recording(path, CameraRecordingOptions(frame_rate_hz=20.0)) as recording:
        assert [image.time_ns for image in images_of(recording)] == [0, 50_000_000, 100_000_000]


@needs_cv2
def test_7_scenes_depths_without_a_measurement_are_nan(tmp_path: Path) -> None:
    import cv2

    depth = DEPTH.copy()
    depth[0, 1] = 65535
    for index in range(2):
        colour = cv2.imencode(".png", picture(0, index, (8, 12, 3))[:, :, ::-1])[1]
        (tmp_path / f"frame-{index:06d}.color.png").write_bytes(colour.tobytes())
        (tmp_path / f"frame-{index:06d}.depth.png").write_bytes(cv2.imencode(".png", depth)[1].tobytes())
    (tmp_path / "camera-intrinsics.txt").write_text("585 0 320\n0 585 240\n0 0 1\n")
    with open_camera_recording(tmp_path, CameraRecordingOptions(frame_rate_hz=30.0)) as recording:
        assert recording.info.camera("depth").calibrated().model == Pinhole(585, 585, 320, 240)
        assert [evidence.key for evidence in recording.info.evidence if evidence.verdict == "warning"] == ["registration"]
        image, metres = (images_of(recording)[k] for k in (0, 1))
    np.testing.assert_array_equal(image.pixels, picture(0, 0, (8, 12, 3)))
    assert np.isnan(metres.depth()[0, :2]).all() and metres.depth()[0, 2] == np.float32(0.2)


@needs_cv2
@pytest.mark.parametrize(
    ("name", "rate", "count", "kinds"),
    [
        ("cameras/room_rgbd_tum", None, (120, 120), {"uint8", "uint16"}),
        ("cameras/kitti_stereo_36", 10.0, (36, 36), {"uint8"}),
        ("rgbd/7scenes_60", 30.0, (60, 60), {"uint8", "uint16"}),
        ("rgbd/tum_fr1_desk_9", None, (9, 9), {"uint8", "uint16"}),
    ],
)
def test_real_folders(shared_data: Path, name: str, rate: float | None, count: tuple[int, int], kinds: set[str]) -> None:
    path = shared_data / name
    if not path.is_dir():
        pytest.skip(f"{name} is not on this machine")
    with open_camera_recording(path, CameraRecordingOptions(frame_rate_hz=rate)) as recording:
        assert tuple(camera.count for camera in recording.info.cameras) == count
        events = [event for event, _ in zip(recording, range(20), strict=False)]
        assert recording.rejected == {}
    images = [event for event in events if isinstance(event, CameraImage)]
    assert {str(image.pixels.dtype) for image in images} == kinds
    for image in images:
        if image.is_depth:
            assert 0.3 < np.nanmedian(image.depth()) < 5.0  # rooms
