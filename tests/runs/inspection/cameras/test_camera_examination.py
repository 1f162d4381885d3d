"""The data doctor for cameras: what is wrong with a recording on purpose is found, and what is right is not called wrong."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from boxplus import Pinhole, diagnose
from boxplus.cli import app
from boxplus.recordings import CameraStream
from boxplus.recordings.info import Evidence
from boxplus.runs.inspection.cameras.rotation import Alignment, Turns, align, check_rotation
from boxplus.sensors.inertial.imu import ImuSamples
from tests.camera_recordings import FRAME_NS, START_NS, CameraBag, pgm, write_euroc

needs_cv2 = pytest.mark.skipif(importlib.util.find_spec("cv2") is None, reason="OpenCV (extra `vision`) is not installed")
BIAS = np.array([-0.003, 0.02, 0.08])


def rates(t: np.ndarray, seed: int) -> np.ndarray:
    """Smooth angular velocities (N, 3) about all axes [rad/s]."""
    rng = np.random.default_rng(seed)
    f, phase = rng.uniform(0.3, 1.5, (4, 3)), rng.uniform(0, 2 * np.pi, (4, 3))
    return 0.25 * sum(np.sin(2 * np.pi * f[k] * t[:, None] + phase[k]) for k in range(4))


def turning(
    seed: int, offset_s: float, R_imu_camera: np.ndarray, noise_rad: float = 1e-3, scale: float = 1.0
) -> tuple[Turns, ImuSamples]:
    """A camera and a gyroscope on one body; `offset_s` has to be added to the camera's times."""
    rng = np.random.default_rng(seed + 100)
    t = np.arange(0.0, 14.0, 0.005)
    omega = rates(t, seed)
    gyro = scale * omega + BIAS + 2e-3 * rng.normal(size=omega.shape)
    R = Rotation.identity()
    attitude = [R]
    for rate in 0.5 * (omega[1:] + omega[:-1]):
        R = R * Rotation.from_rotvec(rate * 0.005)
        attitude.append(R)
    turns = Turns(images=deque())
    for k in range(100, 2500, 10):
        R_begin_end_imu = attitude[k].inv() * attitude[k + 30]
        R_begin_end = Rotation.from_matrix(R_imu_camera.T @ R_begin_end_imu.as_matrix() @ R_imu_camera)
        R_begin_end = R_begin_end * Rotation.from_rotvec(noise_rad * rng.normal(size=3))
        begin, end = (START_NS + round((t[i] - offset_s) * 1e9) for i in (k, k + 30))
        turns.add(begin, end, R_begin_end.as_matrix().T)
    time_ns = START_NS + np.rint(t * 1e9).astype(np.int64)
    return turns, ImuSamples(time_ns, gyro, np.zeros_like(gyro))


def stream(R_imu_camera: np.ndarray | None) -> CameraStream:
    T = None
    if R_imu_camera is not None:
        T = np.eye(4)
        T[:3, :3] = R_imu_camera
    return CameraStream(0, "cam0", "intensity", "cam0", "", 752, 480, 1, 20.0, model=Pinhole(400, 400, 376, 240), T_body_camera=T)


@pytest.mark.parametrize("seed", range(6))
def test_offset_and_rotation_come_back_within_their_deviations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    offset, R = rng.uniform(-0.1, 0.1), Rotation.random(random_state=seed).as_matrix()
    found = align(*turning(seed, offset, R))
    assert not isinstance(found, str)
    assert abs(found.offset_s - offset) < 4.0 * found.offset_std_s + 2e-4 and found.offset_std_s < 2e-3
    apart = Rotation.from_matrix(found.R_imu_camera.T @ R).magnitude()
    assert apart < 4.0 * found.rotation_std + 2e-3 and found.rotation_std < 0.02
    assert found.unlike < 0.15


@pytest.mark.slow
def test_findings_of_a_right_and_of_wrong_calibrations() -> None:
    R = Rotation.from_rotvec([0.3, -1.2, 0.9]).as_matrix()
    turns, imu = turning(1, 0.0, R)

    def said(camera: CameraStream, turns: Turns = turns, imu: ImuSamples = imu) -> dict[str, Evidence]:
        return {evidence.key: evidence for evidence in check_rotation(camera, align(turns, imu))}

    right = said(stream(R))
    assert [evidence.verdict for evidence in right.values()] == ["ok", "ok"]
    turned = R @ Rotation.from_rotvec([0.0, np.radians(9.0), 0.0]).as_matrix()
    assert said(stream(turned))["R_imu_cam0"].verdict == "error"
    inverse = said(stream(R.T))["R_imu_cam0"]
    assert inverse.verdict == "error" and "the inverse of what is stated fits" in inverse.text
    assert said(stream(None))["R_imu_cam0"].value == "estimated"
    late = said(stream(R), *turning(2, 0.03, R))["cam0_imu_time_offset"]
    assert late.verdict == "warning" and late.value.startswith(("+29", "+30")) and "timeshift_cam_imu" in late.text
    degrees = said(stream(R), *turning(3, 0.0, R, scale=57.3))["R_imu_cam0"]
    assert (degrees.verdict, degrees.value) == ("error", "unlike") and "deg/s, not rad/s" in degrees.text
    radians = said(stream(R), *turning(3, 0.0, R, scale=1.0 / 57.3))["R_imu_cam0"]
    assert radians.verdict == "error" and "taken for deg/s" in radians.text
    opposite = said(stream(R), *turning(5, 0.02, R, scale=-1.0))["R_imu_cam0"]
    assert opposite.verdict == "error" and "opposite sign" in opposite.text
    other = said(stream(R), turns, turning(4, 0.0, R)[1])["R_imu_cam0"]
    assert (other.verdict, other.value) == ("warning", "unlike") and "different platforms" in other.text
    far = said(stream(R), *turning(2, 0.2, R))
    assert {evidence.value for evidence in far.values()} <= {"beyond the search", "unlike"}
    assert all(evidence.verdict != "ok" for evidence in far.values())
    unknown = said(dataclasses.replace(stream(R), model=None))["R_imu_cam0"]
    assert unknown.verdict == "warning" and "intrinsics of cam0 are not known" in unknown.text


@given(
    angle=st.floats(0.6, 2.2),
    std_deg=st.floats(0.05, 3.0),
    sigmas=st.floats(0.0, 3.5),
    seed=st.integers(0, 1000),
    is_inverse=st.booleans(),
)
def test_a_mounting_is_inverted_where_its_inverse_is_as_close_as_is_known(
    angle: float, std_deg: float, sigmas: float, seed: int, is_inverse: bool
) -> None:
    """And not where it is farther off than that, or hardly closer than what is stated."""
    random = np.random.default_rng(seed)
    axis, error = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    stated = Rotation.from_rotvec(angle * axis)
    off_deg = min(sigmas * std_deg, 0.05 * np.degrees(angle)) if is_inverse else 4.5 * max(std_deg, 1.5)
    near = stated.inv() * Rotation.from_rotvec(np.radians(off_deg) * error)
    found = Alignment(near.as_matrix(), BIAS, 0.0, 1e-3, 0.1, np.radians(std_deg))
    (_, said) = check_rotation(stream(stated.as_matrix()), found)
    assert said.verdict == "error"
    assert ("the inverse of what is stated fits" in said.text) == is_inverse
    assert ("the stated mounting does not fit" in said.text) != is_inverse


@pytest.mark.parametrize("seed", range(4))
def test_an_inverse_that_is_hardly_closer_than_what_is_stated_is_not_named(seed: int) -> None:
    """Of little rotation much fits within four deviations."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    axis /= np.linalg.norm(axis)
    across = np.cross(axis, random.normal(size=3))
    stated = Rotation.from_rotvec(np.radians(25.0) * axis)
    near = stated.inv() * Rotation.from_rotvec(np.radians(15.0) * across / np.linalg.norm(across))
    found = Alignment(near.as_matrix(), BIAS, 0.0, 1e-3, 0.1, np.radians(5.0))
    (_, said) = check_rotation(stream(stated.as_matrix()), found)
    assert said.verdict != "ok" and "the stated mounting does not fit" in said.text


def test_rates_of_the_opposite_sign_about_two_axes_look_like_half_a_turn_of_the_mounting() -> None:
    """And both are said."""
    turns, imu = turning(1, 0.0, np.eye(3))
    planar = Turns(turns.begin_ns, turns.end_ns, [np.array([r[0], r[1], 0.01 * r[2]]) for r in turns.rotation])
    opposite = ImuSamples(imu.time_ns, -imu.gyro * [1.0, 1.0, 0.01], imu.accel)
    (_, found) = check_rotation(stream(np.eye(3)), align(planar, opposite))
    assert found.verdict == "error" and "does not fit this recording; with images turned upside down it would" in found.text
    assert "or the gyroscope's rates have the opposite sign" in found.text


@pytest.mark.parametrize(
    ("what", "axes"),
    [("turned upside down", (-1, -1, 1)), ("mirrored left to right", (1, -1, -1)), ("mirrored top to bottom", (-1, 1, -1))],
)
def test_images_that_were_turned_or_mirrored_are_told_by_how_they_turn(what: str, axes: tuple[int, int, int]) -> None:
    """A mirror M takes a rotation vector w to -M w, and half a turn about the optical axis is one."""
    turns, imu = turning(1, 0.0, np.eye(3))
    seen = Turns(turns.begin_ns, turns.end_ns, [np.array(axes) * r for r in turns.rotation])
    (_, found) = check_rotation(stream(np.eye(3)), align(seen, imu))
    assert found.verdict == "error" and f"with images {what} it would" in found.text
    assert found.text.count(" it would") == 1


def test_what_the_motion_does_not_show_is_not_judged() -> None:
    turns, imu = turning(1, 0.0, np.eye(3))
    still = Turns(turns.begin_ns, turns.end_ns, [np.zeros(3)] * len(turns.rotation))
    assert align(still, imu) == "the camera turns too little, or about one axis only"
    one_axis = Turns(turns.begin_ns, turns.end_ns, [np.array([r[0], 0.0, 0.0]) for r in turns.rotation])
    assert align(one_axis, imu) == "the camera turns too little, or about one axis only"
    few = align(Turns(turns.begin_ns[:5], turns.end_ns[:5], turns.rotation[:5]), imu)
    assert isinstance(few, str) and few.startswith("5 rotations of the camera")


@needs_cv2
def test_brightness_jumps_and_cameras_out_of_step(tmp_path: Path) -> None:
    bright = {(0, k): np.full((8, 12), 200 if k >= 4 else 100, np.uint8) for k in range(8)}
    dark = {(1, k): np.full((8, 12), 3, np.uint8) for k in range(8)}
    stamps = {(1, k): START_NS + k * FRAME_NS + FRAME_NS // 2 for k in range(8)}
    path = CameraBag(frames=8, pictures=bright | dark, stamps=stamps).write(tmp_path)
    diagnosis = diagnose(path)
    said = {evidence.key: evidence for evidence in diagnosis.evidence}
    assert diagnosis.verdict == "error" and diagnosis.format == "ROS 1 bag"
    assert "1 jumps by more than 25 % between neighbours, the largest 0.20 s" in said["/cam0/image_raw_brightness"].text
    assert "8 of 8 images are almost black" in said["/cam1/image_raw_brightness"].text
    assert said["/cam0/image_raw_/cam1/image_raw_synchronisation"].verdict == "error"
    assert said["/cam0/image_raw_/cam1/image_raw_epipolar"].value == "unchecked"


@needs_cv2
def test_missing_images_and_calibration_are_found(tmp_path: Path) -> None:
    path = write_euroc(tmp_path, frames=12)
    for index in (5, 6):
        (path / "mav0" / "cam1" / "data" / f"{START_NS + index * FRAME_NS}.pgm").write_bytes(
            pgm(np.zeros((8, 12), np.uint8))[:30]
        )
    (path / "mav0" / "cam1" / "sensor.yaml").unlink()
    out = tmp_path / "findings.json"
    done = CliRunner().invoke(app, ["inspect", str(path), "--json", "-o", str(out)])
    assert done.exit_code == 0, done.output
    said = {finding["key"]: finding for finding in json.loads(out.read_text())["evidence"]}
    assert said["cam1_gaps"]["verdict"] == "warning" and "about 2 messages are missing" in said["cam1_gaps"]["text"]
    assert said["cam1_model"]["value"] == said["cam1_mounting"]["value"] == "unknown"
    assert said["messages"]["value"] == "2 rejected"
    assert "2 without a partner" in said["cam0_cam1_synchronisation"]["text"]


@pytest.mark.slow
@needs_cv2
def test_a_rendered_flight_is_as_it_should_be(shared_data: Path) -> None:
    path = shared_data / "cameras" / "mh05_stereo"
    if not path.is_dir():
        pytest.skip("cameras/mh05_stereo is not on this machine")
    said = {evidence.key: evidence for evidence in diagnose(path).evidence}
    for key in ("cam0_cam1_epipolar", "cam0_imu_time_offset", "R_imu_cam0", "cam0_cam1_synchronisation"):
        assert said[key].verdict == "ok", said[key]
    assert float(said["cam0_cam1_epipolar"].value.split()[0]) < 0.2


@pytest.mark.slow
@needs_cv2
def test_a_real_flight_with_the_calibration_of_swapped_cameras_and_a_late_clock(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "cameras" / "euroc_mh01_stereo_imu_11s"
    if not path.is_dir():
        pytest.skip("cameras/euroc_mh01_stereo_imu_11s is not on this machine")
    text = (shared_data / "cameras" / "v103_stereo.calib.yaml").read_text()  # the same rig
    wrong = text.replace("timeshift_cam_imu: 0.0", "timeshift_cam_imu: 0.04")
    camchain = tmp_path / "camchain.yaml"
    camchain.write_text(wrong.replace("cam0:", "camX:").replace("cam1:", "cam0:").replace("camX:", "cam1:"))
    said = {evidence.key: evidence for evidence in diagnose(path, camchain=camchain).evidence}
    assert said["cam0_cam1_epipolar"].verdict == "error"
    assert said["cam0_imu_time_offset"].verdict == "warning"
    assert -46.0 < float(said["cam0_imu_time_offset"].value.split()[0]) < -34.0
