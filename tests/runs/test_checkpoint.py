"""A run that is killed goes on from its checkpoint: the same rows to the bit, each once."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from array import array
from collections import Counter, deque
from pathlib import Path

import numpy as np
import pytest

from boxplus.errors import InputError
from boxplus.formats.trajectory import read_trajectory
from boxplus.maps.ikd_tree.answers import Neighbors
from boxplus.recordings import open_recording
from boxplus.recordings.recording import Recording
from boxplus.runs import checkpoint
from boxplus.runs.lidar_inertial.config import load_run_config
from boxplus.runs.lidar_inertial.odometry_run import run_odometry
from boxplus.runs.lidar_inertial.scan_log import read_scan_log
from boxplus.runs.lidar_inertial.statistics import RunStatistics
from boxplus.runs.lidar_inertial.summary import read_summary
from boxplus.runs.storage import state_codec
from boxplus.runs.storage.state_codec import read_state, write_state
from boxplus.sensors.inertial.imu import ImuSamples
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.simulation.recording_writer import write_recording

LIDAR = SpinningLidar(azimuth_steps=200)
_EAGER = "import boxplus.runs.checkpoint as c; c._EVERY_S = 0.3; c._LARGEST_SHARE = 1e9; from boxplus.cli import main; main()"


def walk(duration_s: float = 5.0) -> Recording:
    return as_recording(simulate("walk", duration_s=duration_s, lidar=LIDAR))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run without an interruption."""
    folder = tmp_path_factory.mktemp("whole") / "out"
    assert run_odometry(walk(), folder).state == "finished"
    assert not (folder / "checkpoint.npz").exists()
    return folder


def stopped_after(folder: Path, events: int, **options: bool) -> None:
    """Interrupt a run, or a resumed one, after a number of events."""
    asked = iter(range(10_000))
    summary = run_odometry(walk(), folder, should_stop=lambda: next(asked) >= events, **options)
    assert summary.state == "interrupted" and (folder / "checkpoint.npz").is_file()


def assert_same(folder: Path, whole: Path) -> None:
    resumed, straight = read_trajectory(folder / "trajectory.csv"), read_trajectory(whole / "trajectory.csv")
    assert np.array_equal(resumed.time_ns, straight.time_ns)
    assert np.array_equal(resumed.p, straight.p) and np.array_equal(resumed.covariance, straight.covariance)
    assert np.array_equal(read_scan_log(folder / "scans.csv").time_ns, straight.time_ns)
    for name in ("trajectory.tum", "trajectory.kitti.txt"):
        assert len((folder / name).read_text().splitlines()) == len(straight)
    found, expected = read_summary(folder / "run.json"), read_summary(whole / "run.json")
    assert found.state == "finished"
    for name in ("scans", "status", "scans_read", "imu_samples_read", "first_time_ns", "last_time_ns", "rejected"):
        assert getattr(found, name) == getattr(expected, name)
    assert found.map.registered_points == expected.map.registered_points
    assert found.map.merged_points == pytest.approx(expected.map.merged_points, rel=0.01)
    assert not (folder / "checkpoint.npz").exists()


@pytest.mark.slow
@pytest.mark.parametrize("stops", [(2,), (60,), (40, 30)])
def test_an_interrupted_run_goes_on(whole: Path, tmp_path: Path, stops: tuple[int, ...]) -> None:
    """Before the start was found, in the middle, and twice."""
    out = tmp_path / "out"
    for number, events in enumerate(stops):
        stopped_after(out, events, resume=number > 0)
    run_odometry(walk(), out, resume=True)
    assert_same(out, whole)
    assert read_summary(out / "run.json").resumed == len(stops)


@pytest.mark.slow
def test_rows_after_the_checkpoint_are_written_once(whole: Path, tmp_path: Path) -> None:
    """The checkpoint is seconds old when a process is killed, and the last row may be cut."""
    out = tmp_path / "out"
    stopped_after(out, 50)
    early = (out / "checkpoint.npz").read_bytes()
    stopped_after(out, 30, resume=True)
    (out / "checkpoint.npz").write_bytes(early)
    with (out / "trajectory.csv").open("a") as file:
        file.write("123,ok,0.")
    run_odometry(walk(), out, resume=True)
    assert_same(out, whole)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_a_killed_process_goes_on(tmp_path: Path) -> None:
    bag = write_recording(simulate("walk", duration_s=12.0, lidar=LIDAR), tmp_path / "walk", "ros1")
    killed, out = tmp_path / "killed", tmp_path / "out"
    words = [sys.executable, "-c", _EAGER, "lio", str(bag), "--no-report", "-o"]
    process = subprocess.Popen([*words, str(killed)], stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 300.0
    rows = killed / "trajectory.tum"
    while process.poll() is None and time.monotonic() < deadline:
        if (killed / "checkpoint.npz").exists() and len(rows.read_text().splitlines()) > 20:
            break
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert read_summary(killed / "run.json").state == "running"
    assert subprocess.run([*words, str(killed), "--resume"], stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert subprocess.run([*words, str(out)], stdout=subprocess.DEVNULL, check=False).returncode == 0
    assert_same(killed, out)


def rewritten(path: Path, *without: str, **texts: str) -> None:
    """A checkpoint with other texts, or without some."""
    with np.load(path) as stored:
        kept = {name: stored[name] for name in stored.files if name not in without}
    np.savez(path, **kept | {name: np.frombuffer(text.encode(), np.uint8) for name, text in texts.items()})


@pytest.mark.slow
def test_a_checkpoint_of_other_code_is_refused(tmp_path: Path) -> None:
    """Its objects may lack what this code expects of them."""
    out = tmp_path / "out"
    stopped_after(out, 40)
    rewritten(out / "checkpoint.npz", program="boxplus 9.9.9, code 0123")
    with pytest.raises(
        InputError, match=r"of this version of boxplus \(boxplus .*, code .*\) – got one of boxplus 9.9.9, code 0123"
    ):
        run_odometry(walk(), out, resume=True)
    rewritten(out / "checkpoint.npz", "program")  # from before it was written down
    with pytest.raises(InputError, match=r"one of an earlier boxplus \(.*\) – start the run anew"):
        run_odometry(walk(), out, resume=True)
    assert read_summary(out / "run.json").state == "interrupted"


def test_the_code_that_counts_is_that_of_estimators(tmp_path: Path) -> None:
    for room in ("cli", "systems"):
        (tmp_path / room).mkdir()
        (tmp_path / room / "a.py").write_text("x = 1\n")
    before = state_codec.program_of_files(tmp_path)
    (tmp_path / "cli" / "a.py").write_text("x = 2\n")
    assert state_codec.program_of_files(tmp_path) == before
    (tmp_path / "systems" / "a.py").write_text("x = 2\n")
    assert state_codec.program_of_files(tmp_path) != before


def test_whose_checkpoint_it_is(tmp_path: Path) -> None:
    path = tmp_path / "state.npz"
    write_state(path, {"x": np.arange(3)})
    assert state_codec.is_of_this_program(path)
    path.write_bytes(path.read_bytes()[:-40])
    assert not state_codec.is_of_this_program(path)
    write_state(path, {})
    rewritten(path, program="boxplus 9.9.9, code 0123")
    assert not state_codec.is_of_this_program(path)


@pytest.mark.slow
def test_another_recording_or_setting_is_refused(tmp_path: Path) -> None:
    out = tmp_path / "out"
    stopped_after(out, 40)
    with pytest.raises(InputError, match=r"expected the recording that the run began with \(.*\) – got .* – give that recording"):
        run_odometry(walk(6.0), out, resume=True)
    with pytest.raises(InputError, match=r"expected the settings that the run began with \(.*: 0.15.*– got .*scan_voxel: 0.3"):
        run_odometry(walk(), out, load_run_config(settings=["scan_voxel=0.3"]), resume=True)
    (out / "trajectory.tum").write_text("")
    with pytest.raises(InputError, match=r"expected the \d+ rows of the checkpoint in trajectory and scans.csv – got 0"):
        run_odometry(walk(), out, resume=True)
    for damaged in ((out / "checkpoint.npz").read_bytes()[:-100], b"not an archive"):
        (out / "checkpoint.npz").write_bytes(damaged)
        with pytest.raises(InputError, match=r"of this version of boxplus – got a damaged one .* – start the run anew$"):
            run_odometry(walk(), out, resume=True)
    (out / "run.json").write_text('{"program": "boxplus vio"}')
    with pytest.raises(InputError, match="expected a run of 'boxplus lio' to go on with – got one of 'boxplus vio' in"):
        run_odometry(walk(), out, resume=True)


def test_nothing_to_resume_is_said(whole: Path, tmp_path: Path) -> None:
    for folder, message in (
        (
            whole,
            "an unfinished run of 'boxplus lio' to go on with – got one that is finished already, in .* – nothing is left to do",
        ),
        (tmp_path / "none", "the folder of a run that did not come to its end, with a checkpoint – got none in"),
    ):
        with pytest.raises(InputError, match=f"^expected {message}"):
            run_odometry(walk(), folder, resume=True)
    assert not (tmp_path / "none").exists()


def test_checkpoints_come_less_often_where_they_take_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([0.0, 100.0, 102.0, 140.0, 143.0])
    monkeypatch.setattr(checkpoint.time, "perf_counter", lambda: next(now))
    monkeypatch.setattr(checkpoint, "write_state", lambda path, state: None)
    writer = checkpoint.CheckpointWriter(tmp_path / "checkpoint.npz")
    writer.write(checkpoint.Checkpoint({}, 0, 0, RunStatistics(), {}, {}))
    assert not writer.is_due  # 38 s after one that took 2 s
    assert writer.is_due


def test_a_state_comes_back_as_it_was(tmp_path: Path) -> None:
    statistics = RunStatistics()
    statistics.add_event(ImuSamples(np.arange(5), np.ones((5, 3)), np.ones((5, 3))))
    state = {
        "plain": [None, True, 3, -0.1, float("inf"), "µ", np.float64(0.1), 2**62],
        "containers": {(1, -2): {"a"}, "tally": Counter("aab"), "queue": deque([1, 2], maxlen=2), "numbers": array("d", [0.5])},
        "arrays": [np.eye(2), np.arange(3, dtype=np.uint8)],
        "objects": [statistics, statistics],
    }
    write_state(tmp_path / "state.npz", state)
    found = read_state(tmp_path / "state.npz")
    assert found["plain"] == state["plain"] and found["containers"] == state["containers"]
    assert found["containers"]["queue"].maxlen == 2
    assert all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(found["arrays"], state["arrays"], strict=True))
    assert found["objects"][0] is found["objects"][1]
    assert found["objects"][0].imu_samples_read == 5


@pytest.mark.parametrize(
    "name", ["os:system", "boxplus.runs.storage.state_codec:Path", "boxplus.errors:printable", "boxplus.no:Thing"]
)
def test_a_checkpoint_makes_nothing_but_objects_of_boxplus(tmp_path: Path, name: str) -> None:
    tree = {"dict": [["x", {"object": name, "attributes": {}}]]}
    write_state(tmp_path / "state.npz", {})
    rewritten(tmp_path / "state.npz", tree=json.dumps(tree))
    with pytest.raises(InputError, match="expected the checkpoint of a run"):
        read_state(tmp_path / "state.npz")
    with pytest.raises(TypeError, match=r"holds no pathlib"):
        write_state(tmp_path / "other.npz", {"x": tmp_path})
    with pytest.raises(TypeError, match=r"holds no boxplus.maps.ikd_tree.answers.Neighbors"):
        write_state(tmp_path / "other.npz", {"x": Neighbors(np.zeros((0, 1)), np.zeros((0, 1, 3)), np.zeros(0, np.int64))})


def test_the_recording_is_known_wherever_it_lies(tmp_path: Path) -> None:
    bag = write_recording(simulate("walk", duration_s=1.0, lidar=LIDAR), tmp_path / "walk", "ros1")
    moved = tmp_path / "elsewhere.bag"
    moved.write_bytes(bag.read_bytes())
    with open_recording(bag) as one, open_recording(moved) as other:
        assert checkpoint.run_identity(one.info, "", "both") == checkpoint.run_identity(other.info, "", "both")
