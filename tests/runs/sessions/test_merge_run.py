"""`boxplus map merge` over folders of runs: what is joined, what is apart, what was seen through, and what a full disk leaves."""

from __future__ import annotations

import csv
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli.lidar.map import map_app
from boxplus.errors import InputError, OutputError
from boxplus.formats.clouds.ply import read_ply
from boxplus.formats.trajectory import read_trajectory
from boxplus.manifolds import se3
from boxplus.maps.tiles.store import TileStore
from boxplus.maps.tiles.writer import TileWriter
from boxplus.runs.sessions.config import MergeConfig
from boxplus.runs.sessions.joined import merge_facts
from boxplus.runs.sessions.merge_run import MergeResult, WorseMapError, merge_runs
from boxplus.runs.sessions.session_run import open_session_run
from boxplus.runs.sessions.update_run import update_map
from boxplus.runs.settings_file import load_settings
from boxplus.runs.slam.summary import read_slam_summary
from boxplus.simulation.drifting_drive import DriftConfig, DriftingDrive
from boxplus.simulation.worlds.world import World, box
from boxplus.simulation.worlds.worlds import city
from boxplus.systems.sessions.sessions import JointWorld, SessionAlignment, align_sessions
from tests.runs.sessions.runs import written_run

DRIFT = DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
QUICK = [
    "sessions.slam={least_overlap: 0.6, rival_fit: 0.85, descriptor: {candidates: 2}}",
    "map.voxel=0.2",
    "seen_through.voxel=0.3",
]
VAN = (30.0, 3.5, 1.3)
SOUND_SCALE = np.tile([[1.0, 0.01]], (3, 1))


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Path], list[DriftingDrive]]:
    """A street on Monday with a van at its side, on Friday without, and a short drive in another city."""
    base, world = tmp_path_factory.mktemp("runs"), city(2, 2, seed=5)
    with_van = World([*world.solids, box(VAN, (5.0, 2.0, 2.4))])
    folders = [base / "monday", base / "friday", base / "elsewhere"]
    drives = [
        written_run(folders[0], with_van, [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]], DRIFT, 5),
        written_run(folders[1], world, [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]], DRIFT, 6),
        written_run(folders[2], city(2, 2, seed=99), [[60.0, 30.0], [60.0, 0.0], [50.0, 0.0]], DRIFT, 7),
    ]
    return folders, drives


@pytest.fixture(scope="module")
def merged(runs: tuple[list[Path], list[DriftingDrive]], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, MergeResult]:
    out = tmp_path_factory.mktemp("merged") / "out"
    return out, merge_runs(runs[0], out, load_settings(MergeConfig, None, QUICK), remove_dynamic=True)


def of_van(points: np.ndarray, drive: DriftingDrive) -> np.ndarray:
    """Points in the frame of Monday's run that lie on the van."""
    p = se3.act(drive.T_world_body[0], points.astype(np.float64))
    return np.asarray((np.abs(p - VAN) <= [2.7, 1.2, 1.3]).all(axis=1) & (p[:, 2] > 0.5))


@pytest.mark.slow
def test_runs_that_met_are_one_map_and_the_other_is_apart(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult]
) -> None:
    out, result = merged
    facts = {session["name"]: session for session in json.loads((out / "run.json").read_text())["sessions"]}
    assert [facts[name]["joined"] for name in ("monday", "friday", "elsewhere")] == [True, True, False]
    assert len(facts["elsewhere"]["apart_because"]) == 2 and max(facts["friday"]["sigma"][3:]) < 0.3
    assert result.summary.map_points == TileStore.open(out / "map").point_count > 10_000
    for name, drive in zip(("monday", "friday"), runs[1], strict=False):
        found = read_trajectory(out / "sessions" / f"{name}.tum")
        truth = se3.compose(
            np.broadcast_to(se3.inverse(runs[1][0].T_world_body[0]), drive.T_world_body.shape), drive.T_world_body
        )
        assert np.linalg.norm(found.p - truth[:, 4:], axis=1).max() < 0.4
    assert not (out / "sessions" / "elsewhere.tum").exists()
    with (out / "encounters.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == result.summary.encounters_looked_at
    assert all((row["accepted"] == "1") == (row["refusal"] == "") for row in rows)


def test_the_van_that_left_is_kept_apart_and_reported(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult]
) -> None:
    out, result = merged
    monday = runs[1][0]
    kept, removed = read_ply(out / "map.ply").points, read_ply(out / "removed.ply").points
    assert len(removed) == result.summary.removed_points
    assert of_van(removed, monday).sum() > 1.5 * of_van(kept, monday).sum()  # few rays: a scan every two metres, 16 lines
    assert (~of_van(removed, monday)).sum() < 1e-3 * len(kept)
    with (out / "changes.csv").open() as file:
        vanished = [row for row in csv.DictReader(file) if row["what"] == "vanished"]
    at = se3.act(monday.T_world_body[0], [[float(row[k]) for k in "xyz"] for row in vanished])
    assert np.linalg.norm(at - VAN, axis=1).min() < 1.5


def test_runs_that_did_not_meet_are_left_as_they_are(runs: tuple[list[Path], list[DriftingDrive]], tmp_path: Path) -> None:
    arguments = ["merge", str(runs[0][0]), str(runs[0][2]), "-o", str(tmp_path / "out"), *(f"--set={text}" for text in QUICK)]
    result = CliRunner().invoke(map_app, [*arguments, "--json", "--quiet"])
    assert result.exit_code == 3
    found = json.loads(result.stdout)
    assert found["outcome"] == "not to be trusted" and found["output"] == str(tmp_path / "out")
    assert found["run"] == json.loads((tmp_path / "out" / "run.json").read_text())
    assert [session["name"] for session in found["run"]["sessions"]] == ["monday", "elsewhere"]
    assert all("apart_because" in session for session in found["run"]["sessions"])
    assert result.stderr.count("\n") == 1 and "no two of the runs met" in result.stderr  # quiet
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["config.yaml", "encounters.csv", "run.json"]


def test_a_full_disk_leaves_the_earlier_map_whole(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, result = merged
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    monkeypatch.setattr("boxplus.runs.sessions.merge_run.align_sessions", lambda *_, **__: result.alignment)

    def full(*_: object) -> None:
        raise OutputError("a full disk")

    monkeypatch.setattr(TileWriter, "append", full)
    with pytest.raises(OutputError, match="a full disk"):
        merge_runs(runs[0], out, overwrite=True)
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_what_cannot_be_merged_is_refused(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="two runs at least, each given once"):
        merge_runs([runs[0][0], runs[0][0]], tmp_path / "out")
    with pytest.raises(InputError, match="the output folder of a run of 'boxplus slam'"):
        merge_runs([runs[0][0], merged[0]], tmp_path / "out")
    with pytest.raises(InputError, match=r"got nothing at .*nope – check the path"):
        merge_runs([runs[0][0], tmp_path / "nope"], tmp_path / "out")
    with pytest.raises(InputError, match=r"none of them in .*wrong.yaml – write e.g. 'sessions:' and keys below"):
        (tmp_path / "wrong.yaml").write_text("[1, 2]")
        load_settings(MergeConfig, tmp_path / "wrong.yaml")
    (tmp_path / "wrong.yaml").unlink()
    with pytest.raises(InputError, match="add --overwrite"):
        merge_runs(runs[0][:2], merged[0])
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(InputError, match="other files in"):
        merge_runs(runs[0][:2], tmp_path, overwrite=True)
    assert (tmp_path / "mine.txt").read_text() == "mine"


def test_one_recording_twice_is_refused(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], tmp_path: Path
) -> None:
    """It meets itself everywhere, and every standard deviation would come out too small."""
    shutil.copytree(runs[0][0], tmp_path / "copy")
    with pytest.raises(InputError, match="expected runs of different recordings – got monday and copy"):
        merge_runs([runs[0][0], runs[0][1], tmp_path / "copy"], tmp_path / "out")
    with pytest.raises(InputError, match="a folder was copied"):
        update_map(merged[0], [tmp_path / "copy"])
    assert not (tmp_path / "out").exists()


@contextmanager
def without(path: Path) -> Iterator[None]:
    moved = path.with_name(path.name + ".away")
    path.rename(moved)
    yield
    moved.rename(path)


def test_a_run_without_its_scans_is_refused(runs: tuple[list[Path], list[DriftingDrive]], tmp_path: Path) -> None:
    with without(runs[0][0] / "scans.spool"), pytest.raises(InputError, match="a run that kept its scans"):
        merge_runs(runs[0][:2], tmp_path / "out")


def test_an_update_that_met_nobody_leaves_the_map_alone(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, result = merged
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: result.alignment)
    shown = CliRunner().invoke(map_app, ["update", str(out), str(runs[0][2])])
    assert shown.exit_code == 3 and "stays as it was" in shown.output and "elsewhere: apart" in shown.output
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_an_update_from_which_one_of_the_map_would_go_leaves_it_alone(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The new run contradicts it, or its folder holds another recording by now; once it went without a word on the map."""
    out, result = merged
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    joined, alone = result.alignment.worlds
    worlds = [replace(joined, members=(0, 2)), replace(alone, members=(1,))]
    found = replace(result.alignment, worlds=worlds)
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: found)
    shown = CliRunner().invoke(map_app, ["update", str(out), str(runs[0][2])])
    assert shown.exit_code == 3 and "stays as it was" in shown.output
    assert "friday: would no longer be part of the map" in shown.output and "elsewhere" not in shown.output.split("\n")[0]
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before


def test_an_update_stays_in_its_frame(
    runs: tuple[list[Path], list[DriftingDrive]],
    merged: tuple[Path, MergeResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A first run that was made again from later on moved the map by as much, with exit code 0."""
    folders, out, monday = runs[0], tmp_path / "out", tmp_path / "monday"
    shutil.copytree(merged[0], out)
    shutil.copytree(folders[0], monday)
    facts = json.loads((out / "run.json").read_text())
    facts["sessions"][0]["run"] = str(monday)
    (out / "run.json").write_text(json.dumps(facts))
    asked: list[int] = []

    def align(*_: object, **__: object) -> SessionAlignment:
        asked.append(1)
        raise RuntimeError

    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", align)
    with pytest.raises(RuntimeError):
        update_map(out, [folders[2]])
    assert asked  # as it was
    rows = (monday / "trajectory.csv").read_text().splitlines(keepends=True)
    (monday / "trajectory.csv").write_text("".join([rows[0], *rows[3:]]))
    with pytest.raises(InputError, match=r"which begins \+0\.5 s later – put the earlier one back"):
        update_map(out, [folders[2]])
    facts["frame"]["T_frame_imu"][4] += 14.0
    (out / "run.json").write_text(json.dumps(facts))
    (monday / "trajectory.csv").write_text("".join(rows))
    with pytest.raises(InputError, match=r"which begins 14 m and 0° away in its frame"):
        update_map(out, [folders[2]])
    facts["frame"]["T_frame_imu"][4] -= 14.0
    facts["frame"]["first_points"] = ["another", None]
    (out / "run.json").write_text(json.dumps(facts))
    odometry = monday / "odometry" / "run.json"
    own = json.loads(odometry.read_text())
    own["recording"]["first_points"] = ["this one", "that one"]
    odometry.write_text(json.dumps(own))
    with pytest.raises(InputError, match="which begins with other points"):
        update_map(out, [folders[2]])
    assert len(asked) == 1


def test_an_update_goes_on_although_more_runs_met_elsewhere(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, result = merged
    joined, alone = result.alignment.worlds
    own, others = replace(joined, members=(0, 1, 2), scale=SOUND_SCALE), replace(alone, members=(3, 4, 5, 6))
    found = replace(result.alignment, worlds=[others, own])
    taken = []
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: found)
    monkeypatch.setattr("boxplus.runs.sessions.update_run.merge_runs", lambda *_, align, **__: taken.append(align([])))
    update_map(out, [runs[0][2]])
    assert [world.members for world in taken[0].worlds] == [(0, 1, 2), (3, 4, 5, 6)]


def test_scans_that_are_not_all_there_are_no_smaller_map(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], tmp_path: Path
) -> None:
    """Cut between two scans the file reads as a shorter one, and once the joint map had a hole that nobody mentioned."""
    cut = tmp_path / "monday"
    shutil.copytree(runs[0][0], cut)
    size = (cut / "scans.spool").stat().st_size
    summary = read_slam_summary(cut / "run.json")
    assert open_session_run(cut, "monday").session.name == "monday"
    summary.model_copy(update={"spool_bytes": size + 1000}).write(cut / "run.json")
    with pytest.raises(InputError, match=f"expected the {size + 1000} bytes of .*scans.spool – got {size}: it was cut"):
        update_map(merged[0], [cut])
    summary.write(cut / "run.json")
    data = bytearray((cut / "scans.spool").read_bytes())
    data[size // 2] ^= 0x40
    (cut / "scans.spool").write_bytes(data)
    before, (out, earlier) = (merged[0] / "map.ply").read_bytes(), merged
    with pytest.raises(InputError, match=r"scans.spool: the scan that begins at byte \d+ is damaged: its checksum"):
        merge_runs(
            [cut, *runs[0][1:]], out, load_settings(MergeConfig, None, QUICK), overwrite=True, align=lambda _: earlier.alignment
        )
    assert (out / "map.ply").read_bytes() == before


@pytest.mark.parametrize("at_line", [True, False])
def test_a_trajectory_that_was_cut_is_refused(
    runs: tuple[list[Path], list[DriftingDrive]], merged: tuple[Path, MergeResult], tmp_path: Path, at_line: bool
) -> None:
    """Once half of the session's poses were missing from the joint map's folder, and nobody said so."""
    cut = tmp_path / "monday"
    shutil.copytree(runs[0][0], cut)
    lines = (cut / "trajectory.csv").read_text().splitlines(keepends=True)
    text = "".join(lines[: len(lines) // 2])
    (cut / "trajectory.csv").write_text(text if at_line else text[:-20])
    said = r"one that ends \d+\.\d s before its last local map: it was cut" if at_line else "is incomplete"
    with pytest.raises(InputError, match=rf"the trajectory of a whole run in .*trajectory\.csv – got [^–]*{said}"):
        update_map(merged[0], [cut])


def doubted(alignment: SessionAlignment) -> SessionAlignment:
    return replace(alignment, meetings=[replace(m, doubt="are at two places, perhaps") for m in alignment.meetings])


DOUBT = "friday and monday are at two places, perhaps"


def test_what_may_be_two_places_of_a_kind_is_joined_with_a_doubt(merged: tuple[Path, MergeResult]) -> None:
    alignment = merged[1].alignment
    assert merge_facts(doubted(alignment), ["a", "b", "c"], [None] * 3).doubts == [DOUBT]
    assert merge_facts(alignment, ["a", "b", "c"], [None] * 3).doubts == []
    contradicted = merge_facts(alignment, ["a", "b", "c"], [None, "its sensors contradict each other", "so do these"])
    assert contradicted.doubts == ["friday is not to be trusted itself: its sensors contradict each other"]
    assert contradicted.warnings == ["elsewhere is not to be trusted itself: so do these"]


def test_a_doubtful_join_ends_with_code_3_and_replaces_no_map_unasked(
    runs: tuple[list[Path], list[DriftingDrive]],
    merged: tuple[Path, MergeResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two warehouses built alike: once `map merge` ended with code 0, and `--overwrite` put it in the place of a good map."""
    found = doubted(merged[1].alignment)
    monkeypatch.setattr("boxplus.runs.sessions.merge_run.align_sessions", lambda *_, **__: found)
    given, new, old = [str(path) for path in runs[0]], tmp_path / "new", tmp_path / "old"
    shown = CliRunner().invoke(map_app, ["merge", *given, "-o", str(new)])
    assert shown.exit_code == 3 and "two places, perhaps" in shown.output and (new / "map.ply").is_file()
    shutil.copytree(merged[0], old)
    before = {path: path.stat().st_mtime_ns for path in old.rglob("*")}
    again = ["merge", *given, "-o", str(old), "--overwrite"]
    shown = CliRunner().invoke(map_app, again)
    said = " ".join(shown.output.split())
    assert shown.exit_code == 3 and "--accept-doubts" in said and DOUBT in said
    told = json.loads(CliRunner().invoke(map_app, [*again, "--json"]).stdout)
    assert (told["outcome"], told["exit_code"]) == ("not to be trusted", 3) and DOUBT in told["error"]
    assert {path: path.stat().st_mtime_ns for path in old.rglob("*")} == before
    alone = replace(found, worlds=[replace(found.worlds[0], members=(0,)), *found.worlds[1:]])
    monkeypatch.setattr("boxplus.runs.sessions.merge_run.align_sessions", lambda *_, **__: alone)
    with pytest.raises(WorseMapError, match=r"to replace the one in .* – got no two of the runs met – choose another folder"):
        merge_runs(runs[0], old, overwrite=True)
    monkeypatch.setattr("boxplus.runs.sessions.merge_run.align_sessions", lambda *_, **__: found)
    shown = CliRunner().invoke(map_app, [*again, "--accept-doubts"])
    assert shown.exit_code == 0 and "two places, perhaps" in shown.output
    assert {path: path.stat().st_mtime_ns for path in old.rglob("*")} != before


def test_an_update_in_doubt_leaves_the_map_alone(
    runs: tuple[list[Path], list[DriftingDrive]],
    merged: tuple[Path, MergeResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of the new runs alone: what the map was made of in spite of a doubt, it stays made of."""
    out, result = merged
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    joined = result.alignment.worlds[0]
    maps = [*joined.T_world_map, result.alignment.sessions[2].T_session_map]
    world = JointWorld((0, 1, 2), np.tile(joined.T_world_session[:1], (3, 1)), np.zeros((3, 6, 6)), maps, [],
                       SOUND_SCALE)  # fmt: skip
    met = replace(result.alignment.meetings[0], place_session=1, query_session=2)
    found = replace(result.alignment, worlds=[world], meetings=[result.alignment.meetings[0], met])
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: doubted(found))
    update = ["update", str(out), str(runs[0][2])]
    shown = CliRunner().invoke(map_app, update)
    said = " ".join(shown.output.split())
    assert shown.exit_code == 3 and "elsewhere and friday are at two places, perhaps" in said and DOUBT not in said
    assert "stays as it was: --accept-doubts" in said
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*")} == before
    told = json.loads(CliRunner().invoke(map_app, [*update, "--json"]).stdout)
    assert (told["outcome"], told["exit_code"]) == ("not to be trusted", 3)
    assert "elsewhere and friday are at two places, perhaps" in told["error"]
    taken = []
    monkeypatch.setattr("boxplus.runs.sessions.update_run.merge_runs", lambda *_, **given: taken.append(given) or result)
    assert CliRunner().invoke(map_app, [*update, "--accept-doubts"]).exit_code == 0 and len(taken) == 1
    one = replace(found, meetings=[replace(found.meetings[0], doubt="are at two places, perhaps"), met])
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: one)
    assert CliRunner().invoke(map_app, update).exit_code == 0 and len(taken) == 2


def test_an_update_does_not_launder_a_doubt(
    runs: tuple[list[Path], list[DriftingDrive]],
    merged: tuple[Path, MergeResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A sound run is added to a map in doubt: once that ended with code 0, although nobody had accepted the doubt."""
    two = doubted(merged[1].alignment)
    joined = two.worlds[0]
    only = replace(two, sessions=two.sessions[:2], worlds=[joined], meetings=two.meetings[:1])
    maps = [*joined.T_world_map, two.sessions[2].T_session_map]
    world = JointWorld((0, 1, 2), np.tile(joined.T_world_session[:1], (3, 1)), np.zeros((3, 6, 6)), maps, [],
                       SOUND_SCALE)  # fmt: skip
    sound = replace(merged[1].alignment.meetings[0], place_session=1, query_session=2)
    three = replace(two, worlds=[world], meetings=[two.meetings[0], sound])
    monkeypatch.setattr("boxplus.runs.sessions.merge_run.align_sessions", lambda *_, **__: only)
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", lambda *_, **__: three)
    given = [str(path) for path in runs[0]]
    for accepts, code in (([], 3), (["--accept-doubts"], 0)):
        out = str(tmp_path / f"out{code}")
        assert CliRunner().invoke(map_app, ["merge", *given[:2], "-o", out, *accepts]).exit_code == code
        shown = CliRunner().invoke(map_app, ["update", out, given[2], "--json"])
        told = json.loads(shown.stdout)
        assert shown.exit_code == told["exit_code"] == code
        assert len(told["run"]["doubts"]) == 1 and told["run"]["accepted"] == (told["run"]["doubts"] if accepts else [])


@pytest.mark.slow
def test_an_update_goes_on_with_a_map(
    runs: tuple[list[Path], list[DriftingDrive]],
    merged: tuple[Path, MergeResult],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sunday meets both, which then need not meet each other again."""
    monkeypatch.setattr("boxplus.runs.sessions.update_run.align_sessions", partial(align_sessions, pairs=[(0, 2), (1, 2)]))
    folders, drives = runs
    sunday, out = tmp_path / "sunday", tmp_path / "out"
    drive = written_run(sunday, city(2, 2, seed=5), [[5.0, 0.0], [60.0, 0.0], [60.0, 10.0]], DRIFT, 9)
    shutil.copytree(merged[0], out)
    first = read_trajectory(out / "sessions" / "monday.tum").p
    result = update_map(out, [sunday]).merged
    assert result is not None and [session.name for session in result.summary.joined] == ["monday", "friday", "sunday"]
    assert np.linalg.norm(read_trajectory(out / "sessions" / "monday.tum").p - first, axis=1).max() < 0.3
    found = read_trajectory(out / "sessions" / "sunday.tum").p
    truth = se3.compose(np.broadcast_to(se3.inverse(drives[0].T_world_body[0]), drive.T_world_body.shape), drive.T_world_body)
    assert np.linalg.norm(found - truth[:, 4:], axis=1).max() < 0.4
    with pytest.raises(InputError, match="which is"):
        update_map(out, [folders[1]])
    sunday.rename(tmp_path / "gone")
    with pytest.raises(InputError, match="nothing at"):
        update_map(out, [folders[2]])
