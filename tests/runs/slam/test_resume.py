"""A run with loop closure that was stopped goes on with the same bits; its loop search ends with it, and says why it ended."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from boxplus.cli import app
from boxplus.errors import BoxplusError, InputError, OutputError
from boxplus.maps.local_maps.folder import LocalMapFolder
from boxplus.maps.local_maps.local_map import LocalMap
from boxplus.maps.tiles.writer import TileWriter
from boxplus.recordings.recording import Recording
from boxplus.report import load_report
from boxplus.runs.slam import corrected
from boxplus.runs.slam.config import load_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.slam.loop_search import LoopSearch
from boxplus.runs.slam.slam_run import run_slam
from boxplus.runs.slam.summary import read_slam_summary
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.live_recording import as_recording
from boxplus.systems.slam.config import SlamConfig

WALK = simulate("walk", duration_s=6.0, lidar=SpinningLidar(azimuth_steps=100))
SHORT = simulate("walk", duration_s=3.0, lidar=SpinningLidar(azimuth_steps=100))
CONFIG = load_slam_config(
    settings=[
        *("odometry.scan_voxel=0.5", "odometry.map_cell=0.5", "map.pcd=false", "map.voxel=0.3"),
        *("local_maps.length=1.5", "local_maps.least_length=0.5", "slam.least_way=0.5", "slam.appearance=none"),
    ]
)


def walk() -> Recording:
    return as_recording(WALK)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> SlamFolder:
    """A run without an interruption."""
    folder = SlamFolder(tmp_path_factory.mktemp("whole") / "out")
    result = run_slam(walk(), folder.path, CONFIG)
    assert result.summary.state == "finished" and result.summary.local_maps >= 3
    assert not folder.odometry.checkpoint.exists()
    return folder


def assert_same(found: SlamFolder, whole: SlamFolder) -> None:
    names = ["trajectory.csv", "trajectory.tum", "loops.csv", "map.ply", "odometry/trajectory.csv", "local_maps/graph.npz"]
    names += [f"local_maps/{path.name}" for path in whole.local_maps.iterdir()]
    for name in names:
        assert (found.path / name).read_bytes() == (whole.path / name).read_bytes(), name
    assert len(list(found.local_maps.iterdir())) == len(list(whole.local_maps.iterdir()))
    assert read_slam_summary(found.summary).state == "finished"
    assert not found.odometry.checkpoint.exists()


def stopped_after(folder: SlamFolder, events: int, *, resume: bool = False) -> None:
    asked = itertools.count()
    result = run_slam(walk(), folder.path, CONFIG, resume=resume, should_stop=lambda: next(asked) >= events)
    assert result.summary.state == "interrupted" and folder.spool.exists()


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_the_same_bits(whole: SlamFolder, tmp_path: Path) -> None:
    out = SlamFolder(tmp_path / "out")
    stopped_after(out, 70)
    early = out.odometry.checkpoint.read_bytes()
    stopped_after(out, 25, resume=True)
    out.odometry.checkpoint.write_bytes(early)  # as where the process was killed, seconds after its last checkpoint
    with out.spool.open("ab") as file:
        file.write(b"half a scan")
    with pytest.raises(InputError, match=r"settings that the run began with \(.*least_overlap: 0.5.*least_overlap: 0.6"):
        run_slam(walk(), out.path, load_slam_config(out.config, ["slam.least_overlap=0.6"]), resume=True)
    run_slam(walk(), out.path, CONFIG, resume=True)
    assert_same(out, whole)
    assert read_slam_summary(out.summary).resumed == 2
    with pytest.raises(
        InputError, match=r"^expected an unfinished run of 'boxplus slam' to go on with – got one that is finished"
    ):
        run_slam(walk(), out.path, CONFIG, resume=True)


def test_a_run_that_is_interrupted_before_its_first_pose_is_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("boxplus.recordings.open_recording", lambda *_: nullcontext(as_recording(SHORT)))
    monkeypatch.setattr("boxplus.cli.terminal.interrupt.stop_on_interrupt", lambda _: nullcontext(lambda: True))
    out = SlamFolder(tmp_path / "out")
    words = ["slam", "walk.bag", "-o", str(out.path), "--T-imu-lidar", "xyz: 0 0 0", "--json"]
    called = CliRunner().invoke(app, words)
    assert called.exit_code == 130 and json.loads(called.stdout)["outcome"] == "interrupted", called.stderr
    summary = read_slam_summary(out.summary)
    assert (summary.state, summary.scans, summary.local_maps) == ("interrupted", 0, 0)
    assert out.odometry.checkpoint.exists() and not out.trajectory.exists() and not out.report.exists()


@pytest.mark.slow
def test_a_run_that_failed_after_its_odometry_goes_on_from_there(
    whole: SlamFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = SlamFolder(tmp_path / "out")

    class Full(TileWriter):
        def append(self, *_: object) -> None:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched, pytest.raises(OutputError, match="a full disk"):
        patched.setattr(corrected, "TileWriter", Full)
        run_slam(walk(), out.path, CONFIG)
    assert read_slam_summary(out.summary).state == "failed" and not out.tiles.exists()
    assert load_report(out.path).summary.describe_state().startswith("stopped by an error")
    before = out.summary.read_bytes()
    with pytest.raises(
        InputError, match=r"expected the recording that the run in .* is of \(.* in 6.0.* – got .* in 3.0.* --overwrite"
    ):
        run_slam(as_recording(SHORT), out.path, CONFIG, resume=True)
    assert out.summary.read_bytes() == before
    run_slam(walk(), out.path, CONFIG, resume=True)
    assert_same(out, whole)


def small_map(number: int) -> LocalMap:
    points = np.random.default_rng(number).uniform(-5.0, 5.0, (200, 3)).astype(np.float32)
    T = np.array([1.0, 0, 0, 0, 2.0 * number, 0, 0])
    return LocalMap(number, 10 * number, 10 * number, 10 * number + 9, T, np.eye(6) * 1e-4, 2.0 * number, points, 5)


def test_a_loop_search_that_fails_or_dies_says_so(tmp_path: Path) -> None:
    maps = LocalMapFolder(tmp_path / "maps")
    maps.write(small_map(0))
    config = SlamConfig(appearance="none")
    with (
        pytest.raises(InputError, match=r"expected a local map \(version 2 .*000001.npz"),
        LoopSearch(config, [], [], maps.path, tmp_path / "graph.npz") as search,
    ):
        search.give(0)
        search.give(1)
        search.finish(lambda: None)
    with (
        pytest.raises(BoxplusError, match=r"expected the loop search beside the odometry to go on – got its process ended"),
        LoopSearch(config, [], [], maps.path, tmp_path / "graph.npz") as search,
    ):
        search._process.kill()
        search.finish(lambda: None)


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
def test_a_killed_parent_leaves_no_loop_search(tmp_path: Path) -> None:
    program = """
import sys, time
from pathlib import Path
from boxplus.runs.slam.loop_search import LoopSearch
from boxplus.systems.slam.config import SlamConfig
with LoopSearch(SlamConfig(appearance="none"), [], [], Path(sys.argv[1]), Path(sys.argv[1]) / "graph.npz") as search:
    print(search._process.pid, flush=True)
    time.sleep(60)
"""
    parent = subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    os.kill(worker, 0)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    until = time.monotonic() + 30.0
    while _is_running(worker) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _is_running(worker)


def _is_running(process: int) -> bool:
    """Whether it is there, and not only waits for somebody to ask how it ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        try:
            os.kill(process, 0)
        except OSError:
            return False
        return not Path("/proc").is_dir()
