"""Simulated recordings of cameras through every format and back, and the faults that are put on them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.formats import read_trajectory
from boxplus.formats.image_file import encode_image
from boxplus.recordings.cameras.decode import decode_file
from boxplus.recordings.cameras.events import CameraRecording
from boxplus.recordings.cameras.open import open_camera_recording
from boxplus.recordings.cameras.options import CameraRecordingOptions
from boxplus.sensors.images.camera_image import CameraImage
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import ImuModel
from boxplus.simulation.cameras import (
    CAMERA_FAULTS,
    CameraSimulation,
    as_camera_recording,
    make_camera_fault,
    make_rig,
    simulate_cameras,
    write_camera_recording,
)
from boxplus.simulation.cameras.faults import drop_frames, imu_clock_offset, rolling_shutter
from boxplus.simulation.cameras.recorded import Recorded
from boxplus.simulation.cameras.recording_writer import CameraFormat
from boxplus.simulation.cameras.sensor import LensKind, RigKind

has_cv2 = importlib.util.find_spec("cv2") is not None


def tiny(kind: RigKind = "stereo", lens: LensKind | None = None, duration_s: float = 1.0, seed: int = 0) -> CameraSimulation:
    return simulate_cameras("room_moving", seed, duration_s=duration_s, rig=make_rig(kind, lens, 0.06, 10.0))


def read(recording: CameraRecording) -> tuple[dict[int, list[CameraImage]], ImuSamples]:
    images: dict[int, list[CameraImage]] = {}
    imu: list[ImuSamples] = []
    for event in recording:
        if isinstance(event, CameraImage):
            assert not imu or imu[-1].time_ns[-1] <= event.time_ns
            images.setdefault(event.camera, []).append(event)
        else:
            imu.append(event)
    return images, ImuSamples.joined(imu)


@pytest.mark.parametrize(
    ("format", "kind", "lens"),
    [
        ("euroc", "stereo", "radtan"),
        ("euroc", "mono", "equidistant"),
        ("tum", "rgbd", "pinhole"),
        ("tum", "mono", "radtan"),
        ("ros1", "stereo", "equidistant"),
        ("ros2", "rgbd", "radtan"),
    ],
)
@pytest.mark.parametrize("images", ["png", "pgm"])
def test_what_is_written_is_read_back(tmp_path: Path, format: CameraFormat, kind: RigKind, lens: LensKind, images: str) -> None:
    if images == "png" and format in ("euroc", "tum") and not has_cv2:
        pytest.skip("OpenCV (extra `vision`) is not installed")
    simulation = tiny(kind, lens)
    path = write_camera_recording(simulation, tmp_path / "made", format, images=images)  # type: ignore[arg-type]
    with open_camera_recording(path) as recording:
        found, imu = read(recording)
        assert not recording.rejected
        for index, camera in enumerate(simulation.scenario.rig.cameras):
            known = recording.info.cameras[index].calibrated()
            assert type(known.model) is type(camera.sensor.lens.model())
            assert np.allclose(known.model.parameters, camera.sensor.lens.model().parameters, atol=1e-12)
            assert np.allclose(known.T_body_camera, camera.mounting, atol=1e-9)
        assert recording.info.imu is not None
        if not format.startswith("ros"):
            assert recording.info.imu.noise is not None
    truth, expected = read(as_camera_recording(simulation))
    assert sorted(found) == sorted(truth)
    for camera, pictures in truth.items():
        assert [image.time_ns for image in found[camera]] == [image.time_ns for image in pictures]
        for one, other in zip(found[camera], pictures, strict=True):
            if one.is_depth:
                assert np.nanmax(np.abs(one.depth() - other.depth())) <= (1.01e-4 if format == "tum" else 0.0)
            else:
                assert (one.pixels == other.pixels).all()
                assert one.exposure_s == (None if format.startswith("ros") else other.exposure_s)
    assert (imu.time_ns == expected.time_ns).all() and np.allclose(imu.gyro, expected.gyro, atol=1e-12)
    stem = path.with_suffix("") if format == "ros1" else path
    trajectory = read_trajectory(Path(f"{stem}.gt.tum"))
    assert trajectory.time_ns is not None
    motion = simulation.ground_truth(trajectory.time_ns)
    assert np.abs(trajectory.p - motion.p_world_imu).max() < 1e-6
    with open_camera_recording(path, CameraRecordingOptions(calibration=Path(f"{stem}.calib.yaml"))) as recording:
        assert np.allclose(recording.info.cameras[0].calibrated().T_body_camera, simulation.scenario.rig.cameras[0].mounting)
        assert not [evidence for evidence in recording.info.evidence if evidence.value == "contradicted"]


def test_ground_truth_of_the_folders_is_exact(tmp_path: Path) -> None:
    simulation = tiny()
    euroc = write_camera_recording(simulation, tmp_path / "euroc", "euroc", images="pgm")
    states = read_trajectory(euroc / "mav0" / "state_groundtruth_estimate0" / "data.csv")
    assert np.abs(states.p - simulation.ground_truth(states.time_ns).p_world_imu).max() < 1e-9
    rgbd = tiny("rgbd")
    tum = write_camera_recording(rgbd, tmp_path / "tum", "tum", images="pgm")
    poses = read_trajectory(tum / "groundtruth.txt")
    assert np.abs(poses.p - rgbd.T_world_camera(0, poses.time_ns)[:, :3, 3]).max() < 1e-6


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_are_encoded_without_loss(dtype: type) -> None:
    pixels = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, (7, 13)).astype(dtype)
    assert (decode_file(encode_image(pixels, "pgm")) == pixels).all()
    if has_cv2:
        assert (decode_file(encode_image(pixels)) == pixels).all()
    with pytest.raises(InputError, match=r"expected grey values \(H, W\), uint8 or uint16 – got float32 of shape"):
        encode_image(pixels.astype(np.float32))
    with pytest.raises(InputError, match="the format 'png' or 'pgm'"):
        encode_image(pixels, "jpg")  # type: ignore[arg-type]


def test_formats_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one camera in a TUM RGB-D folder – got 2"):
        write_camera_recording(tiny(), tmp_path / "a", "tum")
    with pytest.raises(InputError, match="a rig without depths in a EuRoC folder"):
        write_camera_recording(tiny("rgbd"), tmp_path / "a", "euroc")
    (tmp_path / "there").mkdir()
    with pytest.raises(InputError, match="the path of a new recording"):
        write_camera_recording(tiny(), tmp_path / "there", "euroc")
    with pytest.raises(InputError, match="a rig of two cameras – got one of 1"):
        Recorded(tiny("mono"), make_camera_fault("wrong_baseline"))


@pytest.mark.slow
@pytest.mark.parametrize("name", CAMERA_FAULTS)
def test_every_fault_has_words_and_a_stream(name: str) -> None:
    fault = make_camera_fault(name)
    assert fault.words and all(word == word.lower() for word in fault.words) and fault.named_in(fault.words[0].upper())
    assert not fault.named_in("everything is in order")
    simulation = simulate_cameras("room", 0, duration_s=6.5, rig=make_rig("stereo", None, 0.04, 5.0))
    recorded = Recorded(simulation, fault)
    sound, spoilt = list(simulation.events()), list(recorded.events())
    declared_otherwise = recorded.declared != simulation.scenario.rig

    def bits(events: list) -> list:
        return [(e.camera, e.time_ns, e.pixels.tobytes()) if isinstance(e, CameraImage) else e.gyro.tobytes() for e in events]

    stamps = [event.time_ns.tobytes() for event in spoilt if isinstance(event, ImuSamples)]
    accel = [event.accel.tobytes() for event in spoilt if isinstance(event, ImuSamples)]
    changed = bits(sound) != bits(spoilt)
    changed |= stamps != [event.time_ns.tobytes() for event in sound if isinstance(event, ImuSamples)]
    changed |= accel != [event.accel.tobytes() for event in sound if isinstance(event, ImuSamples)]
    assert changed or declared_otherwise
    times = [event.time_ns for event in spoilt if isinstance(event, CameraImage)]
    assert times == sorted(times)


def test_faults_do_what_they_say() -> None:
    simulation = simulate_cameras("room", 0, duration_s=6.5, rig=make_rig("stereo", None, 0.06, 10.0))

    def images(name: str) -> dict[int, list[CameraImage]]:
        return read(as_camera_recording(simulation, make_camera_fault(name)))[0]

    sound = read(as_camera_recording(simulation))[0]
    covered = [image.pixels for image in images("covered_lens")[0] if image.time_ns - simulation.start_ns > 5_100_000_000]
    assert max(np.std(pixels.astype(float)) for pixels in covered) < 6.0
    dark = images("darkness")
    assert dark[0][-1].pixels.mean() < 8.0 and dark[0][10].pixels.mean() > 60.0
    assert len(sound[0]) - len(images("drop_frames")[0]) == 6
    swapped = images("swapped_cameras")
    assert (swapped[0][5].pixels == sound[1][5].pixels).all() and swapped[0][5].name == "cam0"
    drop = drop_frames(2.0, 1.0)
    assert "no images for 1 s" in drop.description
    late = read(as_camera_recording(simulation, imu_clock_offset(0.2)))[1]
    assert late.time_ns[0] - simulation.start_ns == 200_000_000
    assert Recorded(simulation, rolling_shutter(0.03)).declared.cameras[0].sensor.line_delay_s == 0.0
    height = simulation.scenario.rig.cameras[0].sensor.height
    rolling = Recorded(simulation, rolling_shutter(0.03)).simulation.scenario.rig.cameras[0].sensor.line_delay_s
    assert rolling * height == pytest.approx(0.03)
    moving = images("moving_object")
    half = [a.pixels[:, :10].astype(float) - b.pixels[:, :10] for a, b in zip(moving[0][-5:], sound[0][-5:], strict=True)]
    assert min(np.abs(difference).mean() for difference in half) > 5.0


def test_motions_at_the_start_are_what_they_claim() -> None:
    simulation = simulate_cameras("room", 0, duration_s=12.0, rig=make_rig("mono", None, 0.06, 5.0))
    turning = Recorded(simulation, make_camera_fault("rotation_at_start")).simulation
    times = turning.start_ns + np.arange(0, 3_900_000_000, 10**8)
    motion = turning.ground_truth(times)
    assert np.ptp(motion.p_world_imu, axis=0).max() < 1e-6 and np.linalg.norm(motion.omega_imu, axis=1).max() > 0.4
    straight = Recorded(simulation, make_camera_fault("constant_velocity_start")).simulation
    motion = straight.ground_truth(straight.start_ns + np.arange(0, 4_800_000_000, 10**8))
    assert np.linalg.norm(motion.a_world_imu, axis=1).max() < 1e-6 and np.linalg.norm(motion.omega_imu, axis=1).max() < 1e-9
    assert np.linalg.norm(motion.v_world_imu, axis=1).min() > 0.4
    for moved in (turning, straight):
        path = moved.ground_truth(np.arange(moved.start_ns, moved.end_ns, 10**8))
        assert np.linalg.norm(path.a_world_imu, axis=1).max() < 6.0
        assert moved.scenario.world.distance(path.p_world_imu).min() > 0.2


def test_an_ideal_imu_and_the_command(tmp_path: Path) -> None:
    from dataclasses import replace

    simulation = tiny()
    ideal = CameraSimulation(replace(simulation.scenario, imu=ImuModel().noise_free()), 0, 1.0)
    assert as_camera_recording(ideal).info.imu is not None
    command = ["simulate", "room", "--camera", "mono", "--scale", "0.06", "--rate", "5", "--duration", "1", "--format", "tum"]
    done = CliRunner().invoke(app, [*command, "--fault", "darkness", "-o", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert (tmp_path / "room_mono_darkness" / "rgb.txt").is_file() and (tmp_path / "room_mono_darkness.calib.yaml").is_file()
    assert "4 x 1 images" in done.output
    listed = CliRunner().invoke(app, ["simulate", "--list"]).output
    assert "covered_lens" in listed and "room_light" in listed
    refused = CliRunner().invoke(app, ["simulate", "room"])
    assert refused.exit_code == 2 and "--camera" in refused.output
