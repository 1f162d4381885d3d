"""While a run goes on: a LiDAR that does not see what the first one saw is named, one that cannot be checked is said to be so."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.filtering.nav_state import NavState
from boxplus.manifolds import so3
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import Fault, MountedLidar, RosetteLidar, Simulation, SpinningLidar, as_recording, faults
from boxplus.simulation.motions import trajectories
from boxplus.simulation.scenarios import Scenario
from boxplus.simulation.worlds import worlds
from boxplus.systems.several_lidars.watch import LidarWatch

REAR = "/rear"
T_IMU_REAR = np.eye(4)
T_IMU_REAR[:3, :3] = so3.exp([0.05, -0.1, 3.0])
T_IMU_REAR[:3, 3] = -0.3, 0.05, 0.1


@cache
def simulation() -> Simulation:
    lidar = SpinningLidar(channels=8, azimuth_steps=150)
    route = trajectories.walk(((-3.0, 0.0), (3.0, 0.0), (3.0, 2.5)), seed=2).starting_at(3.0)
    return Simulation(Scenario("several", worlds.room((14.0, 10.0, 4.0), seed=2), route, lidar), 2, 6.0)


def estimate(scan: Scan, status: str = "ok") -> Any:
    """An estimate that is exact, of a scan corrected for motion exactly."""
    truth, T = simulation(), simulation().T_imu_lidar
    end, motion = truth.ground_truth([scan.end_ns]), truth.ground_truth(scan.time_ns)
    state = replace(
        NavState.identity(),
        R_world_imu=end.R_world_imu[0],
        p_world_imu=end.p_world_imu[0],
        R_imu_lidar=T[:3, :3],
        p_imu_lidar=T[:3, 3],
    )
    p_imu = scan.p_lidar.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    p_world = np.einsum("nij,nj->ni", motion.R_world_imu, p_imu) + motion.p_world_imu
    back = ((p_world - state.p_world_imu) @ state.R_world_imu - T[:3, 3]) @ T[:3, :3]
    return SimpleNamespace(time_ns=scan.end_ns, state=state, status=status, p_lidar=back.astype(np.float32), lidar=scan.lidar)


def watched(fault: Fault | None = None, status: str = "ok") -> tuple[LidarWatch, list[str]]:
    recording = as_recording(simulation(), others=(MountedLidar(RosetteLidar(points_per_scan=800), T_IMU_REAR, REAR, fault),))
    watch = LidarWatch([REAR], [recording.info.other_lidars[0].T_lidar_other])
    told = []
    for event in recording:
        if isinstance(event, Scan):
            watch.add_scan(event)
            told += watch.add_estimate(estimate(event, status))
    return watch, told + watch.finish()


def test_a_sound_pair_agrees() -> None:
    watch, told = watched()
    judgement, windows, contradicted = watch.judgements()[REAR]
    assert (told, watch.contradiction, windows, contradicted) == ([], None, 1, 0)
    assert judgement is not None and judgement.verdict == "agree"


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (faults.lidar_clock_offset(0.05), "its clock is wrong"),
        (faults.declare(T_IMU_REAR @ np.block([[so3.exp([0.0, 0.1, 0.1]), np.zeros((3, 1))], [0, 0, 0, 1]])), "T_lidar_other is"),
    ],
)
def test_a_wrong_clock_or_pose_is_a_contradiction(fault: Fault, says: str) -> None:
    watch, told = watched(fault)
    assert watch.contradiction is not None and told == [watch.contradiction]
    assert f"LiDAR {REAR} contradicts the first one" in watch.contradiction and says in watch.contradiction


def test_what_could_not_be_checked_is_said() -> None:
    watch, told = watched(status="lost")
    assert watch.contradiction is None
    assert len(told) == 1 and f"{REAR} could not be checked" in told[0]


def test_a_lidar_without_a_point_in_range_is_not_called_too_short() -> None:
    """As where it measures in millimetres, and max_range leaves all of it out."""
    watch, told = LidarWatch([REAR], [T_IMU_REAR]), list[str]()
    for event in simulation():
        if isinstance(event, Scan):
            alone = replace(event, lidar=np.zeros(len(event), np.uint8))
            watch.add_scan(alone)
            told += watch.add_estimate(estimate(alone))
    told += watch.finish()
    assert watch.contradiction is None
    assert len(told) == 1 and f"no point of LiDAR {REAR} was merged" in told[0] and "unit of length" in told[0]


def repeated(
    T: np.ndarray, every: int = 1, noise: float = 0.0, silent: int = 0, *, is_moved: bool = False
) -> tuple[LidarWatch, list[str]]:
    """The first LiDAR, and its points once more, every so many of them, as those of another one declared at T.

    They are those that the first one has in its frame or, `is_moved`, what they are in the frame that T declares.
    In the second of the first `silent` scans the first LiDAR has no points, as where a packet is lost.
    """
    random = np.random.default_rng(3)
    watch, told, scans = LidarWatch([REAR], [T]), list[str](), 0
    for event in simulation():
        if isinstance(event, Scan):
            again = event.p_lidar[::every].astype(np.float64)
            if is_moved:
                again = ((again - T[:3, 3]) @ T[:3, :3]).astype(np.float32).astype(np.float64)
            again = again @ T[:3, :3].T + T[:3, 3]
            again += noise * random.standard_normal(again.shape)
            p = np.concatenate([event.p_lidar, again.astype(np.float32)])
            lidar = np.repeat(np.array([0, 1], np.uint8), [len(event), len(again)])
            merged = replace(event, p_lidar=p, time_ns=np.concatenate([event.time_ns, event.time_ns[::every]]), lidar=lidar)
            if scans < silent and scans % 2:
                merged = replace(merged, p_lidar=p[lidar == 1], time_ns=merged.time_ns[lidar == 1], lidar=lidar[lidar == 1])
            scans += 1
            watch.add_scan(replace(merged, intensity=None))
            told += watch.add_estimate(estimate(replace(merged, intensity=None)))
    return watch, told + watch.finish()


@pytest.mark.parametrize("T", [np.eye(4), T_IMU_REAR])
@pytest.mark.parametrize(("every", "is_moved"), [(1, False), (3, False), (3, True)])
def test_a_lidar_that_is_given_twice_is_named(T: np.ndarray, every: int, is_moved: bool) -> None:
    watch, told = repeated(T, every, is_moved=is_moved)
    assert watch.contradiction is not None and told == [watch.contradiction]
    assert watch.contradiction.startswith(
        "LiDAR /rear is none of its own: its points are those of the first one, to a millimetre"
    )
    judgement, _, _ = watch.judgements()[REAR]
    assert judgement is not None and (judgement.verdict, judgement.cause) == ("contradicted", "the same")


def test_a_lidar_that_is_given_twice_is_named_though_the_first_one_drops_out() -> None:
    """A scan in which one of the two has no points says nothing of them."""
    watch, told = repeated(np.eye(4), silent=8)
    assert watch.contradiction is not None and told == [watch.contradiction]
    assert "its points are those of the first one" in watch.contradiction


def test_what_measures_the_same_surfaces_is_another_lidar() -> None:
    watch, _ = repeated(np.eye(4), noise=0.01)
    assert watch.contradiction is None
