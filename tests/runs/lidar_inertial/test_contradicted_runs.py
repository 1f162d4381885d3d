"""A run over sensors with which something is wrong is refused, or ends with a headline that names what it is."""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.manifolds import so3
from boxplus.recordings.open import open_recording
from boxplus.recordings.options import RecordingOptions
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.summary import RunSummary
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, ImuModel, Scenario, Simulation, SpinningLidar, faults, mounting, write_recording
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.motions import manoeuvres
from boxplus.simulation.worlds import worlds
from boxplus.systems.lidar_inertial_odometry.config import LioConfig
from boxplus.systems.lidar_inertial_odometry.odometry import LidarInertialOdometry

LIDAR = SpinningLidar(channels=16, azimuth_steps=300)
SCAN_S, DURATION_S = 0.1, 9.0
FEET = 3.28084
NO_MAP = RunConfig(map=MapConfig(save=False))
QUARTERS = r"turn about axes 1(19|20|21) deg apart"  # a cyclic permutation of axes is a turn by 120 degrees


@lru_cache(maxsize=2)
def handheld(seed: int) -> Simulation:
    """At rest in a room of 12 x 9 x 4 m for 1.5 s, then carried about and swung about all axes."""
    random = np.random.default_rng(seed)
    T = mounting(*random.uniform(-180.0, 180.0, 3), tuple(random.uniform(-0.2, 0.2, 3)))
    motion = manoeuvres.handheld(DURATION_S, (-3.0, -2.0, 1.0), (3.0, 2.0, 2.5), 1.0, 1.2, standstill_s=1.5, seed=seed)
    return Simulation(Scenario("handheld", worlds.room(seed=seed), motion, LIDAR, ImuModel(), T), seed, DURATION_S)


def tilted(degrees: float) -> Fault:
    T = handheld(4).T_imu_lidar.copy()
    T[:3, :3] = so3.exp(np.deg2rad(degrees) * np.array([0.6, 0.0, 0.8])) @ T[:3, :3]
    return faults.declare(T, f"T_imu_lidar {degrees:g} deg off")


def finished(simulation: Simulation, fault: Fault | None, folder: Path) -> RunSummary:
    summary = run_odometry(as_recording(simulation, fault), folder / "run", NO_MAP)
    assert summary.state == "finished" and summary.scans > 80
    return summary


@pytest.mark.slow
def test_sound_sensors_end_without_a_word(tmp_path: Path) -> None:
    summary = finished(handheld(4), None, tmp_path)
    assert summary.contradiction is None and summary.warnings == [] and set(summary.status) == {"ok"}


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "named"), [
    (faults.flip_accel(), r"accelerometer \(1 is right\): its sign is flipped, gravity instead of specific force"),
    (faults.lidar_clock_offset(0.08), r"the LiDAR's times are (7[5-9]|8[0-5]) ± \d+ ms late on the IMU's clock"),
    (tilted(10.0), r"turn about axes (9|10|11) deg apart under the given T_imu_lidar"),
    (faults.other_imu(handheld(9).imu_samples), "the IMU is not the one of this LiDAR"),
    (faults.scale_points(1.1), r"accelerations are 1\.(0[6-9]|1[0-4]) ± .* the points are not in metres"),
    (faults.scale_points(FEET), r"the points are not in metres \(feet are 3\.28\)"),
    (faults.permute_gyro(), QUARTERS),
    (faults.permute_points(), QUARTERS),
], ids=["accel sign", "lidar clock", "extrinsic", "other imu", "scale", "feet", "gyro axes", "point axes"])  # fmt: skip
def test_the_headline_names_what_is_wrong(fault: Fault, named: str, tmp_path: Path) -> None:
    """Exit code 3, whose reason stands in the first line and not only among the warnings."""
    summary = finished(handheld(4), fault, tmp_path)
    assert summary.contradiction is not None and re.search(named, summary.contradiction), summary.contradiction
    assert f"finished: {summary.scans} scans" in summary.describe_state()
    assert summary.describe_state().endswith(f"; not to be trusted: {summary.contradiction}")


@pytest.mark.slow
@pytest.mark.parametrize(("fault", "told", "right"), [
    (None, "deg/s", "rad/s"), (faults.gyro_in_deg(), "rad/s", "deg/s"),
], ids=["rad taken for deg", "deg taken for rad"])  # fmt: skip
def test_a_gyroscope_in_another_unit_than_was_said_is_refused(fault: Fault | None, told: str, right: str, tmp_path: Path) -> None:
    bag = write_recording(handheld(4), tmp_path / "bag", "ros1", fault)
    options = RecordingOptions.model_validate({"gyro_unit": told})
    with open_recording(bag, options) as recording, pytest.raises(InputError) as caught:
        run_odometry(recording, tmp_path / "run", NO_MAP)
    assert caught.value.expected == f"angular velocities in {told}, as they are read"
    assert f"(reading a recording: --gyro-unit {right})" in caught.value.got and caught.value.advice == "give --gyro-unit"
    assert re.search(r"turned 5[678] times as far", caught.value.got)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [
    faults.flip_accel(), faults.gyro_in_rad_as_deg(), faults.scale_points(FEET), faults.permute_points(), tilted(10.0),
], ids=["accel sign", "gyro unit", "feet", "point axes", "extrinsic"])  # fmt: skip
def test_the_estimator_itself_says_so_within_a_second_of_the_first_wrong_pose(fault: Fault) -> None:
    """Whoever pushes scans and samples has no comparison beforehand: `contradiction` tells soon after the error shows."""
    simulation = handheld(4)
    T = fault.declared_extrinsic(simulation.T_imu_lidar)
    assert T is not None
    odometry = LidarInertialOdometry(LioConfig(T_imu_lidar=tuple(map(tuple, T.tolist()))))
    wrong_ns = told_ns = None
    origin: tuple[np.ndarray, np.ndarray] | None = None
    for event in fault.events(simulation.events()):
        for estimate in odometry.push_scan(event) if isinstance(event, Scan) else odometry.push_imu(event):
            true = simulation.ground_truth(np.array([estimate.time_ns]))
            if origin is None:
                R = estimate.state.R_world_imu @ true.R_world_imu[0].T
                origin = R, estimate.state.p_world_imu - R @ true.p_world_imu[0]
            error = estimate.state.p_world_imu - origin[0] @ true.p_world_imu[0] - origin[1]
            covariance = estimate.pose_covariance[3:, 3:] + 1e-12 * np.eye(3)
            beyond = error @ np.linalg.solve(covariance, error) > 5.64**2 and np.linalg.norm(error) > 0.05
            wrong_ns = estimate.time_ns if wrong_ns is None and beyond else wrong_ns
            told_ns = estimate.time_ns if told_ns is None and odometry.contradiction is not None else told_ns
    odometry.flush()
    assert wrong_ns is not None and told_ns is not None
    assert (told_ns - wrong_ns) * 1e-9 <= 1.0 + SCAN_S
