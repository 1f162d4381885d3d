"""A run over several LiDARs: facts of each, faults named, the same bits when resumed, and the doctor's findings."""

import json
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from boxplus.manifolds import so3
from boxplus.recordings import Recording, RecordingOptions, open_recording
from boxplus.runs.inspection.diagnosis import diagnose
from boxplus.runs.inspection.lidar_checks import compare_lidars
from boxplus.runs.lidar_inertial.config import MapConfig, RunConfig
from boxplus.runs.lidar_inertial.extrinsic import Extrinsic
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.summary import RunSummary
from boxplus.simulation import Fault, MountedLidar, RosetteLidar, Simulation, SpinningLidar, as_recording, faults, write_recording
from boxplus.simulation.motions import trajectories
from boxplus.simulation.scenarios import Scenario
from boxplus.simulation.worlds import worlds

REAR = "/rear"
T_IMU_REAR = np.eye(4)
T_IMU_REAR[:3, :3] = so3.exp([0.05, -0.1, 3.0])
T_IMU_REAR[:3, 3] = -0.3, 0.05, 0.1
CONFIG = RunConfig(map=MapConfig(save=False))


@cache
def simulation() -> Simulation:
    lidar = SpinningLidar(channels=8, azimuth_steps=150)
    route = trajectories.walk(((-3.0, 0.0), (3.0, 0.0), (3.0, 2.5)), seed=2)
    return Simulation(Scenario("several", worlds.room((14.0, 10.0, 4.0), seed=2), route, lidar), 2, 7.0)


def rear(fault: Fault | None = None) -> tuple[MountedLidar, ...]:
    return (MountedLidar(RosetteLidar(points_per_scan=800), T_IMU_REAR, REAR, fault),)


def run(recording: Recording, folder: Path, **options: object) -> RunSummary:
    given = Extrinsic(simulation().T_imu_lidar, "given", "T_imu_lidar as given", False, "")
    return run_odometry(recording, folder, CONFIG, extrinsic=given, **options)


@pytest.mark.slow
def test_facts_and_faults_of_each_lidar_and_the_same_bits_when_resumed(tmp_path: Path) -> None:
    """The other LiDAR is silent for 1.5 s and its clock is late."""
    recording = as_recording(simulation(), others=rear(faults.drop_scans(1.0, 1.5).then(faults.lidar_clock_offset(0.05))))
    whole = run(recording, tmp_path / "whole")
    first, other = whole.lidars
    assert whole.scans == simulation().scan_count and not whole.scan_gaps
    assert (first.checked, other.checked) == (None, "contradicted")
    assert whole.contradiction is not None and f"LiDAR {REAR} contradicts the first one" in whole.contradiction
    assert whole.contradiction.count("its clock is wrong") == 1
    assert first.merged_points == first.points and 0.9 * other.points < other.merged_points <= other.points
    (gap,) = other.silences
    assert abs(gap.duration_s - 1.5) < 0.25 and 14 <= other.absent_scans <= 17
    assert any(f"{REAR} gave nothing for up to 1." in warning.text for warning in whole.warnings)
    np.testing.assert_allclose(other.T_lidar_other, np.linalg.inv(simulation().T_imu_lidar) @ T_IMU_REAR)
    stored = json.loads((tmp_path / "whole" / "run.json").read_text())
    assert [lidar["topic"] for lidar in stored["lidars"]] == ["/lidar/points", REAR]

    asked = iter(range(10**6))
    run(recording, tmp_path / "parts", should_stop=lambda: next(asked) > 80)
    resumed = run(recording, tmp_path / "parts", resume=True)
    assert resumed.resumed == 1 and resumed.lidars == whole.lidars and resumed.contradiction == whole.contradiction
    for name in ("trajectory.tum", "trajectory.csv"):
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_comparing_a_sound_pair_finds_it_sound() -> None:
    finding, *merging = compare_lidars(as_recording(simulation(), others=rear()), lambda _: None)
    assert [(entry.key, entry.verdict) for entry in merging] == [(f"merging of {name}", "ok") for name in ("/lidar/points", REAR)]
    assert (finding.key, finding.value, finding.verdict) == (f"agreement of {REAR}", "agree", "ok")


def test_inspect_compares_the_lidars(tmp_path: Path) -> None:
    path = write_recording(simulation(), tmp_path / "two", "ros1", others=rear())
    T = T_IMU_REAR @ np.block([[so3.exp([0.0, 0.0, 0.15]), np.zeros((3, 1))], [0, 0, 0, 1]])
    wrong = (np.linalg.inv(simulation().T_imu_lidar) @ T).tolist()
    options = RecordingOptions(
        lidar_topic="/lidar/points", imu_topic="none", other_lidars=({"topic": REAR, "T_lidar_other": wrong},)
    )
    evidence = {entry.key: entry for entry in diagnose(path, options).evidence}
    assert evidence[f"lidar_rate of {REAR}"].value == "10.0 Hz" and evidence["lidar_rate"].verdict == "ok"
    agreement = evidence[f"agreement of {REAR}"]
    assert agreement.verdict == "error" and agreement.value == "contradicted: pose" and "turned by 8." in agreement.text


@pytest.mark.slow
@pytest.mark.parametrize("offset_s", [0.0, 0.03, 0.06])
def test_without_an_imu_the_own_path_of_the_first_lidar_tells_a_clock_that_is_off(tmp_path: Path, offset_s: float) -> None:
    """The common path followed such a clock: 30 and 60 ms were found as 15 and 8, as agreement."""
    other = MountedLidar(SpinningLidar(channels=8, azimuth_steps=300), T_IMU_REAR, REAR)
    route = trajectories.walk(((-3.0, 0.0), (3.0, 0.0), (3.0, 2.5)), seed=2)
    lidar = SpinningLidar(channels=16, azimuth_steps=300)
    simulated = Simulation(Scenario("several", worlds.room((14.0, 10.0, 4.0), seed=2), route, lidar), 2, 10.5)
    path = write_recording(simulated, tmp_path / "two", "ros1", others=(other,))
    options = RecordingOptions(
        lidar_topic="/lidar/points", imu_topic="none", other_lidars=({"topic": REAR, "time_offset_s": offset_s},)
    )
    with open_recording(path, options) as recording:
        summary = run_odometry(recording, tmp_path / "out", CONFIG)
    judged = summary.lidars[1]
    if not offset_s:
        assert judged.checked == "agree" and summary.contradiction is None
    else:
        assert judged.checked == "contradicted" and "its clock is wrong" in (summary.contradiction or "")
        found = re.search(r"time_offset_s of ([-+][\d.]+) s more", summary.contradiction or "")
        assert found is not None and abs(float(found[1]) + offset_s) < 0.2 * offset_s
