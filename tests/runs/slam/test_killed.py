"""Killed at any moment, as where memory runs out, `slam` goes on to the same bits, and `map merge` leaves a whole map."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from boxplus.runs.sessions.summary import read_merge_summary
from boxplus.runs.slam.config import dump_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.storage.folder_lock import LOCK
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.drifting_drive import DriftConfig
from boxplus.simulation.recording_writer import write_recording
from boxplus.simulation.worlds.worlds import city
from tests.runs.sessions.runs import written_run
from tests.runs.slam.test_resume import CONFIG, assert_same

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")]
KILLS, TRIES = 5, 15  # the machine may be faster than it was when a whole run was timed


def begun(*words: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "boxplus", *map(str, words), "--quiet"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def slam(bag: Path, out: Path, *words: str) -> subprocess.Popen[str]:
    return begun("slam", bag, "-o", out, "--no-report", *words)


def killed_after(seconds: float, process: subprocess.Popen[str]) -> int:
    """What it ended with: it may have been faster."""
    try:
        process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
    return process.returncode


def finished(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, said = process.communicate(timeout=300)
    return process.returncode, said


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and path.name != LOCK}


def test_a_run_that_is_killed_at_any_moment_goes_on_to_the_same_results(tmp_path: Path) -> None:
    simulation = simulate("walk", duration_s=6.0, lidar=SpinningLidar(azimuth_steps=200))
    bag, whole = write_recording(simulation, tmp_path / "walk", "ros1"), SlamFolder(tmp_path / "whole")
    settings = tmp_path / "settings.yaml"
    settings.write_text(dump_slam_config(CONFIG), encoding="utf-8")
    words, seconds = ("--config", str(settings)), 0.0
    for _ in range(2):  # the first may compile
        began = time.monotonic()
        assert finished(slam(bag, whole.path, *words, "--overwrite"))[0] == 0
        seconds = time.monotonic() - began
    left: list[int] = []
    for number, share in enumerate(np.random.default_rng(9).uniform(0.25, 1.0, TRIES).tolist()):
        if left.count(-signal.SIGKILL) == KILLS:
            break
        out = SlamFolder(tmp_path / f"killed_{number}")
        began = time.monotonic()
        left.append(killed_after(share * seconds, slam(bag, out.path, *words)))
        if left[-1] == 0:  # it was finished
            seconds = time.monotonic() - began
            continue
        code, said = finished(slam(bag, out.path, *words, "--resume"))
        if code == 2 and files_in(out.path) == files_in(whole.path):  # it had been finished when it was killed
            assert_same(out, whole)
            continue
        if code:  # it was killed before there was anything to go on with
            assert code == 2 and "start the run without --resume" in said and not out.trajectory.exists(), said
            code, said = finished(slam(bag, out.path, *words))
        assert code == 0, said
        assert_same(out, whole)
        assert files_in(out.path) == files_in(whole.path)
    assert left.count(-signal.SIGKILL) == KILLS, left


def test_a_merge_that_is_killed_at_any_moment_leaves_the_old_map_or_the_new_one(tmp_path: Path) -> None:
    world, drift = city(2, 2, seed=5), DriftConfig(channels=16, azimuth_steps=240, step_m=2.0)
    written_run(tmp_path / "monday", world, [[0.0, 0.0], [60.0, 0.0], [60.0, 40.0]], drift, 5)
    written_run(tmp_path / "friday", world, [[60.0, 50.0], [60.0, 0.0], [10.0, 0.0]], drift, 6)
    out, words = tmp_path / "street", ("map", "merge", tmp_path / "monday", tmp_path / "friday", "--overwrite", "--set")
    maps, seconds = {}, 0.0
    for voxel in (0.2, 0.3):
        began = time.monotonic()
        assert finished(begun(*words, f"map.voxel={voxel}", "-o", tmp_path / "whole"))[0] == 0
        seconds = time.monotonic() - began
        maps[voxel] = {name: (tmp_path / "whole" / name).read_bytes() for name in ("map.ply", "encounters.csv")}
        files = files_in(tmp_path / "whole")
    assert maps[0.2]["map.ply"] != maps[0.3]["map.ply"]
    shutil.copytree(tmp_path / "whole", out)
    left, before = list[int](), 0.3
    for share in np.random.default_rng(4).uniform(0.3, 1.0, TRIES).tolist():
        if left.count(-signal.SIGKILL) == KILLS:
            break
        wanted = 0.5 - before
        began = time.monotonic()
        left.append(killed_after(share * seconds, begun(*words, f"map.voxel={wanted:.1f}", "-o", out)))
        seconds = min(seconds, time.monotonic() - began) if left[-1] == 0 else seconds
        found = {name: (out / name).read_bytes() for name in ("map.ply", "encounters.csv")}
        before = next(voxel for voxel in maps if maps[voxel] == found)
        assert files_in(out) == files and read_merge_summary(out / "run.json").map_points
    assert left.count(-signal.SIGKILL) == KILLS, left
    assert finished(begun(*words, "map.voxel=0.2", "-o", out))[0] == 0  # nothing blocks
    assert {name: (out / name).read_bytes() for name in maps[0.2]} == maps[0.2]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["friday", "monday", "street", "whole"]
