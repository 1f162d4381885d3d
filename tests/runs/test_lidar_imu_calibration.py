"""`boxplus calibrate lidar-imu`: what it writes is what `boxplus lio --config` takes, and no more than the motion shows."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.recordings import RecordingOptions, open_recording
from boxplus.runs.calibration import calibrate_lidar_imu, calibration_facts, calibration_yaml
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.simulation import Scenario, Simulation, SpinningLidar, faults, write_recording
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import manoeuvres, trajectories
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.simulation.motions.trajectories import START_NS
from boxplus.simulation.scenarios import mounting
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_agreement.hypotheses import scale_finding

T_IMU_LIDAR = mounting(20.0, -35.0, 110.0, (0.12, -0.08, 0.15))
LIDAR = SpinningLidar(channels=12, azimuth_steps=150)


def swung() -> Simulation:
    motion = manoeuvres.handheld(8.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 1.5, standstill_s=0.0, seed=4)
    return Simulation(Scenario("swung", worlds.room(seed=4), motion, LIDAR, T_imu_lidar=T_IMU_LIDAR), 4, 8.0)


def carried() -> Simulation:
    """Upright, as on wheels: it only ever turns about the vertical."""
    time = trajectories.control_times(8.0, 0.05)
    level = np.zeros_like(time)
    R = trajectories.from_angles(level, level, 0.8 * np.sin(1.5 * time))
    motion = SplineTrajectory(START_NS, 0.05, R, np.stack([0.5 * time, np.sin(time), level + 1.5], axis=1))
    return Simulation(Scenario("carried", worlds.room(seed=4), motion, LIDAR, T_imu_lidar=T_IMU_LIDAR), 4, 8.0)


@pytest.mark.slow
def test_the_file_is_a_configuration(tmp_path: Path) -> None:
    path = write_recording(swung(), tmp_path / "swung", fault=faults.clock_offset(0.04))
    file = tmp_path / "new" / "calibration.yaml"
    result = CliRunner().invoke(app, ["calibrate", "lidar-imu", str(path), "-o", str(file), "--min-range", "0.4", "--json"])
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)["run"]
    assert facts["warnings"] == []
    assert all(quantity["determined"] and len(quantity["sigma"]) in (1, 3) for quantity in facts["quantities"].values())
    assert "known" in result.stderr and str(file) in result.stderr
    config = load_run_config(file)
    T = np.array(config.odometry.T_imu_lidar)
    np.testing.assert_allclose(facts["T_imu_lidar"], T, atol=1e-8)
    assert facts["quantities"]["R_imu_lidar"]["value"] == pytest.approx(T[:3, :3].ravel().tolist(), abs=1e-8)
    assert np.degrees(np.linalg.norm(so3.log(T[:3, :3] @ T_IMU_LIDAR[:3, :3].T))) < 0.3
    assert np.linalg.norm(T[:3, 3] - T_IMU_LIDAR[:3, 3]) < 0.02
    assert abs(config.recording.lidar_time_offset_s - 0.04) < 2e-3
    assert config.recording.min_range == 0.4
    assert 0.05 < config.odometry.extrinsic_rotation_sigma_deg < 0.6
    assert 0.003 < config.odometry.extrinsic_translation_sigma < 0.03
    # What was found makes the clocks agree.
    with open_recording(path, config.recording) as recording:
        again = calibrate_lidar_imu(recording, config.recording)
    assert abs(again.estimate.offset_s) < 2e-3 and abs(again.lidar_time_offset_s - 0.04) < 2e-3
    result = CliRunner().invoke(app, ["calibrate", "lidar-imu", str(path), "-o", str(file)])
    assert result.exit_code == 2 and "exists" in result.output


@pytest.mark.slow
def test_lengths_that_are_wrong_are_said_with_the_mounting_that_they_spoil(tmp_path: Path) -> None:
    """They were a number beside others, all of them known, and the file went into every later run."""
    path = write_recording(swung(), tmp_path / "swung", fault=faults.scale_points(1.15))
    result = CliRunner().invoke(app, ["calibrate", "lidar-imu", str(path), "--quiet"])
    assert result.exit_code == 0
    said = "the points are not in metres, or the accelerometer's scale is wrong; correct that and calibrate anew"
    assert said in " ".join(result.stderr.split())
    assert "# WARNING: the LiDAR's accelerations are 1.1" in result.stdout and said in result.stdout


def test_a_scale_of_the_gyroscope_is_named_beyond_what_any_has() -> None:
    assert scale_finding(1.1, 0.001) is None and scale_finding(0.8, 0.06) is None
    found = scale_finding(0.8, 0.01)
    assert found is not None and found.cause == "gyro_scale" and "0.80 ± 0.01 times" in found.text


@pytest.mark.slow
def test_what_the_motion_does_not_show_is_not_written() -> None:
    found = calibrate_lidar_imu(as_recording(carried()))
    assert not found.has_mounting and calibration_facts(found).T_imu_lidar is None
    text = calibration_yaml(found, RecordingOptions(), "carried")
    assert "T_imu_lidar:" not in text.split("# found with")[0]
    assert "NOT DETERMINED: open" in text and "turn the platform" in text


def test_a_mounting_left_open_is_told_as_every_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It said "not written" below the name of the file that was."""
    file = tmp_path / "calibration.yaml"
    found = SimpleNamespace(quantities=[], has_mounting=False, warnings=[])
    monkeypatch.setattr("boxplus.recordings.open_recording", lambda *_: nullcontext())
    monkeypatch.setattr("boxplus.runs.calibration.calibrate_lidar_imu", lambda *_: found)
    monkeypatch.setattr("boxplus.runs.calibration.calibration_yaml", lambda *_: "recording:\n")
    monkeypatch.setattr("boxplus.runs.calibration.calibration_facts", lambda *_: None)
    result = CliRunner().invoke(app, ["calibrate", "lidar-imu", "a.bag", "-o", str(file)])
    assert result.exit_code == 1 and file.is_file()
    assert " ".join(result.stderr.split()) == (
        f"error: expected a motion that determines T_imu_lidar – got one that leaves it open, which {file} leaves out – record "
        "what stands under advice"
    )


def test_contradictions_are_refused() -> None:
    with pytest.raises(InputError, match=r"reports deg/s.*correct that first"):
        calibrate_lidar_imu(as_recording(swung(), faults.gyro_in_deg()))
    with pytest.raises(InputError, match="a motion that turns LiDAR and IMU"):
        motion = manoeuvres.constant_velocity(4.0, (-3.0, 0.0, 1.5), (0.5, 0.0, 0.0), np.eye(3))
        calibrate_lidar_imu(as_recording(Simulation(Scenario("straight", worlds.room(), motion, LIDAR), 0, 4.0)))
