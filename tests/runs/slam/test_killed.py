"""`boxplus slam` killed at any moment, as by a machine that is switched off, goes on and comes to the same bits."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from boxplus.runs.slam.config import dump_slam_config
from boxplus.runs.slam.folder import SlamFolder
from boxplus.runs.storage.folder_lock import LOCK
from boxplus.simulation import SpinningLidar, simulate
from boxplus.simulation.recording_writer import write_recording
from tests.runs.slam.test_resume import CONFIG, assert_same

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")]
KILLS = 5


def slam(bag: Path, out: Path, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "boxplus", "slam", str(bag), "-o", str(out), "--no-report", "--quiet", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def finished(process: subprocess.Popen[str]) -> tuple[int, str]:
    _, said = process.communicate(timeout=300)
    return process.returncode, said


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file() and path.name != LOCK}


def test_a_run_that_is_killed_at_any_moment_goes_on_to_the_same_results(tmp_path: Path) -> None:
    simulation = simulate("walk", duration_s=6.0, lidar=SpinningLidar(azimuth_steps=100))
    bag, whole = write_recording(simulation, tmp_path / "walk", "ros1"), SlamFolder(tmp_path / "whole")
    settings = tmp_path / "settings.yaml"
    settings.write_text(dump_slam_config(CONFIG), encoding="utf-8")
    words, seconds = ("--config", str(settings)), 0.0
    for _ in range(2):  # the first may compile
        began = time.monotonic()
        assert finished(slam(bag, whole.path, *words, "--overwrite"))[0] == 0
        seconds = time.monotonic() - began
    left = []
    for number, share in enumerate(np.random.default_rng(9).uniform(0.25, 1.0, KILLS).tolist()):
        out = SlamFolder(tmp_path / f"killed_{number}")
        process = slam(bag, out.path, *words)
        time.sleep(share * seconds)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        left.append(process.returncode)
        if process.returncode == 0:  # faster than the run before: it was finished
            continue
        code, said = finished(slam(bag, out.path, *words, "--resume"))
        if code:  # it was killed before there was anything to go on with
            assert code == 2 and "start the run without --resume" in said and not out.trajectory.exists(), said
            code, said = finished(slam(bag, out.path, *words))
        assert code == 0, said
        assert_same(out, whole)
        assert files_in(out.path) == files_in(whole.path)
    assert left.count(-signal.SIGKILL) >= KILLS - 2, left
