"""Which runs are of one recording, whatever their settings; and which are not."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.runs.lidar_inertial.summary import ExtrinsicFacts, RecordingFacts, RunSummary
from boxplus.runs.sessions.repeated import RecordingIdentity, refuse_repeated, repeated

NOW, LAST_NS = datetime(2026, 1, 1, tzinfo=UTC), 1_700_000_000_123_456_789
HERE = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def identity(
    way_m: float = 50.0,
    last_ns: int | None = LAST_NS,
    topic: str = "points",
    seed: int = 0,
    count: int = 200,
    first_points: tuple[str | None, ...] | None = None,
) -> RecordingIdentity:
    recording = RecordingFacts(
        path="a.bag", format="ros1", lidar_topic=topic, imu_topic="imu", duration_s=20.0, messages=4200, first_points=first_points
    )
    odometry = RunSummary(
        versions={}, state="finished", process=1, started=NOW, updated=NOW, recording=recording, path_length_m=way_m,
        last_time_ns=last_ns,
        extrinsic=ExtrinsicFacts(source="given", text="", estimation="off", T_imu_lidar_start=np.eye(4).tolist()),
    )  # fmt: skip
    points = np.random.default_rng(seed).uniform(-9.0, 9.0, (count, 3)).astype(np.float32)
    return RecordingIdentity.of(odometry, [LocalMap(0, LAST_NS, LAST_NS, LAST_NS, HERE, np.zeros((6, 6)), 0.0, points, 9)])


def test_another_voxel_is_another_run_of_the_same_recording() -> None:
    runs = {"first": identity(seed=1), "finer": identity(50.6, seed=2), "other": identity(last_ns=LAST_NS + 1, seed=3)}
    assert repeated(runs) == {"finer": "first"}
    with pytest.raises(InputError, match="first and finer, which are of one recording"):
        refuse_repeated(runs)


def test_simulated_recordings_with_the_same_times_went_other_ways() -> None:
    assert not repeated({"first": identity(50.0, seed=1), "second": identity(57.0, seed=2), "still": identity(0.01, seed=3)})


def test_simulated_recordings_with_the_same_times_and_ways_as_long_begin_with_other_points() -> None:
    runs = {"first": identity(seed=1, first_points=("a", None, "c")), "second": identity(seed=2, first_points=("b", None, "d"))}
    assert not repeated(runs)
    assert repeated(runs | {"again": identity(50.6, seed=3, first_points=("a", None, "c"))}) == {"again": "first"}
    assert repeated(runs | {"longer": identity(70.0, seed=3, first_points=("b", None, "d"))}) == {"longer": "second"}


def test_two_lidars_of_one_recording_are_two() -> None:
    assert not repeated({"left": identity(topic="left", seed=1), "right": identity(topic="right", seed=2)})


def test_a_copied_folder_is_told_by_its_maps() -> None:
    assert repeated({"a": identity(last_ns=None, seed=1), "b": identity(last_ns=None, seed=1)}) == {"b": "a"}
    assert not repeated({"a": identity(last_ns=None, count=1), "b": identity(last_ns=None, count=1)})
