"""Fleets: every recording a task, those that met in one map, what failed named, what is finished kept."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.maps.descriptors.features import Features
from boxplus.runs.fleet import fleet_run, tasks
from boxplus.runs.fleet.executor import InProcess, RayExecutor, TaskEnd
from boxplus.runs.fleet.fleet_run import FleetFolder, run_fleet
from boxplus.runs.fleet.recordings import find_recordings, holds_recordings
from boxplus.runs.fleet.status import RecordingStatus
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.settings_file import load_settings
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.summary import SlamSummary
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.candidates import candidate_pairs
from tests.runs.sessions.runs import written_run

DRIFT = DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
QUICK = ["sessions.slam={least_overlap: 0.6, rival_fit: 0.85, descriptor: {candidates: 2}}", "map.voxel=0.2"]
ROUTES = {
    "monday": [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]],
    "friday": [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]],
}


def drive(name: str, recording: str, folder: str, config: SlamRunConfig) -> RecordingStatus:
    """In place of the odometry: a folder as it leaves one, or what a recording that cannot be read gets."""
    del config
    if name not in ROUTES:
        return RecordingStatus(name=name, recording=recording, state="failed", error="expected a bag – got none – look for it")
    written_run(Path(folder), city(2, 2, seed=5), ROUTES[name], DRIFT, seed=len(name) + len(recording) % 2)
    return RecordingStatus(name=name, recording=recording, state="finished", scans=50)


class Backwards:
    """Tasks in another order, and one pair that gets lost."""

    def __init__(self, lost: int | None = None) -> None:
        self._lost = lost

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> Iterator[TaskEnd]:
        for number in reversed(range(len(arguments))):
            if number == self._lost and function is fleet_run.meet_runs:
                yield TaskEnd(number, error="lost 4 times: the worker died")
            else:
                yield TaskEnd(number, function(*arguments[number]))


@pytest.fixture(scope="module")
def merging() -> MergeConfig:
    return load_settings(MergeConfig, None, QUICK)


def test_recordings_that_met_are_joined_and_failed_ones_named(
    tmp_path: Path, merging: MergeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    met: dict[tuple[str, str], Any] = {}

    def meet_once(folders: Any, names: tuple[str, str], numbers: Any, config: Any) -> Any:
        """The same two drives meet in every fleet here."""
        if names not in met:
            met[names] = tasks.meet_runs(folders, names, numbers, config)
        return met[names]

    monkeypatch.setattr(fleet_run, "run_recording", drive)
    monkeypatch.setattr(fleet_run, "meet_runs", meet_once)
    recordings = {name: Path(name) for name in ("friday", "broken", "monday")}
    stages = []
    status = run_fleet(recordings, tmp_path / "a", InProcess(), None, merging, report=lambda s: stages.append(s.stage))
    assert status.joined == ["friday", "monday"] and status.pairs_joined == status.pairs_looked_at == 1
    assert [own.name for own in status.failed] == ["broken"] and "look for it" in str(status.failed[0].error)
    assert stages == sorted(stages, key=["recordings", "pairs", "map", "finished"].index)
    assert json.loads((tmp_path / "a" / "fleet.json").read_text())["stage"] == "finished"
    # The order in which tasks end changes nothing.
    run_fleet(recordings, tmp_path / "b", Backwards(), None, merging)
    first, second = (FleetFolder(tmp_path / name).merged for name in "ab")
    assert (first / "map.ply").read_bytes() == (second / "map.ply").read_bytes()
    assert (first / "encounters.csv").read_bytes() == (second / "encounters.csv").read_bytes()
    # A pair whose task is lost is said to be, and is not joined.
    lost = run_fleet(recordings, tmp_path / "b", Backwards(lost=0), None, merging)
    assert lost.joined == [] and lost.pairs_failed == ["friday and monday: lost 4 times: the worker died"]


def test_a_recording_that_is_finished_is_not_run_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config, folder = SlamRunConfig(), SlamFolder(tmp_path)
    now = datetime(2026, 1, 1, tzinfo=UTC)
    SlamSummary(versions={}, state="finished", started=now, updated=now, recording="r", scans=7).write(folder.summary)
    folder.config.write_text(dump_slam_config(config), encoding="utf-8")
    status = tasks.run_recording("r", str(tmp_path / "none.bag"), str(tmp_path), config)
    assert (status.state, status.scans, status.seconds) == ("finished", 7, 0.0)
    folder.config.write_text("other settings", encoding="utf-8")
    again = tasks.run_recording("r", str(tmp_path / "none.bag"), str(tmp_path), config)
    assert again.state == "failed" and "check the path" in str(again.error)


def test_parts_of_a_bag_without_metadata_are_one_recording(tmp_path: Path) -> None:
    """The readers open such a folder as one; taken for several, each part had a start and a map of its own."""
    parts = tmp_path / "parts"
    parts.mkdir()
    for name in ("part_0.mcap", "part_1.mcap"):
        (parts / name).touch()
    assert not holds_recordings(parts)
    (parts / "other.bag").touch()
    assert holds_recordings(parts)
    ros2 = tmp_path / "days" / "monday"
    ros2.mkdir(parents=True)
    (ros2 / "metadata.yaml").touch()
    assert holds_recordings(tmp_path / "days") and not holds_recordings(ros2)


def test_recordings_are_found_in_a_folder_or_a_list(tmp_path: Path) -> None:
    for name in ("b.bag", "a.mcap", "notes.md"):
        (tmp_path / name).touch()
    (tmp_path / "ros2").mkdir()
    (tmp_path / "ros2" / "metadata.yaml").touch()
    assert list(find_recordings(tmp_path)) == ["a", "b", "ros2"]
    listed = tmp_path / "fleet.txt"
    listed.write_text("# two of one name\nb.bag\n\nros2\nb.bag\n")
    assert list(find_recordings(listed)) == ["b", "ros2", "b_2"]
    for text, message in (("c.bag", "nothing at"), ("s3://fleet/a.bag", "shared folder"), ("", "one a line")):
        listed.write_text(text)
        with pytest.raises(InputError, match=message):
            find_recordings(listed)
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "b.bag"):
        with pytest.raises(InputError, match="recordings"):
            find_recordings(path)
    with pytest.raises(InputError, match="a recording at least"):
        run_fleet({}, tmp_path / "out", InProcess())


def test_pairs_grow_with_the_number_of_sessions_not_its_square() -> None:
    """Sessions along a road, each of which shares a place with the next one."""
    random = np.random.default_rng(1)

    def road(count: int) -> list[list[Features]]:
        places = [
            Features(random.uniform(-40, 40, (60, 2)), random.integers(0, 2**63, (60, 4)).astype(np.uint64))
            for _ in range(count + 1)
        ]
        return [[places[k], places[k + 1]] for k in range(count)]

    for count in (5, 40):
        assert candidate_pairs(road(count), per_session=3) == [(k, k + 1) for k in range(count - 1)]
    same = [road(1)[0]] * 12
    assert len(candidate_pairs(same, per_session=2)) <= 24


def test_a_task_that_fails_ends_alone() -> None:
    ends = list(InProcess().run(lambda x: 1 // x, [(1,), (0,), (2,)]))
    assert [end.value for end in ends] == [1, None, 0]
    assert ends[1].error is not None and ends[1].error.startswith("ZeroDivisionError")


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"boxplus\[fleet\]"):
        RayExecutor()
