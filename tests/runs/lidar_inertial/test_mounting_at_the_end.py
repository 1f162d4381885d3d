"""A mounting that nobody gave is known at the end of a run, and what the run says of it can be given to the next one."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.evaluation.evaluation import evaluate
from boxplus.formats.trajectory import Trajectory, read_trajectory
from boxplus.manifolds import quaternion, so3
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.simulation import Scenario, Simulation, SpinningLidar, faults, mounting, write_recording
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.motions.spline import SplineTrajectory
from boxplus.simulation.motions.trajectories import START_NS, control_times, fade_in, from_angles
from boxplus.simulation.worlds import worlds

DURATION_S = 16.0
LIDAR = SpinningLidar(channels=16, azimuth_steps=300)


def about_two_axes() -> Simulation:
    """At rest in a room, then carried about while it rolls and yaws, and never pitches."""
    time = control_times(DURATION_S, 0.04)
    moved = fade_in(time, 1.5, 2.0)
    roll, yaw = 0.3 * moved * np.sin(1.9 * time), 0.8 * moved * np.sin(0.9 * time)
    way = np.stack([1.5 * np.sin(0.5 * time), 1.2 * np.sin(0.7 * time), 0.4 * np.sin(0.9 * time)], axis=1)
    motion = SplineTrajectory(START_NS, 0.04, from_angles(roll, np.zeros_like(time), yaw), moved[:, None] * way + [0.0, 0.0, 1.7])
    T = mounting(170.0, 20.0, -60.0, (0.12, -0.07, 0.15))
    return Simulation(Scenario("two axes", worlds.room(seed=1), motion, LIDAR, T_imu_lidar=T), 1, DURATION_S)


def about_all_axes() -> Simulation:
    motion = manoeuvres.handheld(20.0, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 1.2, standstill_s=1.5, seed=2)
    T = mounting(-86.0, -72.0, 113.0, (-0.16, 0.13, 0.09))
    return Simulation(Scenario("all axes", worlds.room(seed=2), motion, LIDAR, T_imu_lidar=T), 2, 20.0)


def ate_m(path: Trajectory, simulation: Simulation) -> float:
    true = simulation.ground_truth(path.times)
    return evaluate(path, Trajectory(path.times, true.p_world_imu, quaternion.from_matrix(true.R_world_imu)), deltas=()).ate.rmse


@pytest.mark.slow
def test_the_mounting_at_the_end_is_right_and_can_be_given_to_the_next_run(tmp_path: Path) -> None:
    simulation = about_two_axes()
    bag = write_recording(simulation, tmp_path / "unknown", "ros1", faults.declare(None))

    def run(name: str, *words: str) -> tuple[str, float]:
        """What it prints, and its ATE [m]."""
        command = ["lio", str(bag), "-o", str(tmp_path / name), "--no-map", "--no-report", *words]
        result = CliRunner().invoke(app, command)
        assert result.exit_code == 0, result.stderr
        path = read_trajectory(tmp_path / name / "trajectory.csv")
        return result.stdout, ate_m(path, simulation)

    printed, unknown_m = run("unknown")
    found = np.array(read_summary(tmp_path / "unknown" / "run.json").extrinsic.T_imu_lidar_end)
    off = np.linalg.inv(simulation.T_imu_lidar) @ found
    assert np.linalg.norm(off[:3, 3]) < 0.02
    assert np.degrees(np.linalg.norm(so3.log(off[:3, :3]))) < 0.3
    facts = read_summary(tmp_path / "unknown" / "run.json").extrinsic
    assert np.linalg.norm(off[:3, 3]) < 5.0 * facts.sigma_end_m < 0.25
    assert np.degrees(np.linalg.norm(so3.log(off[:3, :3]))) < 5.0 * facts.sigma_end_deg < 5.0

    line = re.search(r"for other recordings of these sensors:\n  --T-imu-lidar '(xyz_qwxyz: [^']+)'\n", printed)
    assert line is not None, printed
    again, again_m = run("again", "--T-imu-lidar", line[1])
    extrinsic = read_summary(tmp_path / "again" / "run.json").extrinsic
    assert extrinsic.source == "given" and "for other recordings" not in again
    np.testing.assert_allclose(extrinsic.T_imu_lidar_start, found, atol=1e-5)
    assert unknown_m < 0.01 and again_m < 0.01


@pytest.mark.slow
def test_a_run_that_is_not_to_be_trusted_has_found_no_mounting(tmp_path: Path) -> None:
    """Bent by an accelerometer with the other sign it is 7 cm off, and sure of a centimetre."""
    bag = write_recording(about_all_axes(), tmp_path / "flipped", "ros1", faults.declare(None).then(faults.flip_accel()))
    result = CliRunner().invoke(app, ["lio", str(bag), "-o", str(tmp_path / "out"), "--no-map", "--no-report"])
    assert result.exit_code == 3 and "for other recordings" not in result.stdout + result.stderr


@pytest.mark.slow
def test_after_turns_about_all_axes_the_path_is_as_good_as_with_the_true_mounting(tmp_path: Path) -> None:
    """Nearly: within twice its error."""
    simulation, errors = about_all_axes(), []
    for name, fault in (("true", None), ("unknown", faults.declare(None))):
        summary = run_odometry(as_recording(simulation, fault), tmp_path / name, RunConfig(map=MapConfig(save=False)))
        errors.append(ate_m(read_trajectory(tmp_path / name / "trajectory.csv"), simulation))
    off = np.linalg.inv(simulation.T_imu_lidar) @ np.array(summary.extrinsic.T_imu_lidar_end)
    assert np.linalg.norm(off[:3, 3]) < 0.02 and np.degrees(np.linalg.norm(so3.log(off[:3, :3]))) < 0.3
    assert errors[1] < 2.0 * errors[0]
