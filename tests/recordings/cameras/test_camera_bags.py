"""Bags with cameras: images, IMU and calibration as they were written, in the order of time, and what is wrong is counted."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from boxplus import (
    CameraImage,
    CameraRecordingOptions,
    ImuSamples,
    Pinhole,
    RadialTangential,
    open_camera_recording,
    open_recording,
)
from boxplus.errors import AmbiguityError, RecordingError
from boxplus.recordings import CameraRecording
from tests.bags import CONTAINERS, Container
from tests.camera_recordings import FRAME_NS, START_NS, CameraBag, K, mounting, picture

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")


def images_of(recording: CameraRecording) -> list[CameraImage]:
    return [event for event in recording if isinstance(event, CameraImage)]


@pytest.mark.parametrize("container", CONTAINERS)
def test_images_imu_and_calibration_arrive_as_written(tmp_path: Path, container: Container) -> None:
    bag = CameraBag()
    with open_camera_recording(bag.write(tmp_path, container)) as recording:
        for camera, stream in enumerate(recording.info.cameras):
            known = stream.calibrated()
            assert known.model == Pinhole(*K, RadialTangential(*bag.D))
            np.testing.assert_allclose(known.T_body_camera, mounting(camera), atol=1e-12)
            assert (stream.name, stream.width, stream.height, stream.count) == (bag.topics[camera], 12, 8, bag.frames)
            assert stream.rate_hz == pytest.approx(20.0)
            assert stream.sources["model"] == f"/cam{camera}/camera_info"
            assert stream.sources["T_body_camera"] == f"static transforms imu ← cam{camera}"
            assert "time_offset_s" in stream.missing and stream.time_offset_s is None
        assert recording.info.imu is not None and recording.info.imu.rate_hz == pytest.approx(200.0)
        events = list(recording)
        assert recording.rejected == {} and recording.progress == 1.0
    images = [event for event in events if isinstance(event, CameraImage)]
    assert [(image.camera, image.time_ns) for image in images] == [
        (camera, bag.stamp_ns(camera, index)) for index in range(bag.frames) for camera in (0, 1)
    ]
    for image in images:
        np.testing.assert_array_equal(image.pixels, picture(image.camera, (image.time_ns - START_NS) // FRAME_NS))
    samples = ImuSamples.joined(event for event in events if isinstance(event, ImuSamples))
    np.testing.assert_allclose(samples.accel, np.tile((0.0, 0.0, 9.81), (len(samples), 1)))
    assert (np.diff(samples.time_ns) > 0).all()


@pytest.mark.parametrize("delay_ns", [-20_000_000, 0, 15_000_000, 300_000_000])
def test_the_order_is_that_of_time_whenever_images_arrive(tmp_path: Path, delay_ns: int) -> None:
    with open_camera_recording(CameraBag(delay_ns=delay_ns, frames=12).write(tmp_path)) as recording:
        newest_imu = newest_image = 0
        for event in recording:
            if isinstance(event, ImuSamples):
                assert event.time_ns[0] > max(newest_imu, newest_image)
                newest_imu = int(event.time_ns[-1])
            else:
                assert event.time_ns >= max(newest_imu, newest_image)
                assert event.time_ns - newest_imu < 5_000_000  # all samples before it have come
                newest_image = event.time_ns
        assert recording.rejected == {}


def test_a_given_camchain_overrules_and_its_time_offset_is_added(tmp_path: Path) -> None:
    path = CameraBag().write(tmp_path)
    camchain = tmp_path / "camchain.yaml"
    blocks = []
    for camera in (0, 1):
        T_cam_imu = np.linalg.inv(mounting(camera) @ np.block([[np.eye(3), np.array([[0.0], [0.0], [0.02]])], [np.eye(4)[3:]]]))
        blocks.append(
            f"cam{camera}:\n  camera_model: pinhole\n  intrinsics: [10.5, 11.0, 5.5, 3.5]\n  distortion_model: radtan\n"
            f"  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]\n  resolution: [12, 8]\n  rostopic: /cam{camera}/image_raw\n"
            f"  timeshift_cam_imu: 0.003\n  T_cam_imu: {T_cam_imu.tolist()}\n"
        )
    camchain.write_text("".join(blocks))
    with open_camera_recording(path, CameraRecordingOptions(calibration=camchain)) as recording:
        camera = recording.info.cameras[1]
        assert camera.calibrated().model.fx == 10.5
        assert camera.sources["model"] == "camchain.yaml, cam1"
        assert camera.time_offset_s == 0.003
        said = {evidence.key: evidence for evidence in recording.info.evidence if evidence.value == "contradicted"}
        assert said.keys() == {f"/cam{k}/image_raw_{what}" for k in (0, 1) for what in ("model", "mounting")}
        assert (
            "camchain.yaml, cam1 and static transforms imu ← cam1 differ by 0.00 deg and 20 mm"
            in said["/cam1/image_raw_mounting"].text
        )
        assert images_of(recording)[0].time_ns == START_NS + 3_000_000


def test_static_transforms_that_disagree_are_told(tmp_path: Path) -> None:
    with open_camera_recording(CameraBag(moved_again=True).write(tmp_path)) as recording:
        said = {evidence.key: evidence for evidence in recording.info.evidence if evidence.value == "contradicted"}
    assert said.keys() == {"/cam1/image_raw_mounting"}
    assert "0.500 m from what the others say; find out which" in said["/cam1/image_raw_mounting"].text


def test_missing_calibration_is_named_and_refused(tmp_path: Path) -> None:
    bags = {
        "no CameraInfo on /cam0/camera_info": CameraBag(info=False),
        "static transforms are not in the recording": CameraBag(transforms=False),
        "no camera model for 4 intrinsics of 'pinhole' with 8 coefficients": CameraBag(
            distortion="rational_polynomial", D=(0.1,) * 8
        ),
        "binned image": CameraBag(binning=2),
        "both name the frame 'imu'": CameraBag(same_frames=True),
    }
    for number, (reason, bag) in enumerate(bags.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        with open_camera_recording(bag.write(folder)) as recording:
            with pytest.raises(RecordingError, match=r"give a Kalibr camchain") as caught:
                recording.info.cameras[0].calibrated()
            assert reason in str(caught.value)
            assert len(images_of(recording)) == 2 * bag.frames  # the images are there all the same


def test_rectified_images_take_the_rectified_camera(tmp_path: Path) -> None:
    angle = 0.02
    R = np.array([[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]])
    bag = CameraBag(topics=("/cam0/image_rect",), R=tuple(R.ravel()))
    with open_camera_recording(bag.write(tmp_path)) as recording:
        known = recording.info.cameras[0].calibrated()
    assert known.model == Pinhole(K[0] + 1, K[0] + 1, K[2] + 1, K[3] + 1)
    # A point in the camera's frame, turned by R, is one in the rectified frame.
    p_camera = np.array([0.3, -0.2, 2.0, 1.0])
    p_rectified = np.array([*(R @ p_camera[:3]), 1.0])
    np.testing.assert_allclose(known.T_body_camera @ p_rectified, mounting(0) @ p_camera, atol=1e-12)


def test_without_an_imu_the_body_is_the_first_camera(tmp_path: Path) -> None:
    with open_camera_recording(CameraBag(imu=False).write(tmp_path)) as recording:
        assert recording.info.imu is None and recording.info.body_frame == "/cam0/image_raw"
        np.testing.assert_allclose(recording.info.cameras[0].calibrated().T_body_camera, np.eye(4))
        expected = np.linalg.inv(mounting(0)) @ mounting(1)
        np.testing.assert_allclose(recording.info.cameras[1].calibrated().T_body_camera, expected, atol=1e-12)
        assert len(images_of(recording)) == 12


def test_a_depth_image_has_metres(tmp_path: Path) -> None:
    depth = np.full((8, 12), 1500, np.uint16)
    depth[0, 0] = 0
    bag = CameraBag(topics=("/depth/image_raw",), encoding="16UC1", pictures={(0, k): depth for k in range(6)})
    with open_camera_recording(bag.write(tmp_path)) as recording:
        assert recording.info.cameras[0].kind == "depth"
        assert "REP 118" in recording.info.cameras[0].sources["depth_unit_m"]
        metres = images_of(recording)[0].depth()
    assert np.isnan(metres[0, 0]) and metres[1, 1] == np.float32(1.5)


def test_wrong_stamps_sizes_and_payloads_are_dropped_and_counted(tmp_path: Path) -> None:
    bag = CameraBag(
        frames=8,
        stamps={(0, 2): START_NS, (0, 3): START_NS, (1, 3): START_NS + 3600 * 10**9},
        pictures={(1, 4): np.zeros((4, 4), np.uint8)},
        payloads={(0, 5): b"\x01\x02\x03"},
    )
    with open_camera_recording(bag.write(tmp_path)) as recording:
        images = images_of(recording)
        assert recording.rejected == {
            "messages: /cam0/image_raw: stamp steps back": 2,
            "messages: /cam1/image_raw: stamp jumps ahead by more than 10 s": 1,
            "messages: image of /cam1/image_raw (4x4 pixels where the first image has 12x8)": 1,
            "messages: image of /cam0/image_raw (3 bytes in rows of 15 for 12x8 pixels of mono8)": 1,
        }
    assert len(images) == 16 - 5


def test_a_topic_with_its_compressed_twin_is_read_once(tmp_path: Path) -> None:
    bag = CameraBag(topics=("/cam0/image_raw", "/cam0/image_raw/compressed"), info=False, transforms=False)
    with open_camera_recording(bag.write(tmp_path)) as recording:
        assert [camera.source for camera in recording.info.cameras] == ["/cam0/image_raw"]
        assert any(evidence.key == "image_topics" and "/compressed" in evidence.value for evidence in recording.info.evidence)


def test_topics_are_chosen_or_refused(tmp_path: Path) -> None:
    path = CameraBag(topics=("/cam0/image_raw", "/cam0/image_rect", "/other/image_raw"), info=False).write(tmp_path)
    with pytest.raises(AmbiguityError, match=r"one image topic of the camera /cam0.*choose with image_topics"):
        open_camera_recording(path)
    options = CameraRecordingOptions(image_topics=("/other/image_raw", "/cam0/image_rect"))
    with open_camera_recording(path, options) as recording:
        assert [camera.name for camera in recording.info.cameras] == ["/other/image_raw", "/cam0/image_rect"]
    for topics in ((), ("/nowhere",), ("/cam0/image_raw", "/cam0/image_raw")):
        with pytest.raises(RecordingError, match="choose other image_topics"):
            open_camera_recording(path, CameraRecordingOptions(image_topics=topics))
    with pytest.raises(RecordingError, match="choose another imu_topic"):
        open_camera_recording(path, CameraRecordingOptions(image_topics=("/other/image_raw",), imu_topic="/nowhere"))


def test_compressed_images_without_opencv_are_refused_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = CameraBag(topics=("/cam0/image_raw/compressed",), compressed="jpeg").write(tmp_path)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(RecordingError, match=r"pip install .*opencv"):
        open_camera_recording(path)


@needs_cv2
@pytest.mark.parametrize("container", CONTAINERS)
def test_compressed_images(tmp_path: Path, container: Container) -> None:
    import cv2

    encoded = {(0, k): cv2.imencode(".png", picture(0, k))[1].tobytes() for k in range(6)}
    encoded[0, 4] = encoded[0, 4][:40]
    bag = CameraBag(topics=("/cam0/image_raw/compressed",), compressed="mono8; png compressed ", payloads=encoded)
    with open_camera_recording(bag.write(tmp_path, container)) as recording:
        images = images_of(recording)
        assert recording.rejected == {"messages: image of /cam0/image_raw (a PNG that is cut off)": 1}
        assert recording.info.cameras[0].calibrated().model.fx == K[0]
    for index, image in zip((0, 1, 2, 3, 5), images, strict=True):
        np.testing.assert_array_equal(image.pixels, picture(0, index))


def test_a_stretch_of_a_bag(tmp_path: Path) -> None:
    options = CameraRecordingOptions(start_s=0.1, duration_s=0.1)
    with open_camera_recording(CameraBag(delay_ns=0).write(tmp_path), options) as recording:
        times = {image.time_ns - START_NS for image in images_of(recording)}
    assert times == {100_000_000, 150_000_000}
    with pytest.raises(RecordingError, match="--start 60"):
        open_camera_recording(tmp_path / "cameras.bag", CameraRecordingOptions(start_s=60.0))


def test_the_door_for_lidars_points_to_the_one_for_cameras(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="open_camera_recording"):
        open_recording(CameraBag().write(tmp_path))


@needs_cv2
def test_a_rendered_flight(shared_data: Path) -> None:
    """Every image and sample of the bag, and the calibration of the bag against the camchain beside it."""
    path = shared_data / "cameras" / "v103_stereo.bag"
    if not path.is_file():
        pytest.skip("cameras/v103_stereo.bag is not on this machine")
    options = CameraRecordingOptions(calibration=path.with_name("v103_stereo.calib.yaml"), duration_s=1.0)
    with open_camera_recording(path, options) as recording:
        assert not [evidence for evidence in recording.info.evidence if evidence.verdict != "ok"]
        images = images_of(recording)
        assert recording.rejected == {}
    assert len(images) in (38, 40) and {image.shape for image in images} == {(480, 752)}
    assert 95 < np.mean([image.pixels.mean() for image in images]) < 115  # SOURCE.md: means of 101.7 to 108.8
