"""Fleets: every recording a task, those that met in one map, what failed named, what is finished kept."""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.maps.tiles.store import TileStore
from boxplus.recordings.recording import Recording
from boxplus.runs.fleet import fleet_run, tasks
from boxplus.runs.fleet.executor import InProcess, RayExecutor, TaskEnd
from boxplus.runs.fleet.fleet_run import run_fleet
from boxplus.runs.fleet.recordings import find_recordings, holds_recordings
from boxplus.runs.fleet.status import RecordingStatus
from boxplus.runs.fleet.store import open_store
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.sessions import joined
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.merge_run import merge_runs
from boxplus.runs.sessions.summary import read_merge_summary
from boxplus.runs.settings_file import load_settings
from boxplus.runs.slam.config import SlamRunConfig, dump_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.summary import SlamSummary
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.config import SessionsConfig
from boxplus.systems.sessions.encounter import Meeting
from boxplus.systems.sessions.meeting import meet
from boxplus.systems.sessions.sessions import place_sessions
from tests.runs.sessions.runs import written_run

DRIFT = DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
QUICK = ["sessions.slam={least_overlap: 0.6, rival_fit: 0.85, descriptor: {candidates: 2}}", "map.voxel=0.2"]
OBJECTS = "memory://fleet"
ROUTES = {
    "monday": [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]],
    "friday": [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]],
}


def drive(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
    """In place of the odometry: a folder as it leaves one, or what a recording that cannot be read gets."""
    del config
    if name not in ROUTES:
        return RecordingStatus(name=name, recording=recording, state="failed", error="expected a bag – got none – look for it")
    with open_store(store).writing(f"runs/{name}") as folder:
        written_run(folder, city(2, 2, seed=5), ROUTES[name], DRIFT, seed=len(name) + len(recording) % 2)
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


@pytest.mark.slow
def test_recordings_that_met_are_joined_and_failed_ones_named(
    tmp_path: Path, merging: MergeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked_at = []

    def meet_once(place: Any, query: Any, config: Any, numbers: Any) -> Meeting:
        looked_at.append(numbers)
        return meet(place, query, config, numbers)

    monkeypatch.setattr(fleet_run, "run_recording", drive)
    monkeypatch.setattr(tasks, "meet", meet_once)
    recordings = {name: Path(name) for name in ("friday", "broken", "monday")}
    stages = []
    status = run_fleet(recordings, tmp_path / "a", InProcess(), None, merging, report=lambda s, _: stages.append(s.stage))
    assert status.joined == ["friday", "monday"] and status.pairs_joined == status.pairs_looked_at == 1
    assert [own.name for own in status.failed] == ["broken"] and "look for it" in str(status.failed[0].error)
    assert status.doubts == [f"broken failed: {status.failed[0].error}"]
    assert stages == sorted(stages, key=["recordings", "pairs", "map", "finished"].index)
    written = json.loads((tmp_path / "a" / "fleet.json").read_text())
    assert written["stage"] == "finished" and [own["joined"] for own in written["recordings"]] == [True, False, True]
    merged = tmp_path / "a" / "merged"
    assert read_merge_summary(merged / "run.json").map_points == status.map_points == TileStore.open(merged / "map").point_count
    assert not (tmp_path / "a" / "map_parts").exists()
    whole = TileStore.open(merged / "map")
    assert whole.manifest.segments == len(list((merged / "map").rglob("*.ply"))) > 1 and whole.report == ()
    shutil.copytree(merged / "map", tmp_path / "half lost")
    next((tmp_path / "half lost").rglob("*.ply")).unlink()
    assert (
        f"1 of the {whole.manifest.segments} segments that were written are not there"
        in TileStore.open(tmp_path / "half lost").damage[0]
    )
    # The map is that of 'boxplus map merge', which one process writes.
    shutil.copytree(tmp_path / "a" / "runs", tmp_path / "b" / "runs")
    shutil.copytree(tmp_path / "a" / "pairs", tmp_path / "b" / "pairs")
    meeting = tasks.meet_runs(str(tmp_path / "a"), ("friday", "monday"), (0, 1), merging.sessions)
    runs = [tmp_path / "a" / "runs" / name for name in ("friday", "monday")]
    merge_runs(runs, tmp_path / "whole", merging, align=lambda own: place_sessions(own, [meeting], merging.sessions))
    names = ["map.ply", "encounters.csv", *(f"sessions/{name}.csv" for name in ("friday", "monday"))]
    assert [(merged / name).read_bytes() for name in names] == [(tmp_path / "whole" / name).read_bytes() for name in names]
    # The order in which tasks end changes nothing, and pairs that were looked at are not looked at again.
    assert looked_at == [(0, 1)]
    monkeypatch.setattr(fleet_run, "run_recording", lambda _, name, recording, config: found[name])
    found = {own.name: own for own in status.recordings}
    run_fleet(recordings, tmp_path / "b", Backwards(), None, merging)
    files = sorted(path.relative_to(merged) for path in merged.rglob("*") if path.is_file() and path.name != "run.json")
    assert len(files) > 8
    assert all((merged / file).read_bytes() == (tmp_path / "b" / "merged" / file).read_bytes() for file in files)
    # Nor does an object store, which has no merged file.
    for file in (tmp_path / "a").rglob("*"):
        if file.is_file() and file.relative_to(tmp_path / "a").parts[0] in ("runs", "pairs"):
            open_store(OBJECTS).write(file.relative_to(tmp_path / "a").as_posix(), file.read_bytes())
    again = run_fleet(recordings, OBJECTS, InProcess(), None, merging)
    assert again.joined == status.joined and looked_at == [(0, 1)]
    stored = open_store(OBJECTS)
    assert all(
        stored.read(f"merged/{file.as_posix()}") == (merged / file).read_bytes() for file in files if file.name != "map.ply"
    )
    with pytest.raises(InputError, match="a folder, to remove what was seen through – got memory"):
        run_fleet(recordings, OBJECTS, InProcess(), remove_dynamic=True)
    # A join that only a meeting with a doubt bears out is none: nobody could be asked, and it is said to be left out.
    shutil.copytree(tmp_path / "a" / "runs", tmp_path / "d" / "runs")
    monkeypatch.setattr(fleet_run, "meet_runs", lambda *_: replace(meeting, doubt="are at two places of a kind, perhaps"))
    doubted = run_fleet(recordings, tmp_path / "d", InProcess(), None, merging)
    why = "monday and friday: joined in doubt only: the two are at two places of a kind, perhaps"
    assert doubted.joined == [] and doubted.pairs_in_doubt == [why] and doubted.contradictions == []
    assert f"left out of the joint map: {why}" in doubted.doubts
    assert [own.apart_because for own in doubted.recordings if own.state == "finished"] == [[why], [why]]
    monkeypatch.setattr(fleet_run, "meet_runs", tasks.meet_runs)
    # A pair whose task is lost is said to be, and is not joined. Nor does an earlier map go for it.
    kept = (tmp_path / "b" / "merged" / "run.json").read_bytes()
    lost = run_fleet(recordings, tmp_path / "b", Backwards(lost=0), None, merging)
    assert lost.pairs_failed == ["friday and monday: lost 4 times: the worker died"]
    assert lost.earlier_map_kept == ["no two of the recordings met"] and lost.map_points == status.map_points
    assert [text for text in lost.doubts if "the joint map of an earlier fleet stays as it was, as" in text]
    assert not [text for text in lost.doubts if "there is no joint map" in text]
    # A map with a doubt is written where there is none, and where one with a doubt is, but not over a sound one.
    scale = "friday has another scale: it fits the others best with its lengths times 1.02"
    with monkeypatch.context() as patched:
        patched.setattr(joined, "_other_scales", lambda _: {0: (scale, False)})
        (tmp_path / "b" / "merged").rename(tmp_path / "b" / "merged.boxplus-earlier")  # killed between two renames
        for remove_dynamic in (False, True):
            worse = run_fleet(recordings, tmp_path / "b", InProcess(), None, merging, remove_dynamic=remove_dynamic)
            assert worse.earlier_map_kept == [scale] and worse.map_doubts == [] and worse.joined == ["friday", "monday"]
            assert any(scale in text for text in worse.doubts)
            assert (tmp_path / "b" / "merged" / "run.json").read_bytes() == kept
        shutil.move(tmp_path / "b" / "merged", tmp_path / "earlier")
        for _ in range(2):
            first = run_fleet(recordings, tmp_path / "b", InProcess(), None, merging)
            assert first.earlier_map_kept == [] and first.map_doubts == [scale]
            assert first.joined == ["friday", "monday"]
    shutil.rmtree(tmp_path / "b" / "merged")
    lost = run_fleet(recordings, tmp_path / "b", Backwards(lost=0), None, merging)
    assert lost.joined == [] and "no two of the recordings met: there is no joint map" in lost.doubts

    # Nor one that the others contradict.
    def contradicted(*given: Any) -> Any:
        refused = place_sessions(given[0], [Meeting(0, 1, [], refusal="lies 9 standard deviations away")], given[2])
        return refused

    monkeypatch.setattr(fleet_run, "place_surely", contradicted)
    doubted = run_fleet(recordings, tmp_path / "b", InProcess(), None, merging)
    assert doubted.contradictions == ["monday and friday: lies 9 standard deviations away"]
    assert "the recordings contradict each other: monday and friday: lies 9 standard deviations away" in doubted.doubts


def test_what_is_not_to_be_trusted_is_left_out_of_the_joint_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
        open_store(store).write(f"runs/{name}/run.json", b"{}")
        return RecordingStatus(
            name=name, recording=recording, state="finished", doubt="the sensors differ" if name == "b" else None
        )

    monkeypatch.setattr(fleet_run, "run_recording", run)
    open_store(tmp_path).write("merged/run.json", b"{}")
    status = run_fleet({"a": Path("a"), "b": Path("b")}, tmp_path, InProcess())
    assert status.joined == [] and status.doubts == ["b is left out of the joint map: the sensors differ"]
    assert "is of an earlier fleet" in status.warnings[0]


def test_workers_that_write_to_a_place_of_their_own_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def elsewhere(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
        return RecordingStatus(name=name, recording=recording, state="finished")

    monkeypatch.setattr(fleet_run, "run_recording", elsewhere)
    with pytest.raises(InputError, match="a place for the results that all workers share – got memory://elsewhere, where"):
        run_fleet({"a": Path("a"), "b": Path("b")}, "memory://elsewhere", InProcess())


def test_a_run_whose_local_maps_are_damaged_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def damaged(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
        open_store(store).write(f"runs/{name}/run.json", b"{}")
        return RecordingStatus(name=name, recording=recording, state="finished")

    monkeypatch.setattr(fleet_run, "run_recording", damaged)
    status = run_fleet({"a": Path("a"), "b": Path("b")}, tmp_path, InProcess())
    assert [own.name for own in status.failed] == ["a", "b"]
    assert all(
        text.startswith(f"{name} failed: its local maps: InputError") for name, text in zip("ab", status.doubts, strict=True)
    )


def test_a_pair_is_looked_at_again_after_a_new_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def found(place: Any, query: Any, config: Any, numbers: tuple[int, int]) -> Meeting:
        calls.append(numbers)
        return Meeting(*numbers, [], np.arange(7.0), np.eye(6), 3, 2)

    monkeypatch.setattr(tasks, "Places", lambda *_: None)
    monkeypatch.setattr(tasks, "open_session_run", lambda *_, **__: SimpleNamespace(session=None))
    monkeypatch.setattr(tasks, "meet", found)
    store, config = open_store(tmp_path), MergeConfig().sessions

    def meeting(numbers: tuple[int, int], own: SessionsConfig = config) -> Meeting:
        return tasks.meet_runs(store.text, ("a", "b"), numbers, own)

    first, second = meeting((0, 1)), meeting((3, 7))
    assert calls == [(0, 1)] and (second.place_session, second.query_session) == (3, 7)
    assert np.array_equal(first.T_place_query, second.T_place_query) and second.confirmed == 2
    store.write("runs/a/local_maps/graph.npz", b"another")
    meeting((0, 1))
    meeting((0, 1), config.model_copy(update={"reach": 10.0}))
    assert len(calls) == 3
    store.write("pairs/a/b.npz", b"cut")
    meeting((0, 1))
    assert len(calls) == 4


def test_a_recording_that_is_finished_is_not_run_again(tmp_path: Path) -> None:
    store, bag, config = tmp_path / "fleet", tmp_path / "r.bag", SlamRunConfig()
    bag.touch()
    folder = finished(store, bag, config)
    status = tasks.run_recording(str(store), "r", str(bag), config)
    assert (status.state, status.scans, status.seconds) == ("finished", 7, 0.0)
    folder.config.write_text("other settings", encoding="utf-8")
    again = tasks.run_recording(str(store), "r", str(bag), config)
    assert again.state == "failed" and "r.bag" in str(again.error)


def test_a_run_is_of_its_recording_not_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names of a list move on when a line is put before others, and a file may be replaced."""
    store, config = tmp_path / "fleet", SlamRunConfig()
    first, moved, other = (tmp_path / day / "r.bag" for day in ("monday", "moved", "tuesday"))
    seconds = {first: 2.0, moved: 2.0, other: 2.5}
    for bag in seconds:
        bag.parent.mkdir()
        bag.touch()

    def opened(path: Path | str, options: object) -> Recording:
        del options
        return as_recording(simulate("walk", duration_s=seconds[Path(path)], lidar=SpinningLidar(azimuth_steps=60)))

    run_odometry(opened(first, None), finished(store, first, config).odometry.path)
    begun = []

    def begin(recording: Recording, *_: object, **__: object) -> None:
        begun.append(recording.info.duration_s)
        raise InputError("a run", "none", "this is a test")

    monkeypatch.setattr(tasks, "open_recording", opened)
    monkeypatch.setattr(tasks, "run_slam", begin)

    def state_of(bag: Path) -> str:
        return tasks.run_recording(str(store), "r", str(bag), config).state

    assert state_of(first) == state_of(moved) == "finished" and not begun
    assert state_of(other) == "failed" and begun
    seconds[first] = 2.5  # replaced where it lies
    os.utime(first, (4e9, 4e9))
    assert state_of(first) == "failed"


def test_a_file_moved_over_another_is_a_new_one(tmp_path: Path) -> None:
    """It keeps the time at which it was written, which may be long before the run."""
    bag, other = tmp_path / "r.bag", tmp_path / "other.bag"
    for file in (bag, other):
        file.touch()
        os.utime(file, (1e9, 1e9))
    before = time.time()
    other.replace(bag)
    assert bag.stat().st_mtime == 1e9 and tasks._changed_at(bag) > before - 60.0


@pytest.mark.slow
def test_a_recording_that_is_there_twice_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy under another name would vouch for the first one wherever they are looked at."""

    def copied(store: str, name: str, recording: str, config: SlamRunConfig) -> RecordingStatus:
        status = drive(store, "monday" if name == "copy" else name, recording, config)
        if name == "copy":
            shutil.copytree(Path(store) / "runs" / "monday", Path(store) / "runs" / "copy")
        return status.model_copy(update={"name": name})

    monkeypatch.setattr(fleet_run, "run_recording", copied)
    recordings = {name: tmp_path / f"{name}.bag" for name in ("monday", "friday", "copy")}
    status = run_fleet(recordings, tmp_path / "fleet", InProcess(), merging=load_settings(MergeConfig, None, QUICK))
    found = {own.name: own for own in status.recordings}
    assert found["copy"].doubt == "it is the recording of monday again" and not found["copy"].joined
    assert status.pairs_looked_at == 1 and set(status.joined) == {"monday", "friday"}


def finished(store: Path, bag: Path, config: SlamRunConfig) -> SlamFolder:
    """Facts of a run of a recording that was written before it."""
    folder, now = SlamFolder(store / "runs" / "r"), datetime.now(UTC) + timedelta(seconds=10.0)
    folder.path.mkdir(parents=True)
    SlamSummary(versions={}, state="finished", started=now, updated=now, recording=str(bag), scans=7).write(folder.summary)
    folder.config.write_text(dump_slam_config(config), encoding="utf-8")
    return folder


def test_parts_of_a_bag_without_metadata_are_one_recording(tmp_path: Path) -> None:
    """The readers open such a folder as one; taken for several, each part had a start and a map of its own."""
    parts = tmp_path / "parts"
    parts.mkdir()
    for name in ("part_0.mcap", "part_1.mcap"):
        (parts / name).touch()
    assert not holds_recordings(parts)
    assert list(find_recordings(parts)) == ["parts"]
    (parts / "other.bag").touch()
    assert holds_recordings(parts)
    with pytest.raises(InputError, match=r"2 parts of one, part_0.mcap to part_1.mcap, .* a folder of their own"):
        find_recordings(parts)
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
    (tmp_path / "ros2" / "b.bag").touch()
    listed.write_text("# two of one name\nb.bag\n\nros2\nros2/b.bag\n")
    assert list(find_recordings(listed)) == ["b", "ros2", "b_2"]
    twice = "b.bag\nros2/../b.bag"
    for text, message in (
        ("c.bag", "nothing at"),
        (twice, "b.bag twice in"),
        ("s3://fleet/a.bag", "shared folder"),
        ("", "one a line"),
    ):
        listed.write_text(text)
        with pytest.raises(InputError, match=message):
            find_recordings(listed)
    (tmp_path / "empty").mkdir()
    for path, message in (
        ("empty", "got none in .*empty – put bags"),
        ("b.bag", "got the file .*b.bag – give the folder that it is in, or a .txt file.*; for one recording run 'boxplus slam'"),
        ("none", "got nothing at .*none – check the path"),
    ):
        with pytest.raises(InputError, match=message):
            find_recordings(tmp_path / path)
    with pytest.raises(InputError, match="a recording at least"):
        run_fleet({}, tmp_path / "out", InProcess())


def test_a_task_that_fails_ends_alone() -> None:
    ends = list(InProcess().run(lambda x: 1 // x, [(1,), (0,), (2,)]))
    assert [end.value for end in ends] == [1, None, 0]
    assert ends[1].error is not None and ends[1].error.startswith("ZeroDivisionError")


def test_without_opencv_no_recording_is_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(InputError, match=r"pip install .*opencv"):
        run_fleet({"a": Path("a")}, tmp_path / "out", InProcess())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("address", "message"),
    [
        (None, "none that would start on this machine: timed out – try again"),
        ("10.0.0.5:6379", "none at 10.0.0.5:6379: timed out"),
    ],
)
def test_a_cluster_that_is_not_there_is_no_traceback(address: str | None, message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def init(**_: object) -> None:
        raise Exception("timed out")  # as Ray does

    monkeypatch.setitem(sys.modules, "ray", SimpleNamespace(init=init))
    with pytest.raises(InputError, match=message), RayExecutor(address):
        pass


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install .*ray"):
        RayExecutor()
