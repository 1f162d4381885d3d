"""Several LiDARs of one bag come as one stream of scans, each read, placed and timed in its own way; the rest is refused."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from boxplus.errors import AmbiguityError, InputError, RecordingError
from boxplus.manifolds import so3
from boxplus.recordings import OtherLidar, RecordingOptions, open_recording
from boxplus.sensors.lidar.scan import Scan
from boxplus.simulation import (
    MountedLidar,
    RosetteLidar,
    Simulation,
    SpinningLidar,
    as_recording,
    faults,
    simulate,
    write_recording,
)

FRONT, REAR = "/lidar/points", "/rear"
T_IMU_REAR = np.eye(4)
T_IMU_REAR[:3, :3] = so3.exp([0.05, -0.1, 3.0])
T_IMU_REAR[:3, 3] = -0.3, 0.05, 0.1


def simulation() -> Simulation:
    return simulate("walk", duration_s=1.2, lidar=SpinningLidar(azimuth_steps=40))


def rear(fault: faults.Fault | None = None) -> MountedLidar:
    return MountedLidar(RosetteLidar(points_per_scan=300, rate_hz=15.0), T_IMU_REAR, REAR, fault)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(simulation(), tmp_path_factory.mktemp("two") / "two", "ros1", others=(rear(),))


def scans(path: Path, **options: object) -> list[Scan]:
    with open_recording(path, RecordingOptions(lidar_topic=FRONT, **options)) as recording:
        return [event for event in recording if isinstance(event, Scan)]


def test_a_bag_gives_the_scans_of_the_simulation_merged(bag: Path) -> None:
    read = scans(bag, other_lidars=(REAR,))
    live = [event for event in as_recording(simulation(), others=(rear(),)) if isinstance(event, Scan)]
    assert len(read) == len(live) and sum(len(one) for one in read) == sum(len(one) for one in live)
    for one, other in zip(read, live, strict=True):
        np.testing.assert_array_equal(one.lidar, other.lidar)
        np.testing.assert_allclose(one.p_lidar, other.p_lidar, atol=1e-4)
        np.testing.assert_allclose(one.time_ns, other.time_ns, rtol=0, atol=500)


def test_counts_and_evidence_name_the_lidars_and_every_pass_begins_anew(bag: Path) -> None:
    with open_recording(bag, RecordingOptions(lidar_topic=FRONT, other_lidars=(REAR,))) as recording:
        first = [(share.name, share.points, share.merged) for share in recording.lidars]
        for _ in range(2):
            points = sum(len(event) for event in recording if isinstance(event, Scan))
            shares = recording.lidars
            assert [share.name for share in shares] == [FRONT, REAR] and sum(share.merged for share in shares) == points
        keys = {evidence.key for evidence in recording.info.evidence}
    assert first == []
    assert {f"T_lidar_other of {REAR}", f"clock of {REAR}", f"point_time_unit of {REAR}"} <= keys
    np.testing.assert_allclose(
        recording.info.other_lidars[0].T_lidar_other, np.linalg.inv(simulation().T_imu_lidar) @ T_IMU_REAR, atol=1e-9
    )


def test_a_given_pose_clock_and_range_replace_what_the_bag_says(bag: Path) -> None:
    T = np.eye(4)
    T[:3, 3] = 0.0, 0.0, 5.0
    given = OtherLidar(topic=REAR, T_lidar_other=T.tolist(), time_offset_s=0.02, min_range=4.0)
    plain, changed = (scans(bag, other_lidars=(one,)) for one in (REAR, given))
    times = [np.concatenate([one.of_lidar(1).time_ns for one in run]) for run in (plain, changed)]
    assert set(times[1] - 20_000_000) <= set(times[0])
    points = np.concatenate([one.of_lidar(1).p_lidar for one in changed])
    assert np.linalg.norm(points - T[:3, 3].astype(np.float32), axis=1).min() >= 4.0 - 1e-4


def test_a_text_is_a_topic_or_yaml() -> None:
    assert OtherLidar.model_validate("/rear").topic == "/rear"
    assert OtherLidar.model_validate("{topic: /rear, time_offset_s: 0.05}").time_offset_s == 0.05
    with pytest.raises(ValidationError, match="YAML"):
        OtherLidar.model_validate("{topic: [")


def test_an_unknown_pose_a_foreign_clock_and_a_missing_first_lidar_are_refused(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--lidar-topic"):
        RecordingOptions(other_lidars=(REAR,))
    with pytest.raises(InputError, match="once"):
        RecordingOptions(lidar_topic=REAR, other_lidars=(REAR,))
    with pytest.raises(AmbiguityError, match="--other-lidars"):
        open_recording(bag)
    with pytest.raises(RecordingError, match="/side"):
        scans(bag, other_lidars=("/side",))
    undeclared = write_recording(simulation(), tmp_path / "bare", "ros1", others=(rear(faults.declare(None)),))
    with pytest.raises(RecordingError, match="pose of /rear in the frame of /lidar/points"):
        scans(undeclared, other_lidars=(REAR,))
    late = write_recording(simulation(), tmp_path / "late", "ros1", others=(rear(faults.lidar_clock_offset(30.0)),))
    with pytest.raises(RecordingError, match=r"time_offset_s of /rear: about -(29\.9|30\.0)"):
        scans(late, other_lidars=({"topic": REAR, "point_time_reference": "scan_start"},))
    with pytest.raises(AmbiguityError, match=r"before their stamps.*keys of --other-lidars"):
        scans(late, other_lidars=(REAR,))


def test_only_bags_hold_several(tmp_path: Path) -> None:
    path = tmp_path / "flight.pcap"
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="several LiDARs"):
        open_recording(path, RecordingOptions(lidar_topic=FRONT, other_lidars=(REAR,)))
